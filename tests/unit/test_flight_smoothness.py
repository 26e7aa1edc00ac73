"""Jerk and steps of the command, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from airl_mav.flight.trajectory import (
    BANDWIDTH_HZ,
    Trajectory,
    command_steps,
    commanded_velocity,
    flown_velocity,
    jerk_of,
    measure_quality,
    sample_times,
)
from airl_mav.latency.stamps import NO_STAMP

STEP_S = 0.02
SIGMA_S = np.sqrt(np.log(2.0)) / (2.0 * np.pi * BANDWIDTH_HZ)


def floats(rows: list[list[float]]) -> np.ndarray:
    """Return setpoints as the decision log keeps them."""
    return np.array(rows, np.float32)


def path(time_us: np.ndarray, velocity: np.ndarray, yaw: np.ndarray) -> Trajectory:
    attitude = Rotation.from_euler("z", yaw[:, None]).as_quat(scalar_first=True)
    nothing = np.zeros((len(time_us), 3))
    return Trajectory(time_us, nothing, velocity, attitude, np.zeros(len(time_us)))


@pytest.mark.parametrize("hertz", [0.25, 1.0, 3.0, BANDWIDTH_HZ, 10.0])
def test_a_sine_has_its_jerk_times_the_gain_of_the_filter(hertz: float) -> None:
    t = np.arange(0.0, 40.0, STEP_S)
    velocity = np.stack([3.0 + 2.0 * np.sin(2 * np.pi * hertz * t + 0.4), 0 * t, 0 * t], axis=1)
    jerk = jerk_of(velocity)
    assert jerk is not None
    gain = np.exp(-2.0 * (np.pi * SIGMA_S * hertz) ** 2)
    peak = 2.0 * (2 * np.pi * hertz) ** 2 * gain
    assert jerk.peak_m_s3 == pytest.approx(peak, rel=0.02)
    assert jerk.rms_m_s3 == pytest.approx(peak / np.sqrt(2.0), rel=0.02)


def test_half_the_power_passes_at_the_bandwidth() -> None:
    assert np.exp(-4.0 * (np.pi * SIGMA_S * BANDWIDTH_HZ) ** 2) == pytest.approx(0.5)


def test_a_step_has_the_peak_of_a_gaussians_slope_and_its_energy() -> None:
    velocity = np.zeros((1000, 3))
    velocity[500:] = [1.2, -1.6, 0.0]  # 2 m/s
    jerk = jerk_of(velocity)
    assert jerk is not None
    peak = 2.0 * np.exp(-0.5) / (np.sqrt(2 * np.pi) * SIGMA_S**2)
    assert jerk.peak_m_s3 == pytest.approx(peak, rel=0.05)
    energy = 2.0**2 / (4.0 * np.sqrt(np.pi) * SIGMA_S**3)  # Parseval.
    assert jerk.rms_m_s3 == pytest.approx(np.sqrt(energy / (1000 * STEP_S)), rel=0.06)


def test_steady_and_evenly_accelerated_flight_has_no_jerk() -> None:
    t = np.arange(0.0, 10.0, STEP_S)
    jerk = jerk_of(np.stack([5.0 + 3.0 * t, -t, np.full(len(t), -0.4)], axis=1))
    assert jerk is not None
    assert jerk.peak_m_s3 < 1e-6
    assert jerk_of(np.zeros((5, 3))) is None
    assert jerk_of(np.zeros((0, 3))) is None


def test_a_command_turns_with_the_heading() -> None:
    """3 m/s forward at 1 rad/s: a circle, whose jerk is speed times the square of the rate."""
    time_us = np.arange(0, 20_000_001, 20_000)
    flight = path(time_us, np.zeros((len(time_us), 3)), time_us / 1e6)
    decisions = {"sent_us": np.array([0]), "setpoint": floats([[3.0, 0.0, 0.0, 1.0]])}
    velocity = commanded_velocity(flight, decisions, time_us)
    t = time_us / 1e6
    circle = np.stack([3.0 * np.cos(t), 3.0 * np.sin(t), 0.0 * t], axis=1)
    assert velocity == pytest.approx(circle, abs=1e-9)
    jerk = jerk_of(velocity)
    assert jerk is not None
    assert jerk.rms_m_s3 == pytest.approx(3.0, rel=1e-3)
    assert jerk.peak_m_s3 == pytest.approx(3.0, rel=1e-3)


def test_a_command_holds_until_the_next() -> None:
    time_us = np.arange(0, 1_000_001, 20_000)
    flight = path(time_us, np.zeros((len(time_us), 3)), np.full(len(time_us), np.pi / 2))
    decisions = {
        "sent_us": np.array([210_000, 600_000, NO_STAMP]),
        "setpoint": floats([[2.0, 0.0, -0.5, 0.0], [0.0, 1.0, 0.0, 0.0], [9.0, 9.0, 9.0, 0.0]]),
    }
    velocity = commanded_velocity(flight, decisions, time_us)
    # Heading east: forward is east, right is south.
    for start, end, command in (
        (0, 209_999, [0.0, 0.0, 0.0]),
        (210_000, 599_999, [0.0, 2.0, -0.5]),
        (600_000, 1_000_000, [-1.0, 0.0, 0.0]),
    ):
        there = (time_us >= start) & (time_us <= end)
        assert velocity[there] == pytest.approx(np.tile(command, (there.sum(), 1)), abs=1e-9)


def test_steps_are_those_between_commands_that_were_sent() -> None:
    decisions = {
        "sent_us": np.array([1, 2, NO_STAMP, 3]),
        "setpoint": floats([[3, 0, 0, 1], [3, 4, 0, -1], [50, 50, 0, 0], [0, 0, 0, 0]]),
    }
    assert command_steps(decisions).tolist() == [4.0, 5.0]
    assert command_steps({}).size == 0


def test_an_even_recording_is_not_interpolated() -> None:
    time_us = np.arange(4_000, 2_000_000, 20_000)
    rng = np.random.default_rng(1)
    flight = path(time_us, rng.normal(size=(len(time_us), 3)), np.zeros(len(time_us)))
    times = sample_times(flight, 500_000, 1_500_000)
    assert times[0] >= 500_000
    assert times[-1] <= 1_500_000
    inside = (time_us >= 500_000) & (time_us <= 1_500_000)
    assert (flown_velocity(flight, times) == flight.velocity[inside]).all()
    assert sample_times(flight, 5_000_000, 6_000_000).size == 0


def test_a_flight_is_measured_in_all_of_it() -> None:
    time_us = np.arange(0, 10_000_001, 20_000)
    t = time_us / 1e6
    velocity = np.stack([2.0 * np.sin(2 * np.pi * t), 0 * t, 0 * t], axis=1)
    flight = path(time_us, velocity, 0 * t)
    sent = np.arange(2_400_000, 9_000_000, 600_000)
    decisions = {
        "capture_us": sent - 400_000,
        "sent_us": sent,
        "motor_us": sent + np.where(np.arange(len(sent)) % 4 == 0, 200_000, 10_000),
        "setpoint": floats([[k % 2, 0, 0, 0] for k in range(len(sent))]),
    }
    quality = measure_quality(flight, 2_000_000, 9_000_000, 0.0, decisions=decisions, hold_s=0.5)
    assert quality.deadline_misses == pytest.approx(np.mean(np.arange(len(sent)) % 4 == 0))
    assert quality.command_step_m_s == quality.command_step_max_m_s == 1.0
    whole = jerk_of(velocity[(time_us >= 2_000_000) & (time_us <= 9_000_000)])
    assert whole is not None
    assert (quality.jerk_rms_m_s3, quality.jerk_peak_m_s3) == (whole.rms_m_s3, whole.peak_m_s3)
    assert quality.command_jerk_peak_m_s3 == pytest.approx(
        np.exp(-0.5) / (np.sqrt(2 * np.pi) * SIGMA_S**2), rel=0.05
    )
    unheld = measure_quality(flight, 2_000_000, 9_000_000, 0.0, decisions=decisions)
    assert unheld.deadline_misses is None
    alone = measure_quality(flight, 2_000_000, 9_000_000, 0.0, hold_s=0.5)
    assert (alone.deadline_misses, alone.command_step_m_s) == (None, None)
    assert alone.command_jerk_rms_m_s3 is None
    assert alone.jerk_rms_m_s3 == quality.jerk_rms_m_s3
