"""Step responses against PX4's, measured on an external airframe like the shipped quad.

The reference: PX4 1.16 on a 1.5 kg quad with 0.25 N/(m/s) of drag and 30 ms rotors, setpoints at
20 Hz through MAVSDK, read from LOCAL_POSITION_NED and ATTITUDE at 100 Hz. Measured in the same way
here: from sending (at any time between two ticks) to the message that shows it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from flight_rig import NAN, Rig, flight, velocity_setpoint

from airl_mav.constants import TICK_US, US_PER_S
from airl_mav.frames import quat_yaw, wrap_pi
from firmware_sim.autopilot.state import Setpoint

MESSAGE_US = 10_000
NORTH, DOWN = 0, 2
Reading = Callable[[Rig], float]

TOLERANCE = 0.15
"""What may lie between us and a single run of PX4."""


@dataclass
class Response:
    """One step as a ground station sees it: times [s] from sending, values as 0 -> 1."""

    times: np.ndarray
    share: np.ndarray
    size: float
    """Of the step, in its unit."""

    def first(self, share: float) -> float:
        return float(self.times[np.argmax(self.share >= share)])

    def latency(self, change: float) -> float:
        """Return when the value has moved by `change` towards the setpoint."""
        return self.first(self.share[0] + change / abs(self.size))

    @property
    def rise(self) -> float:
        return self.first(0.9) - self.first(0.1)

    @property
    def overshoot(self) -> float:
        return float(self.share.max()) - 1.0

    def settled(self, band: float) -> float:
        outside = np.nonzero(np.abs(self.share - 1.0) > band)[0]
        return float(self.times[outside[-1]])


class Telemetry:
    """Messages at 100 Hz: the newest state at the first tick at or after they are due."""

    def __init__(self, rig: Rig, *readings: Reading) -> None:
        self._rig, self._readings = rig, readings
        self._due_us = rig.sim.time_us
        self.rows: list[tuple[float, ...]] = []

    def tick(self) -> None:
        now = self._rig.sim.time_us
        self._rig.tick()
        if now >= self._due_us:
            self._due_us += MESSAGE_US
            self.rows.append((now, *(read(self._rig) for read in self._readings)))


def respond(
    rig: Rig,
    rng: np.random.Generator,
    setpoint: Setpoint,
    before: float,
    after: float,
    seconds: float,
    *readings: Reading,
) -> list[Response]:
    """Fly a step from a steady state and return what each reading shows of it."""
    messages = Telemetry(rig, *readings)
    for _ in range(int(rng.integers(50, 60))):
        messages.tick()
    quiet = len(messages.rows)
    sent_us = rig.sim.time_us - int(rng.integers(TICK_US))
    rig.stream(setpoint)
    while rig.sim.time_us < sent_us + seconds * US_PER_S:
        messages.tick()
    rows = np.array(messages.rows)
    times = (rows[quiet:, 0] - sent_us) / US_PER_S
    responses = []
    for column in range(1, rows.shape[1]):
        share = (rows[:, column] - before) / (after - before)
        # One value from before the step, averaged: the latency counts from there.
        share = np.concatenate([[share[:quiet].mean()], share[quiet:]])
        responses.append(Response(np.concatenate([[0.0], times]), share, after - before))
    return responses


def estimated_velocity(axis: int) -> Reading:
    return lambda rig: float(rig.ap.state().estimate.velocity[axis])


def true_velocity(axis: int) -> Reading:
    return lambda rig: float(rig.truth.velocity[axis])


def estimated_heading(rig: Rig) -> float:
    return wrap_pi(quat_yaw(rig.ap.state().estimate.quaternion))


def true_heading(rig: Rig) -> float:
    return wrap_pi(quat_yaw(rig.truth.quaternion))


def velocity_steps(
    axis: int, speed: float, seconds: float, seeds: range
) -> tuple[list[list[Response]], list[list[Response]]]:
    """Fly 0 -> speed -> 0 twice a seed; return the steps up and down, each (estimate, truth)."""
    up, down = [], []
    for seed in seeds:
        rng = np.random.default_rng(1000 + seed)
        readings = estimated_velocity(axis), true_velocity(axis)
        go = [0.0, 0.0, 0.0]
        go[axis] = speed
        with flight(seed) as rig:
            rig.take_off(4.0, settle_s=1.0)
            rig.go_offboard(velocity_setpoint(0, 0, 0))
            rig.run(3.0)
            for _ in range(2):
                sp = velocity_setpoint(*go)
                up.append(respond(rig, rng, sp, 0.0, speed, seconds, *readings))
                sp = velocity_setpoint(0, 0, 0)
                down.append(respond(rig, rng, sp, speed, 0.0, seconds, *readings))
    return up, down


def mean(responses: list[list[Response]], column: int, what: Callable[[Response], float]) -> float:
    return float(np.mean([what(r[column]) for r in responses]))


ESTIMATE, TRUTH = 0, 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("speed", "latency_up", "latency_down", "rise", "overshoot"),
    [(2.0, 0.141, 0.144, 1.02, 0.033), (5.0, 0.112, 0.124, 1.07, 0.031)],
)
def test_horizontal_velocity(
    speed: float, latency_up: float, latency_down: float, rise: float, overshoot: float
) -> None:
    up, down = velocity_steps(NORTH, speed, 6.0, range(2))
    for column in (ESTIMATE, TRUTH):
        for steps, latency in ((up, latency_up), (down, latency_down)):
            found = mean(steps, column, lambda r: r.latency(0.05))
            assert found == pytest.approx(latency, rel=TOLERANCE)
            assert mean(steps, column, lambda r: r.rise) == pytest.approx(rise, rel=TOLERANCE)
            assert abs(mean(steps, column, lambda r: r.overshoot) - overshoot) < 0.02
            assert max(r[column].overshoot for r in steps) <= 0.10
            assert mean(steps, column, lambda r: float(r.share[-100:].mean())) == pytest.approx(
                1.0, abs=0.03
            )


def yaw_steps(seeds: range) -> list[list[Response]]:
    quarter = math.pi / 2
    steps = []
    for seed in seeds:
        rng = np.random.default_rng(2000 + seed)
        with flight(seed) as rig:
            rig.take_off(4.0, settle_s=1.0)
            rig.go_offboard(velocity_setpoint(0, 0, 0))
            rig.run(2.0)
            for before, after in ((0.0, quarter), (quarter, 0.0)) * 2:
                sp = velocity_setpoint(0, 0, 0, yaw=after)
                readings = estimated_heading, true_heading
                steps.append(respond(rig, rng, sp, before, after, 5.0, *readings))
    return steps


@pytest.mark.slow
def test_heading() -> None:
    steps = yaw_steps(range(2))
    half_a_degree = math.radians(0.5)
    assert mean(steps, ESTIMATE, lambda r: r.latency(half_a_degree)) == pytest.approx(
        0.100, rel=TOLERANCE
    )
    for column in (ESTIMATE, TRUTH):
        assert mean(steps, column, lambda r: r.rise) == pytest.approx(0.41, rel=TOLERANCE)
        assert mean(steps, column, lambda r: r.first(0.5)) == pytest.approx(0.46, rel=TOLERANCE)
        assert mean(steps, column, lambda r: r.overshoot) == pytest.approx(0.159, abs=0.04)
        assert max(r[column].overshoot for r in steps) <= 0.20
        # The heading error left at the end: half a degree of magnetometer and gyro bias.
        end = mean(steps, column, lambda r: float(r.share[-100:].mean()))
        assert abs(end - 1.0) * 90.0 < 1.0


def heading_rate(rig: Rig) -> float:
    return float(rig.ap.state().estimate.angular_velocity[2])


@pytest.mark.slow
def test_heading_rate() -> None:
    steps = []
    rate = math.radians(30.0)
    for seed in range(2):
        rng = np.random.default_rng(3000 + seed)
        with flight(seed) as rig:
            rig.take_off(4.0, settle_s=1.0)
            rig.go_offboard(velocity_setpoint(0, 0, 0, yaw=NAN, yaw_rate=0.0))
            rig.run(2.0)
            for before, after in ((0.0, rate), (rate, 0.0)) * 2:
                sp = velocity_setpoint(0, 0, 0, yaw=NAN, yaw_rate=after)
                steps.append(respond(rig, rng, sp, before, after, 3.0, heading_rate))
    assert mean(steps, ESTIMATE, lambda r: r.rise) == pytest.approx(0.26, rel=TOLERANCE)
    assert mean(steps, ESTIMATE, lambda r: r.first(0.5)) == pytest.approx(0.23, rel=TOLERANCE)
    assert mean(steps, ESTIMATE, lambda r: r.overshoot) == pytest.approx(0.138, abs=0.05)


def test_descent() -> None:
    steps = []
    for seed in range(2):
        rng = np.random.default_rng(4000 + seed)
        with flight(seed) as rig:
            rig.take_off(10.0, settle_s=1.0)
            rig.go_offboard(velocity_setpoint(0, 0, 0))
            rig.run(2.0)
            readings = estimated_velocity(DOWN), true_velocity(DOWN)
            sp = velocity_setpoint(0, 0, 1.0)
            steps.append(respond(rig, rng, sp, 0.0, 1.0, 4.0, *readings))
    for column in (ESTIMATE, TRUTH):
        assert mean(steps, column, lambda r: r.rise) == pytest.approx(0.37, rel=TOLERANCE)
        assert mean(steps, column, lambda r: r.first(0.5)) == pytest.approx(0.18, rel=TOLERANCE)
        assert mean(steps, column, lambda r: r.overshoot) == pytest.approx(0.058, abs=0.03)
