"""The step responses that are flown, and how each is read from telemetry."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from airl_mav.conformance.step_response import StepResponse, step_response
from airl_mav.conformance.track import Track
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

QUIET_S = 0.2
"""Latency counts from the mean of so long before a step [s]: noise of the estimate is slow."""

VELOCITY_CHANGE = 0.05
ANGLE_CHANGE = 0.5
"""Movement that ends the latency, of a velocity [m/s], and of a heading or its rate [deg, deg/s].
"""


class Ned(NamedTuple):
    """MAVSDK's set_velocity_ned [m/s, deg]."""

    north: float
    east: float
    down: float
    yaw_deg: float

    def mirrored(self) -> Ned:
        """Return the opposite way to fly; up stays up."""
        return Ned(0.0 - self.north, 0.0 - self.east, self.down, 0.0 - self.yaw_deg)


class Body(NamedTuple):
    """MAVSDK's set_velocity_body [m/s, deg/s]."""

    forward: float
    right: float
    down: float
    yawspeed_deg_s: float

    def mirrored(self) -> Body:
        """Return the opposite way to fly; up stays up."""
        return Body(0.0 - self.forward, 0.0 - self.right, self.down, 0.0 - self.yawspeed_deg_s)


Setpoint = Ned | Body
Reading = Literal["north", "east", "down", "forward", "heading", "heading rate"]

UNIT: dict[Reading, str] = {
    "north": "m/s",
    "east": "m/s",
    "down": "m/s",
    "forward": "m/s",
    "heading": "deg",
    "heading rate": "deg/s",
}


class Step(NamedTuple):
    """What is read from one leg."""

    name: StepName
    reading: Reading
    before: float
    after: float
    """Old and new setpoint, in the reading's unit."""

    @property
    def title(self) -> str:
        """What is stepped, in words."""
        return f"{self.reading} {self.before:g} -> {self.after:g} {UNIT[self.reading]}"

    def mirrored(self) -> Step:
        """Return the same step the other way round; up stays up."""
        if self.reading == "down":
            return self
        return self._replace(before=0.0 - self.before, after=0.0 - self.after)


class Leg(NamedTuple):
    """One setpoint, held for a while."""

    setpoint: Setpoint
    seconds: float
    step: Step | None = None
    """What is measured of it; None: it only leads to the next one."""


NORTHWARD = Ned(0.0, 0.0, 0.0, 0.0)
STILL = Body(0.0, 0.0, 0.0, 0.0)

# Long enough to settle by PX4's and ArduPilot's measured settling times, with a second to spare.
MANOEUVRES: tuple[tuple[Leg, ...], ...] = (
    (
        Leg(NORTHWARD, 2.0),
        Leg(Ned(2.0, 0.0, 0.0, 0.0), 5.0, Step("north-2", "north", 0.0, 2.0)),
        Leg(NORTHWARD, 5.0, Step("north-2-stop", "north", 2.0, 0.0)),
    ),
    (
        Leg(NORTHWARD, 1.0),
        Leg(Ned(5.0, 0.0, 0.0, 0.0), 6.0, Step("north-5", "north", 0.0, 5.0)),
        Leg(NORTHWARD, 6.0, Step("north-5-stop", "north", 5.0, 0.0)),
    ),
    (
        Leg(NORTHWARD, 1.0),
        Leg(Ned(0.0, 2.0, 0.0, 0.0), 5.0, Step("east-2", "east", 0.0, 2.0)),
        Leg(NORTHWARD, 3.0),
    ),
    (
        Leg(STILL, 2.0),
        Leg(Body(2.0, 0.0, 0.0, 0.0), 5.0, Step("forward-2", "forward", 0.0, 2.0)),
        Leg(STILL, 3.0),
    ),
    (
        Leg(NORTHWARD, 2.0),
        Leg(Ned(0.0, 0.0, -2.0, 0.0), 5.0, Step("up-2", "down", 0.0, -2.0)),
        Leg(NORTHWARD, 4.0),
        Leg(Ned(0.0, 0.0, 1.0, 0.0), 8.0, Step("down-1", "down", 0.0, 1.0)),
        Leg(NORTHWARD, 2.0),
    ),
    (
        Leg(NORTHWARD, 2.0),
        Leg(Ned(0.0, 0.0, 0.0, 90.0), 5.0, Step("yaw-90", "heading", 0.0, 90.0)),
        Leg(NORTHWARD, 4.0),
    ),
    (
        Leg(STILL, 2.0),
        Leg(Body(0.0, 0.0, 0.0, 30.0), 4.0, Step("yawspeed-30", "heading rate", 0.0, 30.0)),
        Leg(STILL, 2.0),
        Leg(NORTHWARD, 4.0),
    ),
)
"""In this order, each from a standing start with the nose to the north. Once through: 40 m north,
10 m east, 10 m up, and with a second, mirrored time back."""


def plan(names: tuple[StepName, ...], *, mirrored: bool) -> list[Leg]:
    """Return the legs of the manoeuvres that hold the named steps; others are not measured."""
    legs = []
    for manoeuvre in MANOEUVRES:
        if not any(leg.step is not None and leg.step.name in names for leg in manoeuvre):
            continue
        for leg in manoeuvre:
            step = leg.step if leg.step is not None and leg.step.name in names else None
            setpoint: Setpoint = leg.setpoint
            if mirrored:
                setpoint, step = setpoint.mirrored(), step and step.mirrored()
            legs.append(Leg(setpoint, leg.seconds, step))
    return legs


def measure(step: Step, track: Track, sent_s: float) -> StepResponse:
    """Return the response to a step.

    Args:
        step: Which one.
        track: Telemetry from `QUIET_S` before it to the end of its leg.
        sent_s: When the setpoint came, by the vehicle's clock [s].

    Raises:
        ValueError: Telemetry is missing before or after the step.
    """
    times_s, values = _read(step.reading, track, sent_s)
    change = VELOCITY_CHANGE if UNIT[step.reading] == "m/s" else ANGLE_CHANGE
    return step_response(times_s - sent_s, values, step.before, step.after, change)


def _read(
    reading: Reading, track: Track, sent_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times [s] and values [the reading's unit]."""
    motion, heading = track
    if reading == "heading":
        # Around the start: a turn may cross south.
        return heading[:, 0], np.degrees(np.unwrap(heading[:, 1]))
    if reading == "heading rate":
        return heading[:, 0], np.degrees(heading[:, 2])
    velocity = motion[:, 4:7]
    if reading == "forward":
        yaw = heading_before(track, sent_s)
        return motion[:, 0], velocity[:, 0] * math.cos(yaw) + velocity[:, 1] * math.sin(yaw)
    return motion[:, 0], velocity[:, ("north", "east", "down").index(reading)]


def heading_before(track: Track, time_s: float) -> float:
    """Return the last heading before a time, by the vehicle's clock [rad]. ValueError: none."""
    before = track.heading[track.heading[:, 0] <= time_s]
    if not len(before):
        raise ValueError("no heading from before the step")
    return float(wrap_pi(before[-1, 1]))
