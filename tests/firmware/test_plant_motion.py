"""The plant driven by plain motor commands, and sensors that sample at any rate."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from airl_mav.core.constants import GRAVITY_M_S2, TICK_S, TICK_US, US_PER_S
from airl_mav.core.frames import quat_wxyz_to_xyzw
from firmware_sim.engine.ticks import is_due
from firmware_sim.interfaces import ActuatorControls
from firmware_sim.plant.plant import Plant
from tests.support.flight_rig import quad

HOVER = quad().body.mass_kg * GRAVITY_M_S2 / (4 * quad().rotor.thrust_max_n)


@pytest.fixture
def plant() -> Iterator[Plant]:
    """Return a quad 50 m up, facing north, at rest."""
    plant = Plant(quad(), None, np.random.default_rng(0))
    plant.put((0.0, 0.0, -50.0))
    yield plant
    plant.close()


def drive(plant: Plant, seconds: float, motors: tuple[float, float, float, float]) -> None:
    for _ in range(round(seconds / TICK_S)):
        plant.step(ActuatorControls(plant.truth().time_us, motors, armed=True))


def test_thrust_against_weight(plant: Plant) -> None:
    """Vertical climb with linear drag and a rotor lag, by the closed form of both."""
    body, rotor, drag = quad().body, quad().rotor, quad().drag
    command = 0.7
    drive(plant, 1.5, (command,) * 4)
    # dv/dt = (4 T s(t)² - m g - k v)/m with s(t) = s1 (1 - exp(-t/tau)), by fine steps.
    s1, v, h, dt = math.sqrt(command), 0.0, 50.0, 1e-5
    for i in range(150_000):
        s = s1 * (1 - math.exp(-i * dt / rotor.time_constant_s))
        lift = 4 * rotor.thrust_max_n * s * s
        v += dt * ((lift - drag.linear_n_s_m * v) / body.mass_kg - GRAVITY_M_S2)
        h += dt * v
    truth = plant.truth()
    assert -truth.velocity[2] == pytest.approx(v, rel=0.01)
    assert -truth.position[2] - 50.0 == pytest.approx(h - 50.0, rel=0.02)
    np.testing.assert_allclose(truth.position[:2], 0.0, atol=1e-9)


def test_more_thrust_in_front_right_rolls_left_and_lifts_the_nose(plant: Plant) -> None:
    drive(plant, 0.1, (HOVER * 1.2, HOVER, HOVER, HOVER))
    roll, pitch, yaw = plant.truth().angular_velocity
    assert roll < -0.05
    assert pitch > 0.05
    assert yaw > 0.0
    turn = Rotation.from_quat(quat_wxyz_to_xyzw(plant.truth().quaternion))
    yaw, pitch, roll = turn.as_euler("ZYX")
    assert roll < 0 < pitch
    assert yaw > 0


@given(st.floats(1.0, 250.0), st.integers(0, 10_000_000))
def test_any_rate_is_kept_without_drift(rate_hz: float, start: int) -> None:
    start -= start % TICK_US
    schedule = np.array([rate_hz, 0.0, 0.0])
    times = [t for t in range(start, start + 4_000_000, TICK_US) if is_due(schedule, t)]
    period = US_PER_S / rate_hz
    # The first one at once, the others in step with the period.
    assert len(times) == pytest.approx(4.0 * rate_hz, abs=2.01)
    # Each sample at the first tick of its period.
    periods = np.array([math.floor(t / period + 1e-9) for t in times])
    assert np.all(np.diff(periods) >= 1)
    late = (np.array(times) - periods * period)[1:]
    assert np.all((late >= -1e-3) & (late < TICK_US + 1e-3))


def test_a_rate_makes_nothing_up_for_a_pause() -> None:
    schedule = np.array([10.0, 0.0, 0.0])
    assert is_due(schedule, 0)
    assert is_due(schedule, 1_050_000)
    assert not is_due(schedule, 1_098_000)
    assert is_due(schedule, 1_100_000)
