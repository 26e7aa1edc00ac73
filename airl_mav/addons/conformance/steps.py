"""Step responses, their telemetry and figures.

A value is reached at its first sample, up to one sample late, as in the stored columns.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.conformance.telemetry import EstimatedMotion
from airl_mav.core.frames import wrap_pi

StepName = Literal[
    "north-2",
    "north-2-stop",
    "north-5",
    "north-5-stop",
    "east-2",
    "forward-2",
    "up-2",
    "down-1",
    "yaw-90",
    "yawspeed-30",
]
STEP_NAMES: tuple[StepName, ...] = get_args(StepName)

BEFORE_S = 0.2
"""Duration before a step whose mean is the start value [s]: estimate noise is slow."""

VELOCITY_CHANGE = 0.05
ANGLE_CHANGE = 0.5
"""Movement that ends the latency, of a velocity [m/s], and of a heading or its rate [deg,
deg/s]."""


SETTLED = 0.05
"""Settling tolerance around the new value, as a share of the step."""

END_S = 1.0
"""Averaging time of the final error [s]."""


class StepSetpoint(NamedTuple):
    """MAVSDK's set_velocity_ned [m/s, deg] or set_velocity_body [m/s, deg/s]."""

    frame: Literal["ned", "body"]
    north_or_forward: float = 0.0
    east_or_right: float = 0.0
    down: float = 0.0
    yaw_or_yawspeed: float = 0.0


Quantity = Literal["north", "east", "down", "forward", "heading", "heading rate"]


class SetpointStep(NamedTuple):
    """Step of one quantity from one setpoint to another."""

    name: StepName
    quantity: Quantity
    before: float
    after: float
    """Old and new setpoint, in the quantity's unit."""

    @property
    def unit(self) -> str:
        """Unit of the quantity."""
        return {"heading": "deg", "heading rate": "deg/s"}.get(self.quantity, "m/s")

    @property
    def title(self) -> str:
        """Title, for example "north 0 -> 2 m/s"."""
        return f"{self.quantity} {self.before:g} -> {self.after:g} {self.unit}"

    @property
    def setpoint(self) -> StepSetpoint:
        """New setpoint."""
        return {
            "north": StepSetpoint("ned", self.after),
            "east": StepSetpoint("ned", 0.0, self.after),
            "down": StepSetpoint("ned", 0.0, 0.0, self.after),
            "heading": StepSetpoint("ned", 0.0, 0.0, 0.0, self.after),
            "forward": StepSetpoint("body", self.after),
            "heading rate": StepSetpoint("body", 0.0, 0.0, 0.0, self.after),
        }[self.quantity]

    def mirrored(self) -> SetpointStep:
        """Return the opposite step; vertical steps stay the same."""
        if self.quantity == "down":
            return self
        return self._replace(before=0.0 - self.before, after=0.0 - self.after)


class HeldSetpoint(NamedTuple):
    """Setpoint held for a fixed time."""

    setpoint: StepSetpoint
    seconds: float
    step: SetpointStep | None = None
    """Measured step; None: a transition to the next leg."""


class StepResponse(NamedTuple):
    """Response to one step; times start at sending. NaN: not reached."""

    latency_s: float
    """Time until the value has moved by a given amount [s]."""
    t10_s: float
    """Time until 10 % of the step [s]."""
    t50_s: float
    """Time until 50 % of the step [s]."""
    rise_s: float
    """Time from 10 % to 90 % [s]."""
    overshoot_percent: float
    """Overshoot beyond the new value, relative to the step [%]; negative: undershoot."""
    error: float
    """New value minus the mean at the end, positive for undershoot [unit]."""
    settle_s: float
    """Time after which it stays within 5 % of the step around the new value [s]."""


def step_response(
    times_s: NDArray[np.float64],
    values: NDArray[np.float64],
    before: float,
    after: float,
    change: float,
) -> StepResponse:
    """Return the characteristics of a step; `change` is the movement that ends the latency."""
    quiet, answer = times_s < 0.0, times_s >= 0.0
    if not quiet.any() or not answer.any():
        raise ValueError("a step response needs samples from before and after the step")
    times = times_s[answer]
    size = abs(after - before)
    share = (values - before) / (after - before)
    start = float(share[quiet].mean())
    share = share[answer]

    def first(level: float) -> float:
        reached = np.flatnonzero(share >= level)
        return float(times[reached[0]]) if reached.size else float("nan")

    outside = np.flatnonzero(np.abs(share - 1.0) > SETTLED)
    last = int(outside[-1]) + 1 if outside.size else 0
    settle_s = float(times[last]) if last < len(times) else float("nan")
    end = share[times >= times[-1] - END_S]
    return StepResponse(
        latency_s=first(start + change / size),
        t10_s=first(0.1),
        t50_s=first(0.5),
        rise_s=first(0.9) - first(0.1),
        overshoot_percent=100.0 * (float(share.max()) - 1.0),
        error=size * (1.0 - float(end.mean())),
        settle_s=settle_s,
    )


class MeasuredStep(NamedTuple):
    """Step and its responses, one per repetition."""

    step: SetpointStep
    flights: list[StepResponse]

    @property
    def median(self) -> StepResponse:
        """Median of each figure over the repetitions, robust to noise; NaN if any is NaN."""
        return StepResponse(*np.median(np.array(self.flights), axis=0).tolist())


STOP_NED = StepSetpoint("ned")
"""Hover, facing north."""
STOP_BODY = StepSetpoint("body")


def _leg(
    seconds: float, name: StepName, quantity: Quantity, before: float, after: float
) -> HeldSetpoint:
    """Return the leg of a step."""
    step = SetpointStep(name, quantity, before, after)
    return HeldSetpoint(step.setpoint, seconds, step)


# Settling time by PX4's and ArduPilot's measurements, plus one second.
MANOEUVRES: tuple[tuple[HeldSetpoint, ...], ...] = (
    (
        HeldSetpoint(STOP_NED, 2.0),
        _leg(5.0, "north-2", "north", 0.0, 2.0),
        _leg(5.0, "north-2-stop", "north", 2.0, 0.0),
    ),
    (
        HeldSetpoint(STOP_NED, 1.0),
        _leg(6.0, "north-5", "north", 0.0, 5.0),
        _leg(6.0, "north-5-stop", "north", 5.0, 0.0),
    ),
    (
        HeldSetpoint(STOP_NED, 1.0),
        _leg(5.0, "east-2", "east", 0.0, 2.0),
        HeldSetpoint(STOP_NED, 3.0),
    ),
    (
        HeldSetpoint(STOP_BODY, 2.0),
        _leg(5.0, "forward-2", "forward", 0.0, 2.0),
        HeldSetpoint(STOP_BODY, 3.0),
    ),
    (
        *(HeldSetpoint(STOP_NED, 2.0), _leg(5.0, "up-2", "down", 0.0, -2.0)),
        *(
            HeldSetpoint(STOP_NED, 4.0),
            _leg(8.0, "down-1", "down", 0.0, 1.0),
            HeldSetpoint(STOP_NED, 2.0),
        ),
    ),
    (
        HeldSetpoint(STOP_NED, 2.0),
        _leg(5.0, "yaw-90", "heading", 0.0, 90.0),
        HeldSetpoint(STOP_NED, 4.0),
    ),
    (
        *(HeldSetpoint(STOP_BODY, 2.0), _leg(4.0, "yawspeed-30", "heading rate", 0.0, 30.0)),
        *(HeldSetpoint(STOP_BODY, 2.0), HeldSetpoint(STOP_NED, 4.0)),
    ),
)
"""Manoeuvres in flight order, each from a hover facing north. One pass: 40 m north, 10 m east, 10 m
up; a second, mirrored pass returns."""


def plan(names: tuple[StepName, ...], *, mirrored: bool) -> list[HeldSetpoint]:
    """Return the legs of the manoeuvres that contain the named steps; others are not measured."""
    legs = []
    for manoeuvre in MANOEUVRES:
        if not any(leg.step is not None and leg.step.name in names for leg in manoeuvre):
            continue
        for setpoint, seconds, step in manoeuvre:
            # The legs between steps are stops and need no mirroring.
            flown = step.mirrored() if step is not None and mirrored else step
            measured = flown if flown is not None and flown.name in names else None
            legs.append(
                HeldSetpoint(setpoint if flown is None else flown.setpoint, seconds, measured)
            )
    return legs


def measure(step: SetpointStep, motion: EstimatedMotion, sent_s: float) -> StepResponse:
    """Return a step's response from `BEFORE_S` before its arrival at `sent_s` [s] to its end."""
    position, heading = motion
    velocity, times_s = motion.velocity, position[:, 0]
    if step.quantity == "heading":
        # Unwrapped from the start: a turn may cross south.
        times_s, values = heading[:, 0], np.degrees(np.unwrap(heading[:, 1]))
    elif step.quantity == "heading rate":
        times_s, values = heading[:, 0], np.degrees(heading[:, 2])
    elif step.quantity == "forward":
        before = heading[heading[:, 0] <= sent_s]
        if not len(before):
            raise ValueError("no heading from before the step")
        yaw = float(wrap_pi(before[-1, 1]))
        values = velocity[:, 0] * math.cos(yaw) + velocity[:, 1] * math.sin(yaw)
    else:
        values = velocity[:, ("north", "east", "down").index(step.quantity)]
    change = VELOCITY_CHANGE if step.unit == "m/s" else ANGLE_CHANGE
    return step_response(times_s - sent_s, values, step.before, step.after, change)
