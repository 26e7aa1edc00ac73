"""Electrical power: closed forms, scipy's root of Glauert's equation, published hover figures."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from airl_mav.core.constants import TICK_S
from airl_mav.profiles.vehicle import Momentum, VehicleProfile, load_vehicle
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.power import (
    PowerModel,
    felt,
    felt_share,
    flight_power_w,
    induced_velocity,
    level_power_w,
    momentum_power_w,
    power_model_of,
    regression_power_w,
    standing_power_w,
)
from airl_mav.vehicle.rotation import Quat, Vec
from tests.support.solo import SOLO

QUAD = load_vehicle("quad")
AIRFRAME = Airframe.from_profile(QUAD)
MODEL = PowerModel.from_profile(QUAD)
G, RHO, KAPPA = 9.80665, 1.225, 1.15
LEVEL = (1.0, 0.0, 0.0, 0.0)
ZERO = (0.0, 0.0, 0.0)


def regression(payload_kg: float = 0.0, bandwidth_hz: float = 1.0) -> PowerModel:
    body = QUAD.body.model_copy(update={"payload_kg": payload_kg})
    power = SOLO.model_copy(update={"bandwidth_hz": bandwidth_hz})
    return PowerModel.from_profile(QUAD.model_copy(update={"body": body, "power": power}))


def vehicle(mass_kg: float, diameter_m: float, fm: float, eta: float, watts: float) -> PowerModel:
    power = Momentum(
        model="momentum",
        propeller_diameter_m=diameter_m,
        figure_of_merit=fm,
        drive_efficiency=eta,
        avionics_w=watts,
    )
    body = QUAD.body.model_copy(update={"mass_kg": mass_kg})
    return PowerModel.from_profile(QUAD.model_copy(update={"body": body, "power": power}))


def hover_w(mass_kg: float, model: PowerModel) -> float:
    return momentum_power_w(mass_kg * G, 10.0 * mass_kg, 0.0, 0.0, model)


# --- momentum theory


def test_a_hover_takes_the_closed_form() -> None:
    thrust = 1.5 * G
    area = 4 * math.pi * 0.254**2 / 4
    closed = thrust**1.5 / math.sqrt(2 * RHO * area) / 0.65 / 0.68 + 5.0
    assert hover_w(1.5, MODEL) == pytest.approx(closed, rel=1e-12)
    assert level_power_w(0.0, AIRFRAME, MODEL) == pytest.approx(closed, rel=1e-12)
    assert flight_power_w(thrust, ZERO, LEVEL, ZERO, ZERO, AIRFRAME, MODEL) == pytest.approx(closed)


@pytest.mark.parametrize(
    ("mass_kg", "model", "published_w"),
    [
        # The quad: T-Motor's table of AIR2216II KV920 with T1045 at 16 V, four of them at 1.5 kg.
        (1.5, MODEL, 184.0),
        # The same, a 3DR Solo of 1.5 kg: a 77 Wh pack in 25 min and in 20 min, the mean of both.
        (1.5, MODEL, 208.0),
        # X500 class, the same motors and propellers at the 2.064 kg of PX4's Gazebo model: the
        # maker's table; and at 2.0 kg an independent stand.
        (2.064, vehicle(2.064, 0.254, 0.65, 0.68, 5.0), 276.0),
        (2.0, vehicle(2.0, 0.254, 0.65, 0.68, 5.0), 306.0),
        # ModalAI Starling 2 Max: 566 g, 180 mm propellers, a pack of 43.2 Wh lasts about 40 min.
        (0.566, vehicle(0.566, 0.18, 0.55, 0.70, 5.0), 65.0),
        # Crazyflie 2.x: bitcraze/crazyflie-firmware, pwm-to-thrust.md, 32.8 g: 2.39 A at 3.65 V.
        (0.0328, vehicle(0.0328, 0.046, 0.35, 0.50, 0.96), 8.72),
    ],
)  # fmt: skip
def test_hover_power_is_within_a_fifth_of_what_is_published(
    mass_kg: float, model: PowerModel, published_w: float
) -> None:
    assert hover_w(mass_kg, model) == pytest.approx(published_w, rel=0.2)


@given(st.floats(0.5, 10.0), st.floats(0.0, 5.0), st.floats(0.0, 2.0))
def test_induced_velocity_solves_glauerts_equation(ideal: float, u: float, climb: float) -> None:
    u, climb = u * ideal, climb * ideal
    found = induced_velocity(ideal**2, u**2, climb)
    root = brentq(lambda v: v * math.hypot(u, climb + v) - ideal**2, 0.0, 2.0 * ideal, xtol=1e-14)
    assert found == pytest.approx(root, rel=4e-4)


@pytest.mark.parametrize(
    ("velocity", "wind", "tilt_deg"),
    [
        ((8.0, 0.0, 0.0), ZERO, -12.0),
        ((8.0, -3.0, 1.0), (2.0, 1.0, -0.5), -15.0),
        ((0.0, 0.0, -3.0), ZERO, 0.0),
        ((0.0, 0.0, 3.0), ZERO, 0.0),  # A descent takes what the hover takes.
        ((5.0, 0.0, 0.0), ZERO, 20.0),  # Braking: the air comes from below.
    ],
)
def test_power_in_flight_is_the_formula_with_scipys_root(
    velocity: Vec, wind: Vec, tilt_deg: float
) -> None:
    turn = Rotation.from_euler("ZYX", [0.4, math.radians(tilt_deg), 0.05])
    x, y, z, w = turn.as_quat()
    thrust = 17.0
    air = turn.inv().apply(np.array(velocity) - np.array(wind))
    u, up = math.hypot(air[0], air[1]), max(0.0, -air[2])
    area = 4 * math.pi * 0.254**2 / 4
    v_h = math.sqrt(thrust / (2 * RHO * area))
    v_i = brentq(lambda v: v * math.hypot(u, up + v) - v_h**2, 0.0, 20.0, xtol=1e-14)
    speed = math.sqrt(thrust / (4 * QUAD.rotor.thrust_max_n)) * QUAD.rotor.speed_max_rad_s
    mu = u / (speed * 0.127)
    profile = (1 / 0.65 - KAPPA) * thrust**1.5 / math.sqrt(2 * RHO * area)
    wanted = (KAPPA * thrust * v_i + profile * (1 + 4.65 * mu**2) + thrust * up) / 0.68 + 5.0
    q: Quat = (w, x, y, z)
    found = flight_power_w(thrust, velocity, q, wind, ZERO, AIRFRAME, MODEL)
    assert found == pytest.approx(wanted, rel=3e-4)


def test_level_flight_saves_first_and_costs_then() -> None:
    """A shallow least and a rise, as measured on Iris-class quads (-8 % at 7, +50 % at 15 m/s)."""
    powers = [level_power_w(v, AIRFRAME, MODEL) for v in (0.0, 7.0, 20.0)]
    assert powers[1] < powers[0] < powers[2]


def test_drag_is_paid_for_by_the_thrust_against_it() -> None:
    """Level at 12 m/s with 0.05 N/(m/s)²: the tilt of the thrust balances the drag."""
    fast = AIRFRAME._replace(drag_linear=0.0, drag_quadratic=0.05)
    drag, weight, speed = 0.05 * 12.0**2, 1.5 * G, 12.0
    lean = math.atan2(drag, weight)
    turn = (math.cos(-0.5 * lean), 0.0, math.sin(-0.5 * lean), 0.0)
    flown = flight_power_w(
        math.hypot(drag, weight), (speed, 0.0, 0.0), turn, ZERO, ZERO, fast, MODEL
    )
    assert level_power_w(speed, fast, MODEL) == pytest.approx(flown, rel=1e-9)
    without = level_power_w(speed, fast._replace(drag_quadratic=0.0), MODEL)
    # Parasite power over drive efficiency, plus additional power for the higher thrust.
    assert 1.0 < (flown - without) / (drag * speed / 0.68) < 1.4


def test_standing_rotors_take_what_their_thrust_takes_at_rest() -> None:
    assert standing_power_w(0.0, AIRFRAME, MODEL) == 5.0
    half = standing_power_w(0.5 * 1.5 * G, AIRFRAME, MODEL)
    assert half - 5.0 == pytest.approx((hover_w(1.5, MODEL) - 5.0) * 0.5**1.5, rel=1e-9)
    assert standing_power_w(0.0, AIRFRAME, regression()) == 0.0
    assert standing_power_w(1.5 * G, AIRFRAME, regression(0.1)) == pytest.approx(455.9)


@given(st.floats(0.0, 1e-3), st.floats(-30, 30), st.floats(-30, 30))
def test_rotors_that_stand_still_take_nothing(thrust: float, vx: float, vz: float) -> None:
    power = flight_power_w(thrust, (vx, 0.0, vz), LEVEL, ZERO, ZERO, AIRFRAME, MODEL)
    assert 5.0 <= power < 6.0


# --- regression


@pytest.mark.parametrize(
    ("v", "a", "wind", "payload_kg", "watts"),
    [
        (ZERO, ZERO, ZERO, 0.0, 433.9),
        ((3.0, 4.0, 0.0), ZERO, ZERO, 0.0, 433.9 - 1.526 * 5),
        (ZERO, (0.0, 2.0, 0.0), ZERO, 0.0, 433.9 + 3.934 * 2),
        ((3.0, 4.0, 0.0), (0.0, 2.0, 0.0), ZERO, 0.0, 443.818),  # -7.63 + 7.868 + 9.68
        (ZERO, ZERO, ZERO, 0.1, 455.9),
        ((0.0, 0.0, -2.0), ZERO, ZERO, 0.0, 470.15),
        ((0.0, 0.0, 2.0), (0.0, 0.0, -1.0), ZERO, 0.0, 564.593),  # 36.25 + 96.613 - 2.17
        ((3.0, 4.0, 0.0), ZERO, (1.0, -2.0, 0.0), 0.0, 419.61),  # v.w = 3 - 8 = -5
        ((100.0, 0.0, 0.0), ZERO, (-50.0, 0.0, 0.0), 0.0, 0.0),  # Never negative.
    ],
)
def test_regression_by_hand(v: Vec, a: Vec, wind: Vec, payload_kg: float, watts: float) -> None:
    model = regression(payload_kg)
    assert regression_power_w(v, a, wind, model) == pytest.approx(watts, abs=1e-9)
    assert flight_power_w(1.0, v, LEVEL, wind, a, AIRFRAME, model) == pytest.approx(watts, abs=1e-9)


@pytest.mark.parametrize(("frequency_hz", "gain"), [(0.1, 0.995), (1.0, math.sqrt(0.5)), (10, 0.1)])
def test_accelerations_pass_a_first_order_low_pass(frequency_hz: float, gain: float) -> None:
    """|H| = 1 / sqrt(1 + (f / f_c)²), at 250 Hz and at 1 kHz alike."""
    model = regression(bandwidth_hz=1.0)
    omega = 2 * math.pi * frequency_hz
    for dt in (TICK_S, 0.25 * TICK_S):
        kept = felt_share(model, dt)
        acceleration, greatest = ZERO, 0.0
        for k in range(round(20.0 / dt)):
            before, now = (math.sin(omega * t * dt) / omega for t in (k, k + 1))
            acceleration = felt(acceleration, (before, 0.0, 0.0), (now, 0.0, 0.0), kept, dt, model)
            if k * dt > 8.0:
                greatest = max(greatest, abs(acceleration[0]))
        assert greatest == pytest.approx(gain, rel=0.02)


def test_momentum_theory_asks_for_no_acceleration() -> None:
    assert felt(ZERO, ZERO, (1.0, 2.0, 3.0), felt_share(MODEL, TICK_S), TICK_S, MODEL) == ZERO


def test_a_row_is_a_model_field_by_field() -> None:
    numbers = np.arange(1.0, 18.0)
    assert len(PowerModel._fields) == len(numbers)
    assert power_model_of(numbers) == PowerModel(*numbers)
    assert power_model_of(np.array(MODEL)) == MODEL


def test_the_shipped_quads_figures() -> None:
    power = QUAD.power
    assert isinstance(power, Momentum)
    assert power.propeller_diameter_m == pytest.approx(10 * 0.0254)
    assert hover_w(QUAD.body.mass_kg, MODEL) == pytest.approx(186.1, abs=0.1)
    assert isinstance(VehicleProfile.model_validate(QUAD.model_dump()).power, Momentum)
