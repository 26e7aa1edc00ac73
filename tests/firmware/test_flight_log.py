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
from airl_mav.control.demand import Gains
from airl_mav.core.constants import TICK_US
from airl_mav.flight.trajectory import commanded_velocity
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.px4_release import px4_release
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from firmware_sim.addons.flight_log.topics import TOPICS
from firmware_sim.addons.flight_log.ulog_writer import Topic, UlogWriter
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import Source, Sticks
from firmware_sim.firmware import BuiltinFlightStack, Firmware
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.mavlink.streams import status
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


def test_intervals_are_whole_ticks() -> None:
    assert [logged.topic.name for logged in TOPICS if logged.interval_us % TICK_US] == []


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
    logged = topic(log, "vehicle_status")
    states = logged["nav_state"][logged["arming_state"] == 2]
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


def newest(log: ULog, name: str, field: str, times_us: Any) -> Any:
    """Return the newest values of a field at some times."""
    data = topic(log, name)
    return data[field][np.searchsorted(data["timestamp"], times_us, side="right") - 1]


def test_the_info_is_that_of_px4(flown: tuple[Path, ULog]) -> None:
    info = flown[1].msg_info_dict
    assert info["sys_name"] == "airl-mav" and info["ver_hw"] == "PX4_SITL"
    assert info["ver_sw"].startswith("airl-mav ") and info["ver_sw_branch"] == "built-in"
    assert info["ver_sw_release"] == px4_release().flight_sw_version
    assert int(info["sys_uuid"], 16) == status.UID and info["time_ref_utc"] == 0


def test_setpoints_are_logged_as_px4_logs_them(flown: tuple[Path, ULog]) -> None:
    folder, log = flown
    offboard = topic(log, "offboard_control_mode")
    inside = offboard["velocity"] == 1
    assert inside.sum() > 20 and 90_000 < np.median(np.diff(offboard["timestamp"])) < 110_000
    for name in ("acceleration", "attitude", "body_rate", "thrust_and_torque", "direct_actuator"):
        assert not offboard[name].any()
    wanted = topic(log, "trajectory_setpoint")
    modes = newest(log, "vehicle_status", "nav_state", wanted["timestamp"])
    # The companion sends velocities and yaw rates.
    flies = modes == Mode.OFFBOARD.spec.state
    for axis in range(3):
        velocity = wanted[f"velocity[{axis}]"][flies]
        assert np.isfinite(velocity).all() and np.abs(velocity).max() < 10.0
        assert np.isnan(wanted[f"position[{axis}]"][flies]).mean() > 0.5
        assert np.isnan(wanted[f"jerk[{axis}]"]).all()
    # The companion commands body velocities: in the log they are NED.
    run = load_run(folder)
    times = wanted["timestamp"][flies].astype(np.int64)
    path, stamps = run.trajectories[0], run.stamps[0]
    sent = commanded_velocity(path, stamps, times)
    logged = np.stack([wanted[f"velocity[{i}]"][flies] for i in range(3)], axis=1)
    known = np.isfinite(sent).all(axis=1)
    assert known.sum() > 15
    assert np.quantile(np.abs(logged - sent)[known].max(axis=1), 0.5) < 0.2
    # The destination of the take-off is above the start, geodetic.
    triplet = topic(log, "position_setpoint_triplet")
    climb = triplet["current.type"] == 3
    assert climb.sum() > 3 and triplet["current.valid"].all() and not triplet["next.valid"].any()
    latitude, altitude = (
        newest(log, "home_position", name, triplet["timestamp"][climb]) for name in ("lat", "alt")
    )
    assert triplet["current.lat"][climb] == pytest.approx(latitude, abs=2e-5)
    above = triplet["current.alt"][climb] - altitude
    assert np.all((above > 0.5) & (above < 10.0))
    assert np.isnan(triplet["current.loiter_radius"]).all()


def test_controls_and_sensors_agree(flown: tuple[Path, ULog]) -> None:
    _, log = flown
    motors, outputs = topic(log, "actuator_motors"), topic(log, "actuator_outputs")
    np.testing.assert_array_equal(motors["timestamp"], outputs["timestamp"])
    flying = np.isfinite(motors["control[0]"])
    for i in range(4):
        pulses = outputs[f"output[{i}]"]
        assert pulses[flying] == pytest.approx(
            1000 + 1000 * motors[f"control[{i}]"][flying], abs=0.51
        )
        assert set(pulses[~flying]) == {900.0}
    assert set(outputs["output[15]"]) == {900.0} and set(outputs["noutputs"]) == {16}
    # Mean and torque give the motor commands again: X configuration, front right first.
    thrust, torque = topic(log, "vehicle_thrust_setpoint"), topic(log, "vehicle_torque_setpoint")
    at = np.isin(thrust["timestamp"], motors["timestamp"][flying])
    commands = np.stack([motors[f"control[{i}]"][flying] for i in range(4)])
    roll, pitch, yaw = (torque[f"xyz[{axis}]"][at] for axis in range(3))
    parameters = {**px4_release().flown_values({}), **log.initial_parameters}
    gains = Gains.from_parameters(parameters.__getitem__)
    for command, x, y, z in zip(
        commands, (-1, 1, 1, -1), (1, -1, 1, -1), (1, 1, -1, -1), strict=True
    ):
        turned = gains.mix_roll * x * roll + gains.mix_pitch * y * pitch + z * yaw
        np.testing.assert_allclose(command, commands.mean(axis=0) + turned, atol=1e-5)
    # The thrust setpoint is of the same tick, the motors follow the one before.
    assert np.median(np.abs(-thrust["xyz[2]"][at] - commands.mean(axis=0))) < 0.01
    accel, combined = topic(log, "sensor_accel"), topic(log, "sensor_combined")
    rows = np.searchsorted(combined["timestamp"], accel["timestamp"])
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(accel[name], combined[f"accelerometer_m_s2[{axis}]"][rows])
    baro, air = topic(log, "sensor_baro"), topic(log, "vehicle_air_data")
    rows = np.searchsorted(air["timestamp"], baro["timestamp"])
    np.testing.assert_array_equal(baro["pressure"], air["baro_pressure_pa"][rows])
    assert 90_000 < baro["pressure"].mean() < 102_000
    load = topic(log, "cpuload")
    assert np.all((load["load"] >= 0.0) & (load["load"] <= 1.0))


def test_failsafe_flags_and_commands(flown: tuple[Path, ULog]) -> None:
    _, log = flown
    flags = topic(log, "failsafe_flags")
    bits = 1 << Mode.OFFBOARD.spec.state
    assert set(flags["mode_req_offboard_signal"]) == {bits}
    assert flags["mode_req_attitude"][0] & bits and not flags["mode_req_manual_control"][0] & bits
    assert flags["attitude_invalid"][0] and not flags["attitude_invalid"][-1]
    offboard = newest(log, "vehicle_status", "nav_state", flags["timestamp"]) == 14
    offboard &= newest(log, "actuator_armed", "armed", flags["timestamp"]) == 1
    assert offboard.any() and not flags["offboard_control_signal_lost"][offboard].any()
    commands = topic(log, "vehicle_command")
    numbers = commands["command"].tolist()
    arm = numbers.index(400)
    assert commands["param1"][arm] == 1.0 and commands["from_external"].all()
    assert set(commands["target_component"]) == {1}
    armed = topic(log, "actuator_armed")
    first = armed["timestamp"][armed["armed"] == 1][0]
    assert 0 <= first - commands["timestamp"][arm] < 100_000


def test_sticks_are_logged(tmp_path: Path) -> None:
    with closing(unpaced_firmware()) as firmware:
        firmware.load(EpisodeSetup(load_vehicle("quad"), None, 1), tmp_path / "f.tlog", 0)
        simulation = firmware.simulation
        assert simulation is not None and simulation.autopilot.internals is not None
        for _ in range(300):
            sticks = Sticks(roll=0.25, pitch=-0.5, throttle=0.75, yaw=1.0)
            simulation.autopilot.internals.manual_control(
                sticks, Source.JOYSTICK, simulation.time_us
            )
            firmware.step()
        firmware.save(tmp_path / "f.npz")
    logged = topic(ULog(str(tmp_path / "f.ulg")), "manual_control_setpoint")
    assert 4 <= len(logged["timestamp"]) <= 7
    wanted = {"roll": 0.25, "pitch": -0.5, "throttle": 0.75, "yaw": 1.0, "valid": 1, "aux1": 0.0}
    assert {name: logged[name][-1] for name in wanted} == wanted
