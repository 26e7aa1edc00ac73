"""Distinction between failed sensors and noise in the estimator."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.recovery import (
    GREATEST,
    LEAST,
    REFUSED_US,
    Compass,
    Consistency,
    Restart,
    restart_for,
)
from firmware_sim.engine.record import new_controller

GPS_US = 100_000
MAG_US = 20_000
SIGMA = np.full(3, 0.06)
STEADY = np.zeros(3)


def velocities(watch: Consistency, innovations: Iterable[np.ndarray]) -> list[int]:
    """Return the times of restarts [µs]."""
    times = (i * GPS_US for i, _ in enumerate(iter(int, 1)))
    return [
        now_us
        for now_us, innovation in zip(times, innovations, strict=False)
        if watch.velocity(innovation, SIGMA, STEADY, now_us) is not None
    ]


@pytest.mark.parametrize("times", [1.0, 5.0])
def test_noise_is_no_reason_to_restart(times: float) -> None:
    rng = np.random.default_rng(1)
    watch = Consistency(new_controller())
    noise = times * SIGMA * rng.standard_normal((20_000, 3))
    assert velocities(watch, noise) == [], "over half an hour"
    expected = 1.0 if times == 1.0 else pytest.approx(times**2, rel=0.7)
    assert watch.velocity_excess == expected


def test_an_error_that_grows_is() -> None:
    """0.5 m/s² of accelerometer: beyond three standard deviations after 0.36 s, for 0.5 s."""
    rng = np.random.default_rng(1)
    growing = [np.array([0.05 * k, 0, 0]) + SIGMA * rng.standard_normal(3) for k in range(11)]
    (at_us,) = velocities(Consistency(new_controller()), growing)
    assert at_us <= 1.0 * US_PER_S


def test_an_outlier_is_neither() -> None:
    watch = Consistency(new_controller())
    far = [np.zeros(3)] * 20 + [np.full(3, 50.0)] + [np.zeros(3)] * 20
    assert velocities(watch, far) == []
    excess = []
    watch = Consistency(new_controller())
    for i, innovation in enumerate(far):
        watch.velocity(innovation, SIGMA, STEADY, i * GPS_US)
        excess.append(watch.velocity_excess)
    assert set(excess) == {1.0}, "its own gate must refuse it"
    watch.velocity(np.full(3, np.nan), SIGMA, STEADY, 0)
    assert watch.velocity_excess == 1.0


def test_what_a_restart_allows_for() -> None:
    assert restart_for(0.0, 0.5) == Restart(0.3, *LEAST[1:])
    fast = restart_for(-3.0, 1.0)
    assert fast.velocity_m_s == 3.0
    assert fast.accel_bias_m_s2 == 3.0
    assert restart_for(1e3, 0.1) == Restart(10.0, *GREATEST[1:])


def test_a_gyro_turns_the_heading_slowly_a_compass_at_once() -> None:
    drifting = Consistency(new_controller())
    found = [
        drifting.heading(0.06 * k, k * MAG_US, within=0.06 * k <= 5.0) is not None
        for k in range(100)
    ]
    assert found.index(True) * MAG_US < 1.6 * US_PER_S
    jumped = Consistency(new_controller())
    for k in range(500):
        assert jumped.heading(0.0 if k < 10 else 12.0, k * MAG_US, within=k < 10) is None


def test_a_compass_that_was_refused_must_come_back_as_close_as_it_was() -> None:
    compass = Compass()
    compass.tested(0.01, 0.1, 0)
    assert compass.admits(3.0), "the gate alone decides"
    compass.tested(0.5, 5.0, MAG_US)  # a gate of 0.1 rad
    compass.tested(0.5, 4.0, 2 * MAG_US)
    assert not compass.given_up
    compass.tested(0.5, 2.0, MAG_US + REFUSED_US)
    assert compass.given_up
    assert not compass.admits(-0.11)
    assert compass.admits(0.09)
    compass.tested(0.09, 0.3, 2 * REFUSED_US)
    assert not compass.given_up


def test_a_late_receiver_is_no_reason_either() -> None:
    """0.2 s behind a vehicle that brakes with 3 m/s²: 10 standard deviations, on one side."""
    watch = Consistency(new_controller())
    braking = np.array([-3.0, 0.0, 0.0])
    behind = np.array([0.6, 0.0, 0.0])
    for sample in range(20):
        assert watch.velocity(behind, SIGMA, braking, sample * GPS_US) is None
    assert watch.velocity_excess == 1.0
