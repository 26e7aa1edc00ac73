"""The F-1 model's closed forms."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from airl_mav.latency.stages import f1_knee_hz, f1_velocity, max_acceleration
from airl_mav.profiles.vehicle import load_vehicle

POSITIVE = st.floats(0.01, 100.0)


@given(st.floats(0.0, 10.0), POSITIVE, POSITIVE)
def test_stops_exactly_within_the_sensing_distance(t: float, d: float, a: float) -> None:
    v = f1_velocity(t, d, a)
    assert v > 0.0
    assert v * t + v * v / (2.0 * a) == pytest.approx(d, rel=1e-6)


def test_published_values() -> None:
    """End points of MAVBench's curve, and Air Learning's latencies with AirSim's tilt limit."""
    assert f1_velocity(0.0, 6.48, 6.01) == pytest.approx(8.83, abs=0.01)
    assert f1_velocity(4.0, 6.48, 6.01) == pytest.approx(1.57, abs=0.01)
    assert f1_velocity(0.396, 6.5, 6.3) == pytest.approx(6.89, abs=0.01)
    assert f1_velocity(0.949, 6.5, 6.3) == pytest.approx(4.87, abs=0.01)


@given(st.floats(0.05, 0.99), st.floats(0.1, 50.0), st.floats(0.5, 50.0))
def test_the_knee_is_where_the_curve_has_that_share_of_its_roof(
    q: float, d: float, a: float
) -> None:
    roof = f1_velocity(0.0, d, a)
    found = brentq(lambda hz: f1_velocity(1.0 / hz, d, a) - q * roof, 1e-4, 1e6, rtol=1e-10)
    assert f1_knee_hz(q, d, a) == pytest.approx(found, rel=1e-6)


def test_the_greatest_acceleration_is_the_lesser_of_two() -> None:
    quad = load_vehicle("quad")
    assert max_acceleration(quad) == pytest.approx(9.80665)  # Its tilt limit is 45 degrees.
    # Hovers at half thrust: tilts 60 degrees and keeps its height.
    body = quad.body.model_copy(update={"mass_kg": quad.thrust_n / (2.0 * 9.80665)})
    heavy = quad.model_copy(update={"body": body, "parameters": {"MPC_TILTMAX_AIR": 80.0}})
    assert max_acceleration(heavy) == pytest.approx(9.80665 * math.tan(math.radians(60)))
