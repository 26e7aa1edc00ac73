"""Hover on the estimator alone: where the vehicle really is, and how well it knows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from airl_mav.core.constants import GRAVITY_M_S2, TICK_US, US_PER_S
from airl_mav.core.frames import quat_wxyz_to_xyzw
from airl_mav.profiles.vehicle import WindSettings
from tests.support.flight_rig import Rig, flight, quad

SECONDS = 60.0
EVERY = 10
"""Ticks between two looks."""


@dataclass
class Hover:
    positions: np.ndarray  # (n, 3) true, relative to where it began [m]
    speeds: np.ndarray  # (n,) true [m/s]
    attitude_errors: np.ndarray  # (n, 3) estimate against truth, rotation vector [rad]
    tilts: np.ndarray  # (n,) true tilt [rad]


def hover(rig: Rig) -> Hover:
    rig.take_off(5.0, settle_s=5.0)
    start = rig.truth.position.copy()
    positions, speeds, errors, tilts = [], [], [], []
    for _ in range(round(SECONDS * US_PER_S / (EVERY * TICK_US))):
        rig.run((EVERY - 1) * TICK_US / US_PER_S)
        rig.tick()
        truth = rig.truth
        estimate = rig.ap.state().estimate
        assert estimate.time_us == truth.time_us
        really = Rotation.from_quat(quat_wxyz_to_xyzw(truth.quaternion))
        guess = Rotation.from_quat(quat_wxyz_to_xyzw(estimate.quaternion))
        positions.append(truth.position - start)
        speeds.append(np.linalg.norm(truth.velocity))
        errors.append((guess.inv() * really).as_rotvec())
        tilts.append(math.acos(min(1.0, really.apply([0.0, 0.0, 1.0])[2])))
    return Hover(np.array(positions), np.array(speeds), np.array(errors), np.array(tilts))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.nightly)])
def test_it_stays_where_it_hovers(seed: int) -> None:
    with flight(seed) as rig:
        flown = hover(rig)
    away = np.linalg.norm(flown.positions, axis=1)
    assert away.max() < 0.5
    assert np.sqrt((flown.speeds**2).mean()) < 0.1
    rms = np.degrees(np.sqrt((flown.attitude_errors**2).mean(axis=0)))
    # Hovering, a tilt error and a horizontal accelerometer bias look the same.
    unseen = np.degrees(quad().sensors.imu.accel_bias_m_s2 / GRAVITY_M_S2)
    assert np.all(rms[:2] < 3.0 * unseen)
    assert rms[2] < 1.0
    assert math.degrees(flown.tilts.max()) < 5.0
    assert rig.sim.plant.collisions == []


@pytest.mark.slow
def test_gusts_move_it_but_do_not_blow_it_away() -> None:
    wind = WindSettings(north_m_s=3.0, east_m_s=-4.0, gust_m_s=1.0)
    with flight(3, wind=wind) as rig:
        flown = hover(rig)
    assert np.linalg.norm(flown.positions, axis=1).max() < 1.0
    # It leans into 5 m/s of wind: drag 0.25 N/(m/s) against the weight of 1.5 kg.
    lean = math.degrees(math.atan2(0.25 * 5.0, 1.5 * 9.80665))
    assert math.degrees(flown.tilts.mean()) == pytest.approx(lean, rel=0.15)
