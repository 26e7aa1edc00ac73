"""The vehicle's log (.ulg), read by PX4's own reader."""

from __future__ import annotations

import subprocess
import sys
from contextlib import closing
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyulog import ULog
from pyulog.px4 import PX4ULog

from airl_mav import Scenario, load_run, rehearse
from airl_mav.core.constants import TICK_US
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.px4_release import px4_release
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from firmware_sim.addons.flight_log.flight_log import GRID_US
from firmware_sim.addons.flight_log.topics import TOPICS
from firmware_sim.addons.flight_log.ulog_writer import Topic, UlogWriter
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.firmware import BuiltinFlightStack, Firmware
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.pacing import Unpaced
from firmware_sim.simulation import EpisodeSetup
from tests.support.flown_here import flown_here

ANSWER = Topic("answer", ("float[3] xyz", "int16_t number", "bool right", "double exact"))


def write(path: Path) -> UlogWriter:
    """Begin a log and write a little of everything."""
    facts: list[tuple[str, str | int]] = [("sys_name", "a name"), ("ver_sw_release", 17)]
    log = UlogWriter(path, 4_000, [ANSWER], facts, [("WHOLE", 3), ("REAL", 0.5)])
    log.sample(0, 8_000, (1.0, 2.0, 3.0, -7, True, 1e-300))
    log.sample(0, 12_000, (1.5, 2.5, 3.5, 7, False, 0.1))
    log.text(12_000, 4, "a warning")
    log.parameter("REAL", 0.25)
    return log


def topic(log: ULog, name: str) -> dict[str, Any]:
    """Return the samples of a topic by field."""
    data: dict[str, Any] = log.get_dataset(name).data
    return data


def unpaced_firmware() -> Firmware:
    """Return the built-in flight controller, with no client on its link."""
    links = [onboard_link(MemoryEndpoint())]
    return Firmware(BuiltinFlightStack(MavlinkServer(links, boot_unix_us=0)), None, Unpaced())


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    log = write(path)
    assert not path.exists()
    log.close()
    log.close()
    read = ULog(str(path))
    assert not read.file_corruption
    assert read.start_timestamp == 4_000
    assert read.msg_info_dict == {"sys_name": "a name", "ver_sw_release": 17}
    assert read.initial_parameters == {"WHOLE": 3, "REAL": 0.5}
    assert read.changed_parameters == [(12_000, "REAL", 0.25)]
    (text,) = read.logged_messages
    assert (text.timestamp, text.log_level_str(), text.message) == (12_000, "WARNING", "a warning")
    data = topic(read, "answer")
    assert data["timestamp"].tolist() == [8_000, 12_000]
    assert [data[f"xyz[{i}]"].tolist() for i in range(3)] == [[1.0, 1.5], [2.0, 2.5], [3.0, 3.5]]
    assert data["number"].tolist() == [-7, 7]
    assert data["right"].tolist() == [1, 0]
    assert data["exact"].tolist() == [1e-300, 0.1]


def test_numbers_beyond_single_precision_are_infinite(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    log = UlogWriter(path, 0, [ANSWER], [], [])
    log.sample(0, 4_000, (1e39, -1e40, 3.5, 7, True, 0.25))
    log.close()
    data = topic(ULog(str(path)), "answer")
    assert [data[f"xyz[{i}]"].item() for i in range(3)] == [np.inf, -np.inf, 3.5]
    assert (data["number"].item(), data["exact"].item()) == (7, 0.25)


def test_a_killed_writer_leaves_a_readable_part(tmp_path: Path) -> None:
    path = tmp_path / "killed.ulg"
    script = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from firmware_sim.addons.flight_log.ulog_writer import Topic, UlogWriter\n"
        "log = UlogWriter(Path(sys.argv[1]), 0, [Topic('t', ('float x',))], [], [])\n"
        "for i in range(5_000):\n"
        "    log.sample(0, i * 4_000, (float(i),))\n"
        "os.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", script, str(path)], check=False)
    assert not path.exists()
    times = topic(ULog(str(path) + ".part"), "t")["timestamp"]
    assert len(times) > 4_700
    assert np.all(np.diff(times) == 4_000)


def test_parameters_that_change_after_the_log_was_closed_go_nowhere(tmp_path: Path) -> None:
    with closing(unpaced_firmware()) as firmware:
        setup = EpisodeSetup(load_vehicle("quad"), None, 1)
        firmware.load(setup, tmp_path / "flight-001.tlog", 0)
        firmware.step()
        firmware.save(tmp_path / "flight-001.npz")
        assert firmware.simulation is not None
        internals = firmware.simulation.autopilot.internals
        assert internals is not None
        for tick in range(300):  # more than a second: an open log would write them
            internals.parameters.set("MPC_XY_VEL_MAX", 5.0 + tick % 2)
            firmware.step()
    assert ULog(str(tmp_path / "flight-001.ulg")).changed_parameters == []


def test_vision_is_logged_as_it_was_told(tmp_path: Path) -> None:
    """Topic that Flight Review and PX4's own tools read."""
    with closing(unpaced_firmware()) as firmware:
        firmware.load(EpisodeSetup(load_vehicle("quad-vio"), None, 1), tmp_path / "f.tlog", 0)
        for _ in range(1_000):
            firmware.step()
        firmware.save(tmp_path / "f.npz")
    log = ULog(str(tmp_path / "f.ulg"))
    seen, truth = topic(log, "vehicle_visual_odometry"), topic(log, "vehicle_attitude_groundtruth")
    assert len(seen["timestamp"]) > 80
    assert np.all(np.diff(seen["timestamp_sample"]) > 0)
    # In the frame of the start, with unknown heading: the vehicle is at rest and upright.
    assert set(seen["pose_frame"]) == {2}
    for axis in range(3):
        assert seen[f"position[{axis}]"] == pytest.approx(0.0, abs=0.2)
        assert np.all(seen[f"position_variance[{axis}]"] > 0.0)
        assert np.isnan(seen[f"angular_velocity[{axis}]"]).all()
    level = np.hypot(seen["q[1]"], seen["q[2]"])
    assert np.median(level) == pytest.approx(
        float(np.median(np.hypot(truth["q[1]"], truth["q[2]"]))), abs=0.03
    )
    assert set(seen["quality"]) == {0}  # the simulated camera reports none


def test_intervals_are_met_by_the_grid() -> None:
    assert [logged.topic.name for logged in TOPICS if logged.interval_us % GRID_US] == []


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ULog]:
    """A flight in lockstep, and its log."""
    folder = tmp_path_factory.mktemp("flown") / "run"
    with flown_here():
        rehearse(Scenario(episodes=1, level="lockstep", tlogs=True, workers=1), out=folder)
    return folder, ULog(str(folder / "flight-000.ulg"))


def test_a_flight_is_logged_whole(flown: tuple[Path, ULog]) -> None:
    folder, log = flown
    assert not log.file_corruption
    assert not log.dropouts
    samples = topic(log, "sensor_combined")
    assert np.all(np.diff(samples["timestamp"]) == TICK_US)
    # Upright at rest it feels the ground push up.
    resting = samples["accelerometer_m_s2[2]"][200:250]
    assert resting.mean() == pytest.approx(-9.81, abs=0.1)
    # The truth in the log is the path of the record.
    record = load_run(folder).trajectories[0]
    truth = topic(log, "vehicle_local_position_groundtruth")
    times = truth["timestamp_sample"]
    assert np.all(times <= samples["timestamp"][-1] + TICK_US)
    inside = (times >= record.time_us[0]) & (times <= record.time_us[-1])
    assert inside.sum() > 200
    for axis, name in enumerate(("x", "y", "z")):
        path = np.interp(times[inside], record.time_us, record.position[:, axis])
        # Between two samples of the record it may touch down.
        assert truth[name][inside] == pytest.approx(path, abs=5e-3)
    # The estimate is near the truth; a hover takes about half of the motors' range.
    estimate = topic(log, "vehicle_local_position")
    later = estimate["timestamp"] > 10_000_000
    error = np.interp(estimate["timestamp"], truth["timestamp_sample"], truth["z"]) - estimate["z"]
    assert np.abs(error[later]).max() < 1.0
    motors = topic(log, "actuator_motors")
    flying = motors["control[0]"][np.isfinite(motors["control[0]"])]
    assert 0.3 < np.median(flying) < 0.8
    assert np.isnan(motors["control[4]"]).all()


def test_states_texts_and_parameters(flown: tuple[Path, ULog]) -> None:
    _, log = flown
    status = topic(log, "vehicle_status")
    states = status["nav_state"][status["arming_state"] == 2]
    order = [int(state) for state, _ in groupby(states)]
    flown_modes = (Mode.TAKEOFF, Mode.HOLD, Mode.OFFBOARD, Mode.LAND)
    assert order == [mode.spec.state for mode in flown_modes]
    texts = [text.message for text in log.logged_messages]
    assert "Takeoff detected" in texts
    assert texts[-1] == "Disarmed by landing"
    vehicle = load_profile("vehicles", "quad", VehicleProfile)
    stored = px4_release().parameter_values(vehicle.autopilot_parameters())
    assert log.initial_parameters.keys() == stored.keys()
    assert all(
        log.initial_parameters[name] == pytest.approx(value, rel=1e-6)
        for name, value in stored.items()
    )


def test_tools_of_px4_read_it(flown: tuple[Path, ULog]) -> None:
    _, log = flown
    px4 = PX4ULog(log)
    px4.add_roll_pitch_yaw()
    attitude = topic(log, "vehicle_attitude")
    assert np.abs(attitude["roll"]).max() < 1.0
    assert px4.get_mav_type() == "Quadrotor"
