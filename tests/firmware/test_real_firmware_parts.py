"""The parts around a bridge: process, frame check, parameters, observer, options."""

from __future__ import annotations

import math
import os
import signal
import stat
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
from pymavlink import mavparm
from pymavlink.dialects.v20 import common as dialect

from airl_mav.cli.parameters_command import ParametersOptions
from airl_mav.cli.parameters_command import run as write_parameters
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import validated
from airl_mav.core.frames import Geodetic
from airl_mav.profiles.vehicle import CORNERS, VehicleProfile
from airl_mav.scenario.aircraft import Aircraft, FirmwareName, RealFirmware
from airl_mav.scenario.checks import check_firmware
from airl_mav.scenario.model import LevelName
from firmware_sim.addons.ardupilot.program import (
    PARAMETERS,
    Links,
    ardupilot_airframe,
    find_arducopter,
)
from firmware_sim.addons.ardupilot.program import start as start_arducopter
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.external.launcher import (
    Bridge,
    FirmwareProcess,
    Launcher,
    StartCommand,
    WorkingFolders,
)
from firmware_sim.external.observer import (
    SILENT_REQUESTS,
    FirmwareObserver,
    ParameterClient,
    flight_of,
)
from firmware_sim.external.parameters import (
    SITL_OUTPUT,
    RequiredAirframe,
    differences,
    px4_airframe,
    same,
)
from firmware_sim.external.programs import find_px4, firmware_kind, how_to_start, load_timeout_s
from firmware_sim.interfaces import FirmwareLostError, FirmwareMissingError
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from tests.support.flight_rig import quad
from tests.support.processes import ROOT, is_running, wait_until

PX4_ID, ARDUPILOT_ID = dialect.MAV_AUTOPILOT_PX4, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA

# --- the firmware process

HOLDER = """
import sys, time
from pathlib import Path
from firmware_sim.external.launcher import FirmwareProcess, StartCommand
folder = Path(sys.argv[1])
child = FirmwareProcess("X", StartCommand(sys.argv[2:], {}), folder, folder / "x.log")
print("up", flush=True)
time.sleep(600)
"""


def started(folder: Path, *program: str) -> FirmwareProcess:
    return FirmwareProcess(
        "PX4", StartCommand(program, {"GREETING": "hello"}), folder, folder / "x.log"
    )


def test_a_program_runs_logs_and_is_ended_with_what_it_started(tmp_path: Path) -> None:
    script = 'echo "$GREETING"; sleep 600 & echo $! > pid; trap "" TERM; wait; sleep 600'
    child = started(tmp_path, "/bin/sh", "-c", script)
    pid_file = tmp_path / "pid"
    grandchild = int(wait_until(lambda: pid_file.exists() and pid_file.read_text(), "the program"))
    child.check()
    assert child.log_tail() == "hello"
    child.stop()
    wait_until(lambda: not is_running(grandchild), "its own child to end", 30.0)
    child.stop()


def test_the_end_of_a_program_is_told_with_its_last_words(tmp_path: Path) -> None:
    child = started(tmp_path, "/bin/sh", "-c", "echo cannot fly; exit 7")

    def ended() -> bool:
        try:
            child.check()
        except FirmwareLostError as error:
            assert "PX4 ended (exit status 7)" in str(error)
            assert "cannot fly" in str(error)
            assert str(tmp_path / "x.log") in str(error)
            return True
        return False

    wait_until(ended, "the end", 30.0)
    child.stop()


def test_a_program_does_not_outlive_a_holder_that_is_killed(tmp_path: Path) -> None:
    program = ["/bin/sh", "-c", "echo $$ > pid; exec sleep 600"]
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path), *program],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"up\n"
        pid_file = tmp_path / "pid"
        pid = int(wait_until(lambda: pid_file.exists() and pid_file.read_text(), "the program"))
        assert is_running(pid)
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
        if holder.stdout is not None:
            holder.stdout.close()
    wait_until(lambda: not is_running(pid), "the program to end", 30.0)


def test_what_is_no_program_is_told(tmp_path: Path) -> None:
    with pytest.raises(FirmwareMissingError, match="not an executable program"):
        started(tmp_path, str(tmp_path / "px4"))


# --- the frame


def px4_set_right(vehicle: VehicleProfile) -> dict[str, int | float]:
    """Return what a PX4 with airframe 10016 holds: longer and shorter arms, the same corners."""
    assert vehicle.px4 is not None
    held: dict[str, int | float] = {"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": 4, "NAV_DLL_ACT": 0}
    places = ((0.1515, 0.245), (-0.1515, -0.1875), (0.1515, -0.245), (-0.1515, 0.1875))
    for i, (forward, right) in enumerate(places):
        held |= {f"CA_ROTOR{i}_PX": forward, f"CA_ROTOR{i}_PY": right}
        held |= {f"CA_ROTOR{i}_KM": 0.05 if i < 2 else -0.05, f"PWM_MAIN_FUNC{i + 1}": 101 + i}
    return held | {"MPC_THR_HOVER": 0.5, "THR_MDL_FAC": 0.0}


def px4(vehicle: VehicleProfile) -> RequiredAirframe:
    return px4_airframe(vehicle, "PWM_MAIN_FUNC{}")


def test_a_vehicle_that_says_nothing_of_a_firmware_is_told() -> None:
    vehicle = quad().model_copy(update={"px4": None, "ardupilot": None})
    with pytest.raises(FirmwareMissingError, match=r"no table \[px4\]"):
        px4_airframe(vehicle, "PWM_MAIN_FUNC{}")
    with pytest.raises(FirmwareMissingError, match=r"no table \[ardupilot\]"):
        ardupilot_airframe(vehicle)


def test_px4_with_its_stock_airframe_is_right() -> None:
    frame, held = px4(quad()), px4_set_right(quad())
    assert set(frame.names()) == set(held)
    assert frame.problem(held) is None


def test_px4_is_set_to_the_vehicle_that_it_flies() -> None:
    vehicle, settings = quad(), px4(quad()).settings
    rotor = vehicle.rotor
    at = {
        c: (settings[f"CA_ROTOR{i}_PX"], settings[f"CA_ROTOR{i}_PY"]) for i, c in enumerate(CORNERS)
    }
    assert at["front right"] == (rotor.arm_forward_m, rotor.arm_right_m)
    assert at["rear left"] == (-rotor.arm_forward_m, -rotor.arm_right_m)
    assert at["front left"] == (rotor.arm_forward_m, -rotor.arm_right_m)
    assert at["rear right"] == (-rotor.arm_forward_m, rotor.arm_right_m)
    turns = [settings[f"CA_ROTOR{i}_KM"] for i in range(4)]
    assert turns == [0.05, 0.05, -0.05, -0.05]
    assert settings["MPC_THR_HOVER"] == 0.52


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"PWM_MAIN_FUNC1": 102, "PWM_MAIN_FUNC2": 101}, "output 1 .* rear left .* front right"),
        ({"PWM_MAIN_FUNC3": 0}, "PWM_MAIN_FUNC3 is 0"),
        ({"CA_ROTOR1_PX": 0.15}, r"output 2 .* front left .* rear left: wrong motor order"),
        ({"CA_ROTOR2_KM": 0.05}, "front left turns counter-clockwise"),
        ({"CA_ROTOR_COUNT": 6}, "CA_ROTOR_COUNT 6"),
        ({"CA_AIRFRAME": 2}, "CA_AIRFRAME 2"),
    ],
)
def test_a_wrong_px4_frame_is_told(change: dict[str, int | float], words: str) -> None:
    import re

    problem = px4(quad()).problem(px4_set_right(quad()) | change)
    assert problem is not None
    assert re.search(words, problem), problem


def ardupilot(vehicle: VehicleProfile) -> RequiredAirframe:
    return ardupilot_airframe(vehicle)


def ardupilot_set_right() -> dict[str, int | float]:
    functions = {f"SERVO{i}_FUNCTION": 32 + i for i in range(1, 5)}
    return {**functions, "FRAME_CLASS": 1, "FRAME_TYPE": 1}


def test_ardupilot_flies_by_its_own_estimate() -> None:
    """With no_time_sync its default is the simulator's true state (SIM_JSON.cpp)."""
    assert ardupilot(quad()).settings["AHRS_EKF_TYPE"] == 3.0


def test_a_wrong_ardupilot_frame_is_told() -> None:
    frame, held = ardupilot(quad()), ardupilot_set_right()
    assert frame.problem(held) is None
    assert frame.problem(held | {"FRAME_TYPE": 0}) == (
        "ArduPilot's FRAME_TYPE is 0, the vehicle's 1: wrong frame"
    )
    swapped = frame.problem(held | {"SERVO1_FUNCTION": 35, "SERVO3_FUNCTION": 33})
    assert swapped is not None
    assert "output 1" in swapped
    assert "front left" in swapped
    unset = frame.problem(held | {"SERVO4_FUNCTION": 0})
    assert unset is not None
    assert "no motor" in unset


def test_a_profile_names_every_corner_once() -> None:
    data = quad().model_dump()
    data["px4"]["motors"] = ["front right", "front right", "front left", "rear right"]
    with pytest.raises(ValueError, match="each once of front right, rear left"):
        VehicleProfile.model_validate(data)


def test_what_is_set_otherwise_is_listed() -> None:
    assert differences({"A": 1.0, "B": 2}, {"A": 1.0, "B": 3, "C": 4}) == ["B = 2 (vehicle: 3)"]


# --- parameters


def value_message(name: str, raw: bytes, kind: int) -> dialect.MAVLink_message:
    """Return a PARAM_VALUE as decoded from the wire."""
    mav = dialect.MAVLink(None, 1, 1)
    (value,) = struct.unpack("<f", raw)
    frame = dialect.MAVLink_param_value_message(name.encode(), value, kind, 10, 0).pack(mav)
    return dialect.MAVLink(None).decode(bytearray(frame))


def test_px4s_integers_come_bytewise_ardupilots_as_floats() -> None:
    sent: list[dialect.MAVLink_message] = []
    client = ParameterClient(sent.append)
    client.address(1, 1, PX4_ID)
    kind = dialect.MAV_PARAM_TYPE_INT32
    client.take(value_message("CA_ROTOR_COUNT", struct.pack("<i", 4), kind))
    client.take(value_message("MPC_THR_HOVER", struct.pack("<f", 0.52), 9))
    assert client.values == {"CA_ROTOR_COUNT": 4, "MPC_THR_HOVER": pytest.approx(0.52)}
    assert client.set({"CA_ROTOR_COUNT": 6, "MPC_THR_HOVER": 0.52}) == ["CA_ROTOR_COUNT"]
    assert struct.pack("<f", sent[-1].param_value) == struct.pack("<i", 6)
    other = ParameterClient(sent.append)
    other.address(1, 1, ARDUPILOT_ID)
    other.take(value_message("FRAME_TYPE", struct.pack("<f", 1.0), dialect.MAV_PARAM_TYPE_INT8))
    assert other.values == {"FRAME_TYPE": 1}
    other.set({"FRAME_TYPE": 3})
    assert sent[-1].param_value == 3.0


def test_parameters_are_asked_for_in_bursts_until_they_came() -> None:
    sent: list[dialect.MAVLink_message] = []
    client = ParameterClient(sent.append)
    names = [f"P{i}" for i in range(25)]
    assert client.ask(names) == names
    assert sent == []  # no target yet
    client.address(3, 1, PX4_ID)
    client.ask(names)
    assert [message.param_id for message in sent] == names[:10]
    assert {message.target_system for message in sent} == {3}
    for name in names[:10]:
        client.take(value_message(name, struct.pack("<f", 1.0), 9))
    assert client.ask(names) == names[10:]


def test_a_parameter_that_the_firmware_lacks_is_known_at_once() -> None:
    far = Far()
    client = far.observer.parameters
    assert client.ask(["A", "GONE"]) == ["A", "GONE"]
    missing = dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
    far.hear(dialect.MAVLink_param_error_message(254, 191, b"GONE", -1, missing))
    assert (client.ask(["A", "GONE"]), client.absent) == (["A"], {"GONE"})
    busy = dialect.MAV_PARAM_ERROR_READ_ONLY
    far.hear(dialect.MAVLink_param_error_message(254, 191, b"A", -1, busy))
    assert client.absent == {"GONE"}


def test_px4_that_is_silent_about_a_parameter_lacks_it_once_it_answers_others() -> None:
    client = ParameterClient(lambda _: None)
    client.address(1, 1, PX4_ID)
    for _ in range(2 * SILENT_REQUESTS):
        assert client.ask(["A", "GONE"]) == ["A", "GONE"]  # nothing is answered yet
    client.take(value_message("A", struct.pack("<f", 1.0), 9))
    for _ in range(SILENT_REQUESTS):
        assert client.ask(["A", "GONE"]) == ["GONE"]
    assert client.ask(["A", "GONE"]) == []
    assert client.absent == {"GONE"}


def test_the_version_is_asked_for_until_it_came() -> None:
    far = Far()
    far.hear(heartbeat(PX4_ID, 0, 0))
    requests = []
    for now_s in (2, 4):
        far.observer.send(now_s * 1_000_000)
        sent = dialect.MAVLink(None).parse_buffer(b"".join(far.endpoint.take())) or []
        requests.append([m.param1 for m in sent if m.get_type() == "COMMAND_LONG"].count(148.0))
        version = [0, 0x01110180, 0, 0, 0, b"\0" * 8, b"\0" * 8, b"\0" * 8, 0, 0, 0]
        far.hear(dialect.MAVLink_autopilot_version_message(*version))
    assert requests == [1, 0]
    assert far.observer.version == 0x01110180


def test_values_agree_to_the_precision_of_the_wire() -> None:
    assert same(struct.unpack("<f", struct.pack("<f", 0.52))[0], 0.52)
    assert not same(0.521, 0.52)
    assert same(4, 4)
    assert not same(4, 5)


# --- the observer


class Far:
    """The firmware's end of a link in memory."""

    def __init__(self, origin: Geodetic | None = None) -> None:
        self.endpoint = MemoryEndpoint()
        self.observer = FirmwareObserver(self.endpoint, "observer", origin)
        self.mav = dialect.MAVLink(None, 1, 1)
        self.said: list[tuple[int, str]] = []
        self.observer.on_message = lambda m: self.said.append((int(m.severity), m.text))

    def hear(self, *messages: dialect.MAVLink_message) -> None:
        self.endpoint.inbox.extend(message.pack(self.mav) for message in messages)
        self.observer.receive(1_000_000)


def heartbeat(kind: int, mode: int, base: int) -> dialect.MAVLink_message:
    return dialect.MAVLink_heartbeat_message(2, kind, base, mode, 4, 3)


def test_texts_in_pieces_are_put_together() -> None:
    far = Far()
    text = "Preflight Fail: Compass Sensor 0 missing and then some more words of it"
    pieces = [text[:50], text[50:]]
    for i, piece in enumerate(pieces):
        far.hear(dialect.MAVLink_statustext_message(2, piece.encode(), 7, i))
    far.hear(dialect.MAVLink_statustext_message(6, b"Armed by external command"))
    assert far.said == [(2, text), (6, "Armed by external command")]
    assert far.observer.last_text == "Armed by external command"


def test_it_hears_mode_phase_and_readiness() -> None:
    far = Far()
    observer = far.observer
    assert observer.flight(armed=False).phase is FlightPhase.BOOT
    far.hear(heartbeat(PX4_ID, 6 << 16, 145))
    assert observer.heard
    assert not observer.ready
    prearm = dialect.MAV_SYS_STATUS_PREARM_CHECK
    status = dialect.MAVLink_sys_status_message(prearm, prearm, prearm, *([0] * 10))
    far.hear(status)
    assert not observer.ready  # it does not know where it is
    far.hear(dialect.MAVLink_local_position_ned_message(0, *([0.0] * 6)))
    assert observer.ready
    assert observer.flight(armed=False).phase is FlightPhase.STANDBY
    assert observer.flight(armed=True).phase is FlightPhase.GROUND
    far.hear(dialect.MAVLink_extended_sys_state_message(0, dialect.MAV_LANDED_STATE_IN_AIR))
    flight = observer.flight(armed=True)
    assert (flight.phase, flight.mode) == (FlightPhase.AIR, Mode.OFFBOARD)
    observer.restart()
    assert not observer.heard
    assert not observer.ready


def test_others_on_the_link_are_not_taken_for_the_firmware() -> None:
    far = Far()
    far.mav = dialect.MAVLink(None, 245, 190)
    far.hear(heartbeat(8, 0, 0))
    assert not far.observer.heard


def test_it_asks_for_what_does_not_come() -> None:
    far = Far()
    far.observer.send(0)
    assert not far.endpoint.outbox  # no target yet
    far.hear(heartbeat(ARDUPILOT_ID, 4, 89))
    far.observer.send(2_000_000)
    decoder = dialect.MAVLink(None)
    asked = [decoder.decode(bytearray(frame)) for frame in far.endpoint.take()]
    beats = [m for m in asked if m.get_type() == "HEARTBEAT"]
    assert [beat.type for beat in beats] == [dialect.MAV_TYPE_GCS]
    asked = [m for m in asked if m not in beats]
    request = dialect.MAV_CMD_REQUEST_MESSAGE
    assert {m.command for m in asked} == {dialect.MAV_CMD_SET_MESSAGE_INTERVAL, request}
    assert dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE in {int(m.param1) for m in asked}


def test_firmware_without_gps_is_told_its_origin_once_it_knows_where_it_is() -> None:
    far, decoder = Far(Geodetic(47.5, -8.25, 489.4)), dialect.MAVLink(None)

    def sent(now_us: int) -> list[dialect.MAVLink_message]:
        far.observer.send(now_us)
        return [decoder.decode(bytearray(frame)) for frame in far.endpoint.take()]

    far.hear(heartbeat(PX4_ID, 4 << 16, 29))
    first = sent(2_000_000)
    asked = {int(m.param1) for m in first if m.get_type() == "COMMAND_LONG"}
    assert dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS in asked
    assert dialect.MAVLINK_MSG_ID_GPS_RAW_INT not in asked
    assert "SET_GPS_GLOBAL_ORIGIN" not in {m.get_type() for m in first}
    good = dialect.ESTIMATOR_POS_HORIZ_REL
    far.hear(dialect.MAVLink_estimator_status_message(0, good, *([0.0] * 8)))
    (told,) = (m for m in sent(4_000_000) if m.get_type() == "SET_GPS_GLOBAL_ORIGIN")
    place = told.latitude, told.longitude, told.altitude
    assert (told.target_system, place) == (1, (475_000_000, -82_500_000, 489_400))
    prearm = dialect.MAV_SYS_STATUS_PREARM_CHECK
    far.hear(dialect.MAVLink_sys_status_message(prearm, prearm, prearm, *([0] * 10)))
    assert "SET_GPS_GLOBAL_ORIGIN" not in {m.get_type() for m in sent(6_000_000)}


# px4.md: heartbeats as measured.
@pytest.mark.parametrize(
    ("kind", "custom", "landed", "mode"),
    [
        (PX4_ID, 33816576, 3, Mode.TAKEOFF),
        (PX4_ID, 50593792, 2, Mode.HOLD),
        (PX4_ID, 100925440, 4, Mode.LAND),
        (PX4_ID, 84148224, 2, Mode.RETURN),
        (PX4_ID, 393216, 2, Mode.OFFBOARD),
        (PX4_ID, 196608, 2, Mode.POSITION),
        (ARDUPILOT_ID, 4, 3, Mode.TAKEOFF),
        (ARDUPILOT_ID, 4, 2, Mode.OFFBOARD),
        (ARDUPILOT_ID, 9, 4, Mode.LAND),
        (ARDUPILOT_ID, 17, 2, Mode.HOLD),
        (ARDUPILOT_ID, 0, 2, Mode.POSITION),
    ],
)
def test_modes_of_both_families(kind: int, custom: int, landed: int, mode: Mode) -> None:
    flight = flight_of(kind, custom, landed, armed=True, ready=True)
    assert (flight.mode, flight.phase) == (mode, FlightPhase.AIR)


# --- parameters as files


def parameters_of(firmware: str, out: Path) -> list[str]:
    assert write_parameters(ParametersOptions(firmware=firmware, out=out)) == 0
    return out.read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize("firmware", ["px4", "px4-hitl", "ardupilot"])
def test_firmware_that_is_set_from_the_file_flies_the_vehicle(
    firmware: str, tmp_path: Path
) -> None:
    """The firmware's own tools read back the values that are checked on the ground."""
    lines = parameters_of(firmware, tmp_path / "file")
    airframe = firmware_kind(firmware).airframe(quad())
    if firmware == "ardupilot":
        loader = mavparm.MAVParmDict()
        assert loader.load(str(tmp_path / "file"))
        held = dict(loader)
    else:
        rows = [line.split("\t") for line in lines if not line.startswith("#")]
        assert {(vehicle, component) for vehicle, component, *_ in rows} == {("1", "1")}
        held = {name: (int if kind == "6" else float)(v) for _, _, name, v, kind in rows}
        assert held["CA_ROTOR_COUNT"] == 4
        assert isinstance(held["CA_ROTOR_COUNT"], int)
        assert isinstance(held["THR_MDL_FAC"], float)
    assert set(airframe.names()) - set(held) <= {"NAV_DLL_ACT"}
    assert airframe.problem(held) is None
    assert differences(held, airframe.settings) == []


def test_another_order_of_motors_is_in_the_file(tmp_path: Path) -> None:
    profile = tmp_path / "other.toml"
    order = '["rear left", "front right", "front left", "rear right"]'
    profile.write_text(f'base = "quad"\n[px4]\nmotors = {order}\n', encoding="utf-8")
    command = ParametersOptions(firmware="px4", vehicle=str(profile), out=tmp_path / "file")
    assert write_parameters(command) == 0
    text = (tmp_path / "file").read_text(encoding="utf-8")
    assert "PWM_MAIN_FUNC1\t102\t6\n1\t1\tPWM_MAIN_FUNC2\t101\t6\n" in text


def test_parameters_into_no_folder(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no folder"):
        write_parameters(ParametersOptions(firmware="px4", out=tmp_path / "x" / "y"))


# --- programs and options


def test_px4_is_found_in_a_build_a_tree_and_a_package(tmp_path: Path) -> None:
    for layout in ("", "build/px4_sitl_default", "opt/px4"):
        root = tmp_path / (layout.replace("/", "-") or "build")
        where = root / layout
        (where / "bin").mkdir(parents=True)
        (where / "bin" / "px4").touch()
        (where / "etc" / "init.d-posix").mkdir(parents=True)
        (where / "etc" / "init.d-posix" / "rcS").touch()
        program = find_px4(root)
        assert program.binary == where / "bin" / "px4"
        words = program.start(3, 10016, tmp_path / "w").argv
        assert words[:4] == [str(where / "bin" / "px4"), "-d", "-i", "3"]
        assert words[-1] == str(where / "etc")
    with pytest.raises(FirmwareMissingError, match=r"--px4-dir .*: no bin/px4"):
        find_px4(tmp_path)
    with pytest.raises(FirmwareMissingError, match=r"--ardupilot-dir .*: no arducopter"):
        find_arducopter(tmp_path)


def test_folders_of_flights_are_new_each_time(tmp_path: Path) -> None:
    kept = WorkingFolders("px4", tmp_path / "kept", None)
    first, second = kept.fresh(), kept.fresh()
    assert first != second
    assert first.is_dir()
    again = WorkingFolders("px4", tmp_path / "kept", None)
    assert again.fresh() not in (first, second)
    kept.close()
    assert first.is_dir()
    temporary = WorkingFolders("px4", None, None)
    folder = temporary.fresh()
    assert temporary.fresh() != folder
    assert not folder.exists()
    temporary.close()
    assert not temporary.log.parent.exists()


class LoggingFirmware:
    """A bridge to a program that has connected once its log is there."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def wait_connected(self, _timeout_s: float, _alive: Callable[[], None]) -> None:
        wait_until(lambda: any(self._folder.rglob("b.ulg")), "its log")

    def close(self) -> None:
        """Nothing is held."""


def test_a_firmwares_own_log_is_kept_when_its_flight_has_ended(tmp_path: Path) -> None:
    script = (
        "mkdir -p log/day; echo old > log/a.ulg; sleep 0.02; echo whole > log/day/new;"
        " mv log/day/new log/day/b.ulg; exec sleep 60"
    )
    launcher = Launcher(
        px4_airframe(quad(), SITL_OUTPUT),
        lambda: cast(Bridge, LoggingFirmware(tmp_path / "kept")),
        20.0,
        program=lambda _: StartCommand(["/bin/sh", "-c", script], {}),
        folders=WorkingFolders("px4", tmp_path / "kept", None),
    )
    launcher.launch()
    launcher.flight_log = tmp_path / "flight-000.ulg"
    assert not launcher.flight_log.exists()
    launcher.close()
    kept = tmp_path / "flight-000.ulg"
    assert kept.read_text() == "whole\n"
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    assert not list(tmp_path.glob("*.part"))


def test_ardupilot_is_started_with_its_parameters_in_a_file(tmp_path: Path) -> None:
    settings = {"FRAME_TYPE": 1, "MOT_THST_HOVER": 0.52}
    start = start_arducopter(Path("/x/arducopter"), 2, Links(1, 2, 3), settings, tmp_path)
    assert (tmp_path / PARAMETERS).read_text() == "FRAME_TYPE 1\nMOT_THST_HOVER 0.52\n"
    words = list(start.argv)
    assert words[0] == "/x/arducopter"
    assert words[words.index("--defaults") + 1] == PARAMETERS
    assert words[words.index("--sim-port-out") + 1] == "9022"
    assert [word.rpartition(":")[2] for word in words[-5::2]] == ["1", "2", "3"]


@pytest.mark.parametrize(
    ("asked", "level", "words"),
    [
        ({"firmware": "px4"}, "sitl", "firmware 'px4': accepted: with px4_dir or px4_connect"),
        ({"firmware": "px4", "px4_connect": True, "px4_dir": "x"}, "sitl", "with px4_dir or px4_c"),
        ({"px4_connect": True}, "sitl", "real.px4_connect True: accepted: with firmware px4"),
        ({"firmware": "px4-hitl"}, "sitl", "firmware 'px4-hitl': accepted: with serial"),
        ({"px4_connect": True, "instance": 10}, "sitl", "real.instance 10: accepted: 0 <= value"),
        (
            {"px4_connect": True, "firmware_timeout": math.inf},
            "sitl",
            "real.firmware_timeout inf: accepted: 1 <= value <= 3600 s",
        ),
        (
            {"firmware": "px4", "px4_connect": True, "api_port": 15000},
            "sitl",
            "ports.api_port 15000: accepted: its default: PX4 SITL's ports move with instance",
        ),
        ({"firmware": "px4", "px4_connect": True}, "gym", "at level lockstep or sitl"),
        (
            {"firmware": "ardupilot", "ardupilot_connect": True},
            "lockstep",
            "at level sitl; at level lockstep only builtin and px4",
        ),
        ({"firmware": "px4-hitl", "serial": "x"}, "sitl", "speed 2: accepted: 1 with firmware px4"),
    ],
    ids=str,
)
def test_what_cannot_be_flown_is_told(asked: dict[str, Any], level: LevelName, words: str) -> None:
    plain: dict[str, Any] = {"real": {}, "ports": {}}
    for name, value in asked.items():
        table = "ports" if name.endswith("port") else "real" if name != "firmware" else None
        (plain if table is None else plain[table])[name] = value
    with pytest.raises(FieldError) as raised:
        check_firmware(validated(Aircraft, plain), level, 2.0)
    assert words in str(raised.value)


def test_the_user_is_told_what_to_start() -> None:
    def told(firmware: FirmwareName, **options: Any) -> str | None:
        asked = Aircraft(firmware=firmware, real=RealFirmware(**options))
        return how_to_start(asked, quad())

    assert told("px4", px4_connect=True, instance=2) == (
        "while PX4_SIM_MODEL=none_iris PX4_SYS_AUTOSTART=10016 build/px4_sitl_default/bin/px4 -d -i"
        " 2; do sleep 1; done"
    )
    hint = told("ardupilot", ardupilot_connect=True)
    assert hint is not None
    assert hint.startswith("airl parameters ardupilot --vehicle quad --out vehicle.parm && ")
    assert "--defaults vehicle.parm" in hint
    assert "--model JSON:127.0.0.1 --sim-port-out 9002" in hint
    assert "--serial2 udpclient:127.0.0.1:14030" in hint
    assert told("px4", px4_dir=Path("x")) is None
    assert load_timeout_s(Aircraft()) is None
    patient = RealFirmware(px4_connect=True, firmware_timeout=10.0)
    assert load_timeout_s(Aircraft(firmware="px4", real=patient)) == 80.0
