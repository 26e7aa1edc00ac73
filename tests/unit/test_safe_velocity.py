"""The safe velocity, and the environment that is bounded by it."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.core.errors import UsageError
from airl_mav.envs.delay import bounded, speed_bound
from airl_mav.envs.spec import spec_of
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.latency.safe_velocity import max_acceleration, safe_velocity
from airl_mav.profiles.vehicle import load_vehicle

POSITIVE = st.floats(0.01, 100.0)


@given(st.floats(0.0, 10.0), POSITIVE, POSITIVE)
def test_stops_exactly_within_the_sensing_distance(t: float, d: float, a: float) -> None:
    v = safe_velocity(t, d, a)
    assert v > 0.0
    assert v * t + v * v / (2.0 * a) == pytest.approx(d, rel=1e-6)


def test_published_values() -> None:
    """End points of MAVBench's curve, and Air Learning's latencies with AirSim's tilt limit."""
    assert safe_velocity(0.0, 6.48, 6.01) == pytest.approx(8.83, abs=0.01)
    assert safe_velocity(4.0, 6.48, 6.01) == pytest.approx(1.57, abs=0.01)
    assert safe_velocity(0.396, 6.5, 6.3) == pytest.approx(6.89, abs=0.01)
    assert safe_velocity(0.949, 6.5, 6.3) == pytest.approx(4.87, abs=0.01)


def test_the_greatest_acceleration_is_the_lesser_of_two() -> None:
    quad = load_vehicle("quad")
    assert max_acceleration(quad) == pytest.approx(9.80665)  # its tilt limit is 45 degrees
    # Hovers at half thrust: tilts 60 degrees and keeps its height.
    body = quad.body.model_copy(update={"mass_kg": quad.thrust_n / (2.0 * 9.80665)})
    heavy = quad.model_copy(update={"body": body, "parameters": {"MPC_TILTMAX_AIR": 80.0}})
    assert max_acceleration(heavy) == pytest.approx(9.80665 * math.tan(math.radians(60)))


PI = {"computer": "ras-pi-4", "workload": "template-5x32"}


def test_an_environment_is_bounded_by_its_longest_latency() -> None:
    spec = spec_of(None, {"delay": PI, "safe_velocity": {"sensing_distance_m": 3.0}})
    bound = speed_bound(spec)
    assert bound is not None
    # 396 ms and 3.09 standard deviations of a log-normal of 5 %, 5 ms transport, 4 ms link.
    assert bound.latency_s == pytest.approx(0.4705, abs=2e-3)
    assert bound.max_acceleration_m_s2 == pytest.approx(9.80665)
    tight = bounded(spec)
    assert tight.max_speed_m_s == bound.safe_velocity_m_s < 5.0
    assert bounded(tight) == tight
    assert "actions scaled by 0.86" in bound.describe()
    env = NavigationVectorEnv(1, delay=PI, safe_velocity={"sensing_distance_m": 3.0})
    assert env.environment.action_spec.max_speed_m_s == tight.max_speed_m_s


def test_a_bound_above_the_fastest_action_is_told_and_does_nothing() -> None:
    spec = spec_of(None, {"delay": PI, "safe_velocity": {"sensing_distance_m": 20.0}})
    bound = speed_bound(spec)
    assert bound is not None
    assert bounded(spec) == spec
    assert "actions are not scaled" in bound.describe()
    assert speed_bound(spec_of(None, {"delay": PI})) is None


def test_of_several_sources_the_longest_counts() -> None:
    safe = {"sensing_distance_m": 3.0, "max_acceleration_m_s2": 6.0}
    sources = ("ras-pi-4/template-5x32", "900ms")
    spec = spec_of(None, {"delay": {"latency": sources}, "safe_velocity": safe})
    bound = speed_bound(spec)
    assert bound is not None
    assert bound.latency_s == pytest.approx(0.909)
    assert bound.safe_velocity_m_s == pytest.approx(safe_velocity(0.909, 3.0, 6.0))


def test_two_kinds_of_source_are_one_too_many() -> None:
    with pytest.raises(UsageError, match="accepted: one of them"):
        spec_of(None, {"delay": {**PI, "latency": ("150ms",)}})
