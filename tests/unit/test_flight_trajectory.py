from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from airl_mav.flight.trajectory import SAMPLE_US, Trajectory, measure_leg, measure_quality
from tests.support.recording import TestRecorder, record_tick

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def helix(seconds: float, step_us: int = SAMPLE_US) -> Trajectory:
    """Radius 3 m, 0.5 rad/s, climbing 0.4 m/s; power 400 + 10 t."""
    time_us = np.arange(0, round(seconds * 1e6) + 1, step_us)
    t = time_us / 1e6
    position = np.stack([3 * np.cos(0.5 * t), 3 * np.sin(0.5 * t), -0.4 * t], axis=1)
    velocity = np.stack(
        [-1.5 * np.sin(0.5 * t), 1.5 * np.cos(0.5 * t), np.full(len(t), -0.4)], axis=1
    )
    # Mean over the step that ends at each sample.
    power = 400.0 + 10.0 * (t - 0.5e-6 * step_us)
    return Trajectory(time_us, position, velocity, np.tile(LEVEL, (len(t), 1)), power)


def test_a_helix_has_its_closed_form_length_energy_and_speed() -> None:
    quality = measure_quality(helix(20.0), 4_000_000, 18_000_000, computer_watts=1.7)
    speed = np.hypot(1.5, 0.4)
    assert quality.flight_time_s == 14.0
    assert quality.distance_m == pytest.approx(14.0 * speed, rel=1e-5)
    assert quality.mean_speed_m_s == pytest.approx(speed, rel=1e-5)
    assert quality.max_speed_m_s == pytest.approx(speed, rel=1e-5)
    assert quality.energy_j == pytest.approx(400 * 14 + 5 * (18**2 - 4**2), rel=1e-9)
    assert quality.computer_energy_j == pytest.approx(1.7 * 14)
    assert quality.takeoff.time_s == 4.0
    assert quality.takeoff.distance_m == pytest.approx(4.0 * speed, rel=1e-5)
    assert quality.takeoff.energy_j == pytest.approx(400 * 4 + 5 * 16, rel=1e-9)


def test_endurance_is_the_pack_over_the_mean_power_with_the_computer() -> None:
    quality = measure_quality(helix(20.0), 4_000_000, 18_000_000, 20.0, pack_j=288_288.0)
    mean_w = (400 * 14 + 5 * (18**2 - 4**2)) / 14 + 20.0
    speed = np.hypot(1.5, 0.4)
    assert quality.endurance_s == pytest.approx(288_288.0 / mean_w, rel=1e-9)
    assert quality.range_m == pytest.approx(288_288.0 / mean_w * speed, rel=1e-5)
    assert quality.missions_per_charge == pytest.approx(288_288.0 / mean_w / 14.0, rel=1e-9)
    never = measure_quality(helix(2.0), 1_000_000, 1_000_000, 5.0, pack_j=288_288.0)
    unknown = measure_quality(helix(20.0), 4_000_000, 18_000_000, 20.0)
    for each in (never, unknown):
        assert (each.endurance_s, each.range_m, each.missions_per_charge) == (None, None, None)


@given(st.lists(st.integers(0, 10_000_000), min_size=3, max_size=6, unique=True))
def test_parts_add_up_to_the_whole(cuts: list[int]) -> None:
    flight = helix(10.0)
    cuts.sort()
    legs = [measure_leg(flight, a, b) for a, b in itertools.pairwise(cuts)]
    whole = measure_leg(flight, cuts[0], cuts[-1])
    assert sum(leg.time_s for leg in legs) == pytest.approx(whole.time_s)
    assert sum(leg.energy_j or math.nan for leg in legs) == pytest.approx(whole.energy_j, rel=1e-9)
    # A cut within a chord leaves its length; nothing else may change it.
    assert sum(leg.distance_m for leg in legs) == pytest.approx(whole.distance_m, rel=1e-9)


def test_a_flight_that_never_navigated_has_no_length() -> None:
    quality = measure_quality(helix(2.0), 1_000_000, 1_000_000, 5.0)
    assert quality.flight_time_s == quality.distance_m == quality.energy_j == 0.0
    assert quality.mean_speed_m_s == 0.0
    with pytest.raises(ValueError, match="lies before"):
        measure_quality(helix(2.0), 1_000_000, 999_999, 5.0)


def test_between_interpolates_its_ends() -> None:
    part = helix(2.0).between(1_005_000, 1_033_000)
    assert part.time_us.tolist() == [1_005_000, 1_020_000, 1_033_000]
    whole = helix(2.0)
    for axis in range(3):
        expected = np.interp(part.time_us, whole.time_us, whole.position[:, axis])
        assert part.position[:, axis] == pytest.approx(expected)


def test_between_makes_nothing_up() -> None:
    flight = helix(1.0)
    assert flight.between(-5, 3_000_000).time_us[[0, -1]].tolist() == [0, 1_000_000]
    assert len(flight.between(2_000_000, 3_000_000)) == 0
    assert len(TestRecorder().trajectory().between(0, 1)) == 0


def test_attitude_between_samples_is_near_slerp_even_across_a_sign_flip() -> None:
    turns = Rotation.from_euler("z", [[0.0], [4.0], [8.0]], degrees=True)
    quaternion = turns.as_quat(scalar_first=True)
    quaternion[1] *= -1.0
    times = np.array([0, 20_000, 40_000])
    flight = Trajectory(times, np.zeros((3, 3)), np.zeros((3, 3)), quaternion, np.zeros(3))
    part = flight.between(5_000, 33_000)
    expected = Slerp(times, turns)(part.time_us)
    got = Rotation.from_quat(part.quaternion, scalar_first=True)
    assert (expected.inv() * got).magnitude().max() < 1e-4
    assert np.linalg.norm(part.quaternion, axis=1) == pytest.approx(1.0)


@given(st.lists(st.floats(0.0, 2000.0), min_size=2, max_size=200), st.sampled_from([4_000, 7_000]))
def test_no_energy_is_lost_between_ticks_and_samples(powers: list[float], tick_us: int) -> None:
    recorder = TestRecorder()
    for i, power in enumerate(powers):
        last = i == len(powers) - 1
        record_tick(recorder, i * tick_us, [0, 0, 0], [0, 0, 0], LEVEL, power, keep=last)
    flight = recorder.trajectory()
    end_us = (len(powers) - 1) * tick_us
    ticks_j = sum(powers[1:]) * tick_us / 1e6
    assert measure_leg(flight, 0, end_us).energy_j == pytest.approx(ticks_j, abs=1e-9)
    assert flight.time_us[-1] == end_us
    gaps = np.diff(flight.time_us)
    assert np.all(gaps < SAMPLE_US + tick_us)
    assert np.all(gaps[:-1] >= SAMPLE_US)


def test_a_recorder_at_250_hz_keeps_50() -> None:
    recorder = TestRecorder()
    for i in range(251):
        record_tick(recorder, i * 4_000, [i, 0, 0], [1, 2, 3], LEVEL, 100.0)
    flight = recorder.trajectory()
    assert len(flight) == 51
    assert flight.position[:, 0].tolist() == list(range(0, 251, 5))
    assert flight.velocity[-1].tolist() == [1.0, 2.0, 3.0]


def test_time_must_advance() -> None:
    good = helix(1.0).arrays()
    with pytest.raises(ValueError, match="must increase"):
        Trajectory.from_arrays({**good, "time_us": good["time_us"][::-1]})
    with pytest.raises(ValueError, match="position: shape"):
        Trajectory.from_arrays({**good, "position": good["position"][:, :2]})
