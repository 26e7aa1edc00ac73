"""Tracking errors of a flight, compared with scipy's rotations and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from airl_mav.core.frames import quat_wxyz_to_xyzw
from airl_mav.flight.trajectory import Trajectory
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report.run_report import chosen, flight_data, packed, steps_of
from airl_mav.report.tracking import track
from tests.support.page_alone import unpacked
from tests.support.run_demo import write_demo_run

SPIN_DEG_S = 30.0
"""The demo's vehicle is made to turn, evenly."""


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> LoadedRun:
    """A run of one flight that turns, leans, and is estimated with known errors."""
    folder, _ = write_demo_run(tmp_path_factory.mktemp("tracking") / "demo", episodes=1)
    run = load(folder.path)
    path = run.trajectories[0]
    seconds = (path.time_us - path.time_us[0]) / 1e6
    angles = np.stack([SPIN_DEG_S * seconds, np.full(len(path), -8.0), np.full(len(path), 5.0)])
    attitude = Rotation.from_euler("ZYX", angles.T, degrees=True)
    scalar_first = np.roll(attitude.as_quat(), 1, axis=1)
    # Either sign of a quaternion describes the attitude.
    scalar_first[::3] *= -1.0
    truth = replace(path, quaternion=scalar_first)
    off = Rotation.from_euler("ZYX", (angles + np.array([[2.0], [0.5], [0.0]])).T, degrees=True)
    estimate = {
        "estimate/time_us": path.time_us,
        "estimate/position": path.position + np.array([0.3, -0.4, 0.2]),
        "estimate/velocity": path.velocity + np.array([0.0, 0.0, 0.1]),
        "estimate/quaternion": np.roll(off.as_quat(), 1, axis=1),
    }
    return replace(run, trajectories={0: truth}, latency={0: {**run.latency[0], **estimate}})


def test_velocities_are_along_the_heading_and_angles_are_those_of_scipy(
    turning: LoadedRun,
) -> None:
    flight = track(turning, turning.episodes[0])
    assert flight is not None
    path = turning.trajectories[0]
    for k in (10, 200, len(flight.time_s) - 2):
        turn = Rotation.from_quat(quat_wxyz_to_xyzw(path.quaternion[k]))
        yaw, pitch, roll = turn.as_euler("ZYX")
        level = Rotation.from_euler("Z", yaw).inv().apply(path.velocity[k])
        assert flight.flown.forward_m_s[k] == pytest.approx(level[0])
        assert flight.flown.right_m_s[k] == pytest.approx(level[1])
        assert flight.flown.pitch_deg[k] == pytest.approx(np.degrees(pitch))
        assert flight.flown.roll_deg[k] == pytest.approx(np.degrees(roll))
        assert flight.flown.height_m[k] == -path.position[k, 2]
    assert np.allclose(flight.flown.yaw_rate_deg_s, SPIN_DEG_S)
    # Zero is the start of navigation, and the landing is no part of it.
    record = turning.episodes[0]
    assert record.navigation_us is not None
    assert flight.time_s[-1] == pytest.approx((record.ended_us - record.navigation_us) / 1e6)
    assert flight.time_s[0] == pytest.approx((path.time_us[0] - record.navigation_us) / 1e6)


def test_errors_of_the_estimate_are_those_that_were_put_in(turning: LoadedRun) -> None:
    flight = track(turning, turning.episodes[0])
    assert flight is not None
    assert flight.errors is not None
    assert np.allclose(flight.errors.aside_m, 0.5)
    assert np.allclose(flight.errors.height_m, 0.2)
    assert np.allclose(flight.errors.velocity_m_s, 0.1)
    assert np.allclose(flight.errors.tilt_deg, 0.5, atol=1e-6)
    assert np.allclose(flight.errors.heading_deg, 2.0, atol=1e-6)


def test_a_flight_without_estimates_has_no_errors(turning: LoadedRun) -> None:
    bare = {k: v for k, v in turning.latency[0].items() if not k.startswith("estimate/")}
    flight = track(replace(turning, latency={0: bare}), turning.episodes[0])
    assert flight is not None
    assert flight.estimated is None
    assert flight.errors is None
    assert track(replace(turning, trajectories={}), turning.episodes[0]) is None


def test_what_is_packed_is_what_comes_out() -> None:
    text = "höher </script> " * 200
    assert unpacked(packed(text)) == text
    assert packed(text) == packed(text)
    assert len(packed(text)) < len(text) / 10
    values = np.cumsum(np.random.default_rng(1).normal(0.0, 0.2, 500))
    steps = steps_of(values, 0.01)
    again = np.cumsum(steps["steps"]) * steps["unit"]
    assert np.abs(again - values).max() <= 0.005 + 1e-9
    assert steps_of([], 0.01)["steps"] == []


def test_the_first_and_the_last_decisions_are_always_shown() -> None:
    assert chosen(5) == [0, 1, 2, 3, 4]
    some = chosen(600, 24, 8)
    assert len(some) == 24
    assert some == sorted(set(some))
    assert some[0] == 0
    assert some[-8:] == list(range(592, 600))


def test_the_data_of_the_script_keep_the_lines(turning: LoadedRun) -> None:
    flight = track(turning, turning.episodes[0])
    assert flight is not None
    data = flight_data(flight, turning.latency[0], [], 20.0, None)
    time = np.cumsum(data["time"]["steps"]) * data["time"]["unit"]
    assert len(time) <= 1000
    for name, most in (("forward_m_s", 0.06), ("height_m", 0.06), ("pitch_deg", 0.06)):
        line = data["flown"][name]
        values = np.cumsum(line["steps"]) * line["unit"]
        assert len(values) == len(time)
        true = np.interp(time, flight.time_s, getattr(flight.flown, name))
        assert np.abs(values - true).max() < most
    stamps = turning.latency[0]
    t2 = (stamps["action_ready_us"] - stamps["infer_start_us"]) / 1e3
    assert data["stages"]["t2"] == pytest.approx(t2.tolist(), abs=0.01)
    assert len(data["stages"]["end_to_end"]) == len(t2)


def test_a_trajectory_without_samples_is_no_flight(turning: LoadedRun) -> None:
    empty = Trajectory(
        np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0)
    )
    assert track(replace(turning, trajectories={0: empty}), turning.episodes[0]) is None
