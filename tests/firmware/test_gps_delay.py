"""Delayed GPS fixes in the estimator, with and without an assumed delay (EKF2_GPS_DELAY).

The vehicle stands, accelerates north, then keeps a constant velocity. The error of a fix of `d`
seconds ago has a closed form: `a d` in velocity during acceleration, and `v d - a d²/2` in
position.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from airl_mav.core.constants import TICK_S
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.error_state import SIMULATED_MS, FusionHorizon
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.interfaces import SensorSample
from tests.firmware.test_estimator import VALUE, Flight

REST_S = 3.5
SPEED = 3.0
AFTER_S = 2.5


@dataclass
class Dash(Flight):
    """Rest, a constant acceleration, a constant velocity."""

    acceleration: float = 1.0

    def motion(self, t: float) -> tuple[np.ndarray, np.ndarray, Rotation]:
        moving = max(0.0, t - REST_S)
        faster = min(moving, SPEED / self.acceleration)
        north = 0.5 * self.acceleration * faster**2 + SPEED * (moving - faster)
        velocity = np.array([self.acceleration * faster, 0.0, 0.0])
        return np.array([north, 0.0, -2.0]), velocity, Rotation.from_euler("Z", 0.3)


class Seen(NamedTuple):
    """Result of one fix."""

    time_s: float
    position: float
    """Innovation to the north [m]."""
    velocity: float
    ratio: float
    lag_m: float
    """True less estimated position to the north."""


@cache
def flown(acceleration: float, noise: float) -> list[tuple[SensorSample, np.ndarray]]:
    """Return the samples of a dash, and the true position of each."""
    seconds = REST_S + SPEED / acceleration + AFTER_S
    dash = Dash(seconds, np.zeros(3), np.zeros(3), noise, acceleration=acceleration)
    return [(sample, place) for sample, place, *_ in dash.samples()]


def late(
    delay_s: float, acceleration: float, noise: float
) -> Iterator[tuple[SensorSample, np.ndarray]]:
    """Yield samples whose fixes come later, and the true position."""
    ticks, fixes = round(delay_s / TICK_S), []
    for sample, place in flown(acceleration, noise):
        fixes.append(sample.gps)
        due = fixes[-1 - ticks] if len(fixes) > ticks else None
        yield sample._replace(gps=due), place


def seen(
    delay_s: float,
    assumed_ms: float = SIMULATED_MS,
    *,
    acceleration: float = 1.0,
    noise: float = 0.0,
) -> list[Seen]:
    """Return what an estimator makes of each fix from the start of the motion on."""

    def value(name: str) -> float:
        return assumed_ms if name == "EKF2_GPS_DELAY" else VALUE(name)

    estimator = Estimator(value)
    innovation = np.zeros(4)

    def note(name: str, found: np.ndarray, _: np.ndarray) -> None:
        if name == "gps_horizontal":
            innovation[:] = found

    estimator.innovations = note
    fixes = []
    for sample, place in late(delay_s, acceleration, noise):
        estimator.step(sample)
        time_s = sample.time_us / 1e6
        if sample.gps is not None and time_s >= REST_S:
            lag_m = place.item(0) - estimator.state.item(es.P)
            ratio = estimator.state.item(es.RATIO)
            found = innovation.item(0), innovation.item(2)
            fixes.append(Seen(time_s - REST_S, *found, ratio, lag_m))
    return fixes


def test_innovations_of_a_late_receiver_grow_with_speed_and_are_refused() -> None:
    """Refused fixes leave the dead reckoning alone, so that innovations are the closed form's."""
    delay_s, acceleration = 0.4, 2.9
    faster = [
        fix
        for fix in seen(delay_s, acceleration=acceleration)
        if delay_s <= fix.time_s < SPEED / acceleration
    ]
    assert len(faster) >= 6
    for fix in faster:
        speed = acceleration * fix.time_s
        assert fix.velocity == pytest.approx(-acceleration * delay_s, abs=0.02)
        expected = -(speed * delay_s - 0.5 * acceleration * delay_s**2)
        assert fix.position == pytest.approx(expected, abs=0.02)
        assert fix.ratio > 1.0, "reported, and not fused"
        assert abs(fix.lag_m) < 0.02


def test_a_little_too_late_is_flown_by_and_the_position_lags() -> None:
    """At constant speed the delay is unobservable: the estimate lags by v d."""
    delay_s = 0.2
    assert seen(delay_s)[-1].lag_m == pytest.approx(SPEED * delay_s, rel=0.2)


def test_a_delay_that_is_assumed_costs_nothing() -> None:
    delay_s = 0.2
    punctual = seen(0.0, noise=1.0)
    known = seen(delay_s, SIMULATED_MS + 1000.0 * delay_s, noise=1.0)
    for fixes in (punctual, known):
        assert max(fix.ratio for fix in fixes) < 0.6
        assert max(abs(fix.lag_m) for fix in fixes) < 0.15
    # Too much is as wrong as too little: the position is ahead.
    early = seen(0.0, SIMULATED_MS + 1000.0 * delay_s)
    assert early[-1].lag_m == pytest.approx(-SPEED * delay_s, rel=0.2)


def test_the_horizon_is_where_the_vehicle_was() -> None:
    horizon, state = FusionHorizon(), es.new_state()
    horizon.assume(SIMULATED_MS)
    assert not horizon.is_past
    horizon.assume(SIMULATED_MS + 40.0)
    assert horizon.is_past
    history = []
    for tick in range(30):
        before = state[es.P : es.Q].copy()
        state[es.P : es.Q] += 0.1 * tick
        horizon.moved(before, state[es.P : es.Q])
        history.append(state[es.P : es.Q].copy())
    np.testing.assert_allclose(horizon.seen_from(state), history[-11])
    # A correction of the present also applies to the past.
    state[es.P : es.Q] += 5.0
    np.testing.assert_allclose(horizon.seen_from(state), history[-11] + 5.0)
