"""Step responses against PX4's.

Two references. The stored column: PX4 1.16 on a 1.5 kg quad with 0.25 N/(m/s) of drag and 30 ms
rotors, one run, setpoints at 20 Hz through MAVSDK, read from LOCAL_POSITION_NED and ATTITUDE at
100 Hz. And PX4 1.16 flown on this project's own plant, five seeds, the truth at every tick. Here:
from sending (at any time between two ticks) to the message, or the tick, that shows it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest

from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.frames import heading_to_ned, quat_yaw, wrap_pi
from firmware_sim.autopilot.autopilot_state import Setpoint
from tests.support.flight_rig import NAN, SETPOINT_US, Rig, flight, velocity_setpoint

MESSAGE_US = 10_000
NORTH, EAST, DOWN = 0, 1, 2
Reading = Callable[[Rig], float]
Command = Callable[[Rig], Setpoint]

TOLERANCE = 0.10
"""Relative tolerance of rise time and latency."""

POINTS = 0.05
"""Tolerance of overshoot."""

RESOLUTION_S = 0.010
"""Resolution of times in the stored column, from messages of one run."""


class Figures(NamedTuple):
    latency: float
    """From sending to a change of 50 mm/s, 0.5 deg or 0.5 deg/s [s]."""
    rise: float
    """From 10 to 90 % of the step [s]."""
    overshoot: float
    """Share of the step."""


@dataclass
class Response:
    """One step: times [s] from sending, values as 0 -> 1."""

    times: np.ndarray
    share: np.ndarray
    size: float
    """Size of the step, in its unit."""

    def first(self, share: float) -> float:
        return float(self.times[np.argmax(self.share >= share)])

    def figures(self, change: float) -> Figures:
        """Return the figures; the latency is to a value moved by `change`."""
        return Figures(
            self.first(self.share[0] + change / abs(self.size)),
            self.first(0.9) - self.first(0.1),
            float(self.share.max()) - 1.0,
        )

    @property
    def end(self) -> float:
        """Final value: the mean of the last second."""
        return float(self.share[self.times > self.times[-1] - 1.0].mean())


class Quantity(NamedTuple):
    """Quantity that a step changes."""

    told: Reading
    """Value in telemetry."""
    true: Reading
    change: float
    """Minimum change that counts as a reaction."""


def velocity(axis: int) -> Quantity:
    return Quantity(
        lambda rig: float(rig.ap.state().estimate.velocity[axis]),
        lambda rig: float(rig.truth.velocity[axis]),
        0.05,
    )


HEADING = Quantity(
    lambda rig: wrap_pi(quat_yaw(rig.ap.state().estimate.quaternion)),
    lambda rig: wrap_pi(quat_yaw(rig.truth.quaternion)),
    math.radians(0.5),
)
TURNING = Quantity(
    lambda rig: float(rig.ap.state().estimate.angular_velocity[2]),
    lambda rig: float(rig.truth.angular_velocity[2]),
    math.radians(0.5),
)


def ned(north: float, east: float, down: float, yaw: float = 0.0) -> Command:
    """Command as set_velocity_ned does."""
    setpoint = velocity_setpoint(north, east, down, yaw=yaw)
    return lambda rig: setpoint


def body(forward: float, yaw_rate: float) -> Command:
    """Command as set_velocity_body does: turned by the heading when it arrives."""

    def command(rig: Rig) -> Setpoint:
        heading = quat_yaw(rig.ap.state().estimate.quaternion)
        north, east, down = heading_to_ned(np.array([forward, 0.0, 0.0]), heading)
        return velocity_setpoint(north, east, down, yaw=NAN, yaw_rate=yaw_rate)

    return command


class Pilot:
    """Sends a command at 20 Hz; writes down telemetry at 100 Hz and the truth at every tick."""

    def __init__(self, rig: Rig, quantity: Quantity, command: Command) -> None:
        self._rig, self._quantity = rig, quantity
        self._told_us = rig.sim.time_us
        self.told: list[tuple[int, float]] = []
        self.true: list[tuple[int, float]] = []
        self.order(command)

    def order(self, command: Command) -> None:
        self._command, self._next_us = command, self._rig.sim.time_us

    def tick(self) -> None:
        rig, now = self._rig, self._rig.sim.time_us
        if now >= self._next_us:
            self._next_us += SETPOINT_US
            rig.ap.offer_setpoint(self._command(rig), now)
        rig.tick()
        if now >= self._told_us:
            self._told_us += MESSAGE_US
            self.told.append((now, self._quantity.told(rig)))
        self.true.append((rig.sim.time_us, self._quantity.true(rig)))

    def fly(self, ticks: int) -> None:
        for _ in range(ticks):
            self.tick()


class Row(NamedTuple):
    """Response of PX4."""

    stored: Figures
    """On an external airframe, in its telemetry."""
    here: Figures
    """On this plant, in truth."""


class Step(NamedTuple):
    """A step of one quantity from 0, and the way back."""

    quantity: Quantity
    size: float
    there: Command
    back: Command
    seconds: float
    up: Row
    down: Row | None = None
    """Response to the step back; None = not measured on PX4."""


def respond(
    pilot: Pilot,
    rng: np.random.Generator,
    command: Command,
    seconds: float,
    span: tuple[float, float],
) -> tuple[Response, Response]:
    """Fly a step from a steady state; return its response in telemetry and in truth."""
    pilot.fly(int(rng.integers(50, 60)))
    sent_us = pilot.true[-1][0] - int(rng.integers(TICK_US))
    pilot.order(command)
    pilot.fly(round(seconds * US_PER_S / TICK_US))
    before, after = span
    told, true = (_response(rows, sent_us, before, after) for rows in (pilot.told, pilot.true))
    return told, true


def _response(rows: list[tuple[int, float]], sent_us: int, before: float, after: float) -> Response:
    series = np.array(rows)
    times = (series[:, 0] - sent_us) / US_PER_S
    share = (series[:, 1] - before) / (after - before)
    # One value from before the step, averaged: the latency counts from there.
    quiet = share[(times > -0.2) & (times <= 0.0)].mean()
    late = times > 0.0
    return Response(
        np.concatenate([[0.0], times[late]]), np.concatenate([[quiet], share[late]]), after - before
    )


Shown = list[tuple[Response, Response]]
"""Responses of several steps in telemetry and in truth."""


def fly(step: Step) -> tuple[Shown, Shown]:
    """Fly a step twice with each of three seeds; return the ways there and back."""
    up: Shown = []
    down: Shown = []
    for seed in range(3):
        rng = np.random.default_rng(1000 + seed)
        with flight(seed) as rig:
            rig.take_off(12.0, settle_s=1.0)
            rig.go_offboard(step.back(rig))
            rig.stream(None)
            pilot = Pilot(rig, step.quantity, step.back)
            pilot.fly(round(3.0 * US_PER_S / TICK_US))
            for _ in range(2):
                up.append(respond(pilot, rng, step.there, step.seconds, (0.0, step.size)))
                down.append(respond(pilot, rng, step.back, step.seconds, (step.size, 0.0)))
    return up, down


def mean(shown: Shown, which: int, change: float) -> Figures:
    return Figures(*np.mean([s[which].figures(change) for s in shown], axis=0).tolist())


TOLD, TRUE = 0, 1
STOP, TURN_STOP = ned(0.0, 0.0, 0.0), body(0.0, 0.0)
QUARTER, RATE = math.pi / 2, math.radians(30.0)
STEPS = {
    "north 2": Step(
        velocity(NORTH),
        2.0,
        ned(2.0, 0.0, 0.0),
        STOP,
        6.0,
        Row(Figures(0.141, 1.02, 0.033), Figures(0.140, 1.035, 0.022)),
        Row(Figures(0.144, 1.02, 0.027), Figures(0.140, 1.057, 0.012)),
    ),
    "north 5": Step(
        velocity(NORTH),
        5.0,
        ned(5.0, 0.0, 0.0),
        STOP,
        6.0,
        Row(Figures(0.112, 1.08, 0.031), Figures(0.116, 1.083, 0.019)),
        Row(Figures(0.124, 1.06, 0.032), Figures(0.124, 1.101, 0.017)),
    ),
    "east 2": Step(
        velocity(EAST),
        2.0,
        ned(0.0, 2.0, 0.0),
        STOP,
        6.0,
        Row(Figures(0.141, 1.03, 0.034), Figures(0.142, 1.037, 0.022)),
    ),
    "forward 2": Step(
        velocity(NORTH),
        2.0,
        body(2.0, 0.0),
        TURN_STOP,
        6.0,
        Row(Figures(0.139, 1.01, 0.034), Figures(0.143, 1.034, 0.021)),
    ),
    "up 2": Step(
        velocity(DOWN),
        -2.0,
        ned(0.0, 0.0, -2.0),
        STOP,
        4.0,
        Row(Figures(0.035, 0.53, 0.094), Figures(0.035, 0.375, 0.053)),
    ),
    "down 1": Step(
        velocity(DOWN),
        1.0,
        ned(0.0, 0.0, 1.0),
        STOP,
        4.0,
        Row(Figures(0.050, 0.37, 0.058), Figures(0.043, 0.375, 0.071)),
    ),
    "yaw 90": Step(
        HEADING,
        QUARTER,
        ned(0.0, 0.0, 0.0, QUARTER),
        STOP,
        5.0,
        Row(Figures(0.100, 0.41, 0.159), Figures(0.096, 0.396, 0.147)),
    ),
    "yaw rate 30": Step(
        TURNING,
        RATE,
        body(0.0, RATE),
        TURN_STOP,
        3.0,
        Row(Figures(0.057, 0.26, 0.138), Figures(0.053, 0.240, 0.156)),
    ),
}

# Climbing at 2 m/s, the stored airframe ran out of thrust: it takes 0.31 s to half of the step,
# against 0.18 s down, where a linear controller takes as long. On this plant PX4's own climb, as
# its telemetry shows it, rises in 0.371 s.
# On its way to 5 m/s its telemetry here shows 50 mm/s after 123 ms (standard deviation of a step:
# 7 ms), as ours does; the stored run, after 112 ms.
NOT_AS_STORED = {"up 2": ("rise",), "north 5": ("latency",)}


def differences(found: Figures, expected: Figures, resolution_s: float) -> list[str]:
    """Return what is outside the tolerances."""
    wrong = []
    for name in ("latency", "rise"):
        wanted = getattr(expected, name)
        if abs(getattr(found, name) - wanted) > max(TOLERANCE * wanted, resolution_s):
            wrong.append(name)
    if abs(found.overshoot - expected.overshoot) > POINTS:
        wrong.append("overshoot")
    return wrong


def check(shown: Shown, row: Row, change: float, excused: tuple[str, ...]) -> None:
    told, true = mean(shown, TOLD, change), mean(shown, TRUE, change)
    wrong = differences(told, row.stored, RESOLUTION_S)
    assert set(wrong) <= set(excused), (told, row.stored)
    assert not differences(true, row.here, 0.0), (true, row.here)


FAST_STEP = "down 1"
EVERY_TIME = (FAST_STEP, "yaw 90")
"""The others are flown in the night; test_conformance_flight.py flies north by 2 m/s, too."""


def _marks(name: str) -> list[pytest.MarkDecorator]:
    marks = [] if name == FAST_STEP else [pytest.mark.slow]
    return marks if name in EVERY_TIME else [*marks, pytest.mark.nightly]


@pytest.mark.parametrize("name", [pytest.param(n, marks=_marks(n)) for n in STEPS])
def test_steps_are_px4s(name: str) -> None:
    step = STEPS[name]
    up, down = fly(step)
    check(up, step.up, step.quantity.change, NOT_AS_STORED.get(name, ()))
    if step.down is not None:
        check(down, step.down, step.quantity.change, ())
    for told, true in up:
        # Final error: from the integral, half a degree of heading.
        assert told.end == pytest.approx(1.0, abs=0.05)
        assert true.end == pytest.approx(1.0, abs=0.05)
