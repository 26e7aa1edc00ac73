"""Telemetry of the vehicle: newest messages, motion, texts and state changes; step responses.

A step's value is reached at its first sample, up to one sample late, as in the stored columns.
"""

from __future__ import annotations

import json
import math
import threading
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.conformance import checklist
from airl_mav.core import clock, constants, frames

MESSAGES = (
    "ATTITUDE",
    "AUTOPILOT_VERSION",
    "COMMAND_ACK",
    "EXTENDED_SYS_STATE",
    "HEARTBEAT",
    "LOCAL_POSITION_NED",
    "STATUSTEXT",
    "SYS_STATUS",
)
"""Messages that `TelemetryBuffer.receive` accepts."""

AUTOPILOT_COMPONENT = 1
"""MAV_COMP_ID_AUTOPILOT1: other components of the vehicle send separate heartbeats and clocks."""

FULL_TEXT = 50  # Length of a STATUSTEXT that may continue in another part
MOTION_HZ = 250.0  # Above the requested sample rates
Fields = Mapping[str, Any]


class EstimatedMotion(NamedTuple):
    """The vehicle's estimated motion by the vehicle's clock, over a part of the flight."""

    position: NDArray[np.float64]
    """(n, 7) LOCAL_POSITION_NED: time since boot [s], north, east, down [m], their rates [m/s]."""
    heading: NDArray[np.float64]
    """(m, 3) ATTITUDE: time since boot [s], yaw [rad], yawspeed [rad/s]."""

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(n, 3) north, east, down [m/s]."""
        return self.position[:, 4:7]

    def between(self, start_s: float, end_s: float) -> EstimatedMotion:
        """Return the part between two times since boot [s]."""
        return EstimatedMotion(
            *(part[(part[:, 0] >= start_s) & (part[:, 0] <= end_s)] for part in self)
        )


class StatusText(NamedTuple):
    """STATUSTEXT of the vehicle."""

    boot_s: float
    """Time since boot of the newest telemetry before it [s]."""
    text: str


class TelemetryBuffer:
    """Telemetry, texts and answers; written by MAVSDK's threads, read from any."""

    def __init__(self, transcript: checklist.Transcript) -> None:
        self._transcript = transcript
        self._lock = threading.Lock()
        self._wall = clock.WallClock()
        self._latest: dict[str, Fields] = {}
        self._position: list[tuple[float, ...]] = []
        self._heading: list[tuple[float, ...]] = []
        self._partial_text: tuple[int, str] = (0, "")
        self._last_received_us = 0
        self.texts: list[StatusText] = []
        self.landed_states: list[int] = []
        """Each new value of landed_state."""
        self.unlogged_acks: Counter[int] = Counter()
        """Number of pending COMMAND_ACKs to omit from the transcript, by command."""
        self.boot_s = 0.0
        """Newest time since boot in telemetry [s]."""
        self.mode_name: Callable[[int], str] = str
        """Function that returns the name of a custom_mode."""

    @property
    def silence_s(self) -> float:
        """Wall time since the last message [s]."""
        return (self._wall.time_us() - self._last_received_us) / constants.US_PER_S

    def latest(self, name: str) -> Fields | None:
        """Return the fields of the newest message of a name; None before the first."""
        return self._latest.get(name)

    def receive(self, message: Any, _: object) -> None:
        """Process a message of MAVSDK's mavlink_direct."""
        if message.component_id != AUTOPILOT_COMPONENT:
            return
        fields: Fields = json.loads(message.fields_json)
        name = message.message_name
        with self._lock:
            self._last_received_us = self._wall.time_us()
            previous = self._latest.get(name)
            self._latest[name] = fields
            if name == "LOCAL_POSITION_NED":
                self._position.append(self._row(fields, ("x", "y", "z", "vx", "vy", "vz")))
            elif name == "ATTITUDE":
                self._heading.append(self._row(fields, ("yaw", "yawspeed")))
        if name == "STATUSTEXT":
            self._take_text(fields)
        elif name == "COMMAND_ACK":
            self._take_ack(fields)
        elif name == "HEARTBEAT":
            self._take_heartbeat(fields, previous)
        elif name == "EXTENDED_SYS_STATE":
            self._take_landed(fields["landed_state"])

    def recent(self, seconds: float) -> EstimatedMotion:
        """Return the motion of the last seconds, by the vehicle's clock [s]."""
        rows = int(seconds * MOTION_HZ) + 10  # Avoids copying the whole flight
        with self._lock:
            position, heading = self._position[-rows:], self._heading[-rows:]
        motion = EstimatedMotion(
            np.array(position).reshape(-1, 7), np.array(heading).reshape(-1, 3)
        )
        return motion.between(self.boot_s - seconds, self.boot_s)

    def find_text(self, part: str, since: int = 0) -> StatusText | None:
        """Return the first text that contains a part, from index `since` on."""
        return next((each for each in self.texts[since:] if part in each.text), None)

    def _row(self, fields: Fields, names: tuple[str, ...]) -> tuple[float, ...]:
        boot_s = fields["time_boot_ms"] / constants.MS_PER_S
        self.boot_s = max(self.boot_s, boot_s)
        # JSON has null for NaN.
        nan = float("nan")
        return (boot_s, *(nan if fields[name] is None else fields[name] for name in names))

    def _take_ack(self, fields: Fields) -> None:
        command = fields["command"]
        if self.unlogged_acks[command]:
            self.unlogged_acks[command] -= 1
            return
        name = checklist.name_of(checklist.MavCommand, command)
        result = checklist.name_of(checklist.MavResult, fields["result"])
        self._transcript.add("heard", f"COMMAND_ACK {name} {result}")

    def _take_text(self, fields: Fields) -> None:
        """Join the parts of a long text: another part follows a full one with the same id."""
        part, number = fields["text"].rstrip("\0"), fields.get("id", 0)
        partial_number, partial = self._partial_text
        whole = partial + part if number and number == partial_number else part
        if number and len(part) >= FULL_TEXT:
            self._partial_text = number, whole
            return
        self._partial_text = 0, ""
        whole = whole.strip()
        self.texts.append(StatusText(self.boot_s, whole))
        self._transcript.add("heard", f'STATUSTEXT {fields["severity"]} "{whole}"')

    def _take_heartbeat(self, fields: Fields, previous: Fields | None) -> None:
        def state(beat: Fields) -> tuple[int, bool, int]:
            return (
                beat["custom_mode"],
                bool(beat["base_mode"] & checklist.ARMED_FLAG),
                beat["system_status"],
            )

        if previous is not None and state(previous) == state(fields):
            return
        mode, armed, status = state(fields)
        self._transcript.add(
            "heard",
            f"HEARTBEAT {self.mode_name(mode)}, {'armed' if armed else 'disarmed'}, "
            f"system_status {status}",
        )

    def _take_landed(self, state: int) -> None:
        if not self.landed_states or self.landed_states[-1] != state:
            self.landed_states.append(state)
            self._transcript.add(
                "heard", f"EXTENDED_SYS_STATE {checklist.name_of(checklist.LandedState, state)}"
            )


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


def _hover(seconds: float) -> HeldSetpoint:
    return HeldSetpoint(STOP_NED, seconds)


def _hover_body(seconds: float) -> HeldSetpoint:
    return HeldSetpoint(STOP_BODY, seconds)


def _leg(seconds: float, *step: Any) -> HeldSetpoint:
    """Return the leg of a `SetpointStep`."""
    measured = SetpointStep(*step)
    return HeldSetpoint(measured.setpoint, seconds, measured)


# Settling time by PX4's and ArduPilot's measurements, plus one second.
NORTH_2 = _leg(5.0, "north-2", "north", 0.0, 2.0), _leg(5.0, "north-2-stop", "north", 2.0, 0.0)
NORTH_5 = _leg(6.0, "north-5", "north", 0.0, 5.0), _leg(6.0, "north-5-stop", "north", 5.0, 0.0)
UP_2, DOWN_1 = _leg(5.0, "up-2", "down", 0.0, -2.0), _leg(8.0, "down-1", "down", 0.0, 1.0)
YAWSPEED_30 = _leg(4.0, "yawspeed-30", "heading rate", 0.0, 30.0)
MANOEUVRES: tuple[tuple[HeldSetpoint, ...], ...] = (
    (_hover(2.0), *NORTH_2),
    (_hover(1.0), *NORTH_5),
    (_hover(1.0), _leg(5.0, "east-2", "east", 0.0, 2.0), _hover(3.0)),
    (_hover_body(2.0), _leg(5.0, "forward-2", "forward", 0.0, 2.0), _hover_body(3.0)),
    (_hover(2.0), UP_2, _hover(4.0), DOWN_1, _hover(2.0)),
    (_hover(2.0), _leg(5.0, "yaw-90", "heading", 0.0, 90.0), _hover(4.0)),
    (_hover_body(2.0), YAWSPEED_30, _hover_body(2.0), _hover(4.0)),
)
"""Manoeuvres in flight order, each from a hover facing north. One pass: 40 m north, 10 m east, 10 m
up; a second, mirrored pass returns."""


def plan(names: Collection[str], *, mirrored: bool) -> list[HeldSetpoint]:
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
        yaw = float(frames.wrap_pi(before[-1, 1]))
        values = velocity[:, 0] * math.cos(yaw) + velocity[:, 1] * math.sin(yaw)
    else:
        values = velocity[:, ("north", "east", "down").index(step.quantity)]
    change = VELOCITY_CHANGE if step.unit == "m/s" else ANGLE_CHANGE
    return step_response(times_s - sent_s, values, step.before, step.after, change)
