"""The shell over MAVLink, by the real MAVSDK and by hand."""

from __future__ import annotations

import re
import time

import pytest
from mavsdk.plugins.shell import Device, Shell

from airl_mav.core.clock import SimClock
from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.addons.flight_log.topics import TOPICS
from firmware_sim.addons.ground_station_services.shell import DATA_BYTES, MESSAGES_PER_TICK
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.kinematic_autopilot import DEFAULT_PARAMETERS
from tests.support.mavlink_clients import RawClient, Rig, mavsdk_over_memory

SHELL = 10
COMMANDER = (
    *("commander arm [-f]\n", "commander check\n", "commander disarm [-f]\n", "commander land\n"),
    *("commander mode NAME\n", "commander status\n", "commander takeoff\n"),
    "commander termination on\n",
)
MODES = (
    "manual altctl posctl auto:mission auto:loiter auto:rtl acro offboard stabilized auto:takeoff "
    "auto:land auto:precland"
)
LOGGER = "INFO  [logger] not logging\nINFO  [logger] Wrote 0.00 MiB (avg  0.00 KiB/s)\n"
PATIENCE_S = 20.0


def type_in(rig: Rig, text: bytes, device: int = SHELL, flags: int = 6) -> None:
    for start in range(0, len(text), DATA_BYTES):
        part = text[start : start + DATA_BYTES]
        data = list(part.ljust(DATA_BYTES, b"\0"))
        rig.client.send(
            dialect.MAVLink_serial_control_message(device, flags, 0, 0, len(part), data)
        )


def printed(rig: Rig, seconds: float = 0.5) -> str:
    rig.bench.run(seconds)
    parts = [m for m in rig.client.received() if m.get_type() == "SERIAL_CONTROL"]
    assert all(m.flags == 1 and m.device == SHELL for m in parts)
    return b"".join(bytes(m.data[: m.count]) for m in parts).decode("ascii")


def test_mavsdks_shell_has_an_answer() -> None:
    with mavsdk_over_memory() as (companion, _):
        shell = companion.plugin(Shell)
        heard: list[str] = []
        shell.subscribe_receive(lambda text, _data: heard.append(str(text.data)))
        shell.send("ver all", Device.SHELL)
        deadline = time.monotonic() + PATIENCE_S
        while "PX4 version: Release 1.17" not in "".join(heard):
            assert time.monotonic() < deadline, heard
            time.sleep(0.01)


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("", ""),
        ("nosuch x", "Invalid command: nosuch\ntype 'help' for a list of commands\n"),
        ("commander land x", "usage: " + "usage: ".join(COMMANDER)),
        ("param set A 1", "ERROR [param] Parameter A not found.\n"),
        (
            "param set MPC_XY_VEL_MAX fast",
            "ERROR [param] MPC_XY_VEL_MAX: fast: accepted: a number\n",
        ),
        ("perf", "perf: only in PX4, not in the built-in flight controller\n"),
        ("param compare NAV_DLL_ACT 0", ""),
        (
            "commander mode flip",
            f"ERROR [commander] argument flip unsupported: there are {MODES}\n",
        ),
        ("logger off", "WARN  [logger] the log begins and ends with the flight\n"),
        ("logger status", LOGGER),
        (
            "failure gps off",
            "ERROR [failure] Failure injection disabled by SYS_FAILURE_EN param.\n",
        ),
    ],
)
def test_a_line_is_echoed_answered_and_followed_by_the_prompt(line: str, answer: str) -> None:
    rig = Rig()
    type_in(rig, line.encode() + b"\n")
    assert printed(rig) == f"{line}\n{answer}pxh> "


def test_what_it_shows_is_the_vehicles() -> None:
    rig = Rig()
    type_in(rig, b"param show M*\n")
    shown = printed(rig)
    assert "x   MIS_TAKEOFF_ALT [2,2] : 2.5000\n" in shown
    assert "COM_OF" not in shown
    assert f"{len(DEFAULT_PARAMETERS)}/{len(DEFAULT_PARAMETERS)} parameters used." in shown
    type_in(rig, b"commander status\n")
    assert "Disarmed\nINFO  [commander] navigation mode: Hold\n" in printed(rig)
    rig.command(400, 1)
    type_in(rig, b"commander status\n")
    assert "] Armed\n" in printed(rig)
    for topic in ("vehicle_status", "battery_status", "vehicle_attitude", "vehicle_local_position"):
        type_in(rig, f"listener {topic}\n".encode())
        assert f"TOPIC: {topic}\n" in printed(rig)
    type_in(rig, b"listener nosuch\nuptime\n")
    shown = printed(rig)
    assert "Topic nosuch did not match" in shown
    assert "Uptime: " in shown


def test_a_line_may_come_in_parts_and_never_ends_without_its_end() -> None:
    rig = Rig()
    type_in(rig, b"he")
    assert printed(rig) == ""
    type_in(rig, b"lp" + b"\n")
    assert printed(rig).startswith("help\n")
    type_in(rig, b"x" * 1000 + b"\n")
    assert printed(rig).startswith("x" * 256 + "\nInvalid")


def test_a_long_answer_is_sent_piece_by_piece() -> None:
    rig = Rig()
    type_in(rig, b"help\n" * 30)
    rig.bench.tick()
    parts = [m for m in rig.client.received() if m.get_type() == "SERIAL_CONTROL"]
    assert len(parts) == MESSAGES_PER_TICK


def test_other_devices_and_replies_are_not_ours() -> None:
    rig = Rig()
    type_in(rig, b"help\n", device=0)
    type_in(rig, b"help\n", flags=dialect.SERIAL_CONTROL_FLAG_REPLY)
    assert printed(rig) == ""


def effects(rig: Rig) -> list[str]:
    return [effect.message for effect in rig.bench.server.effects()]


def test_commands_act_as_their_mavlink_commands_and_are_recorded() -> None:
    rig = Rig()
    for line, printed_, known in (
        ("commander status", "] Disarmed\n", []),
        ("commander check", "Preflight check: OK\n", ["tell checks"]),
        ("commander arm", "", ["arm force=False"]),
        ("commander mode auto:rtl", "", ["mode RETURN"]),
        ("commander mode posctl", "DO_SET_MODE: TEMPORARILY_REJECTED\n", ["mode POSITION"]),
        ("commander takeoff", "", ["arm force=False"]),
        ("commander land", "", ["mode LAND"]),
        ("commander disarm -f", "", ["disarm force=True"]),
        ("commander termination on", "DO_FLIGHTTERMINATION: DENIED\n", ["terminate"]),
    ):
        rig.bench.autopilot.commands.clear()
        type_in(rig, line.encode() + b"\n")
        assert printed_ in printed(rig, 0.1)
        assert rig.bench.autopilot.commands == known, line
        assert effects(rig) == ([] if line in READING else ["SERIAL_CONTROL"])
    assert rig.bench.autopilot.takeoffs == [None]


READING = ("commander status", "commander check")


def test_parameters_are_set_saved_compared_and_reset() -> None:
    rig = Rig()
    type_in(rig, b"param set MPC_XY_VEL_MAX 8.5\nparam set NAV_DLL_ACT 2\n")
    shown = printed(rig)
    assert "+ MPC_XY_VEL_MAX: curr: 12.0000 -> new: 8.5000\n" in shown
    assert "+ NAV_DLL_ACT: curr: 0 -> new: 2\n" in shown
    assert effects(rig) == ["SERIAL_CONTROL", *(f"SERIAL_CONTROL {n}" for n in CHANGED)]
    type_in(rig, b"param compare NAV_DLL_ACT 0\nparam show -c\nparam save\n")
    shown = printed(rig)
    assert "  NAV_DLL_ACT: curr: 2\n" in shown
    assert "x + MPC_XY_VEL_MAX [3,3] : 8.5000\n" in shown and "SYS_AUTOSTART" not in shown
    type_in(rig, b"param reset mpc_* NAV_DLL_ACT\nparam reset NO_SUCH\n")
    assert "param NO_SUCH not found" in printed(rig)
    assert rig.bench.autopilot.parameters.values == DEFAULT_PARAMETERS


CHANGED = ("MPC_XY_VEL_MAX", "NAV_DLL_ACT")


def test_listener_prints_messages_as_px4() -> None:
    rig = Rig()
    rig.bench.run(0.5)
    type_in(rig, b"listener vehicle_local_position -n 3\n")
    shown = printed(rig, 1.0)
    assert shown.count("TOPIC: vehicle_local_position\n vehicle_local_position\n") == 3
    assert re.search(r"    timestamp: \d+ \(0\.\d{6} seconds ago\)\n", shown)
    assert "    timestamp_sample: " in shown and " us before timestamp)\n" in shown
    assert "    x: 0.00000\n" in shown and "    xy_valid: True\n" in shown
    assert "    ref_lat: 47." in shown
    type_in(rig, b"listener vehicle_attitude\nlistener vehicle_visual_odometry\n")
    shown = printed(rig)
    assert "    q: [1.00000, 0.00000, 0.00000, 0.00000]\n" in shown
    assert "TOPIC: vehicle_visual_odometry\nnever published\n" in shown
    # Every topic of the log is there; those of the simulator and of events are never published.
    for logged in TOPICS:
        type_in(rig, f"listener {logged.topic.name}\n".encode())
        assert f"TOPIC: {logged.topic.name}\n" in printed(rig, 0.1)
    # Another line ends it.
    type_in(rig, b"listener cpuload -n 100\n")
    assert "TOPIC: cpuload" in printed(rig, 0.1)
    type_in(rig, b"\n")
    printed(rig, 0.1)
    assert printed(rig, 2.0) == ""


def test_status_of_modules() -> None:
    rig = Rig()
    rig.bench.run(0.5)
    type_in(rig, b"ekf2 status\nmavlink status\nuorb top\ntop once\n")
    shown = printed(rig)
    assert "ekf2:0 EKF dt: 0.0040s, attitude: 1, local position: 1, global position: 1\n" in shown
    assert "\tmavlink chan: gcs\n" in shown or "\tmavlink chan: onboard\n" in shown
    assert re.search(r"\t  tx: [1-9]\d* messages\n", shown)
    assert re.search(r"vehicle_attitude  +0    1   25  1   32 \n", shown)
    assert "CPU usage: 12.30% tasks" in shown
    type_in(rig, b"mavlink status streams\n")
    assert re.search(r"\tATTITUDE +\d+\.\d\d \(\d+\.\d{3}\)\n", printed(rig))


def test_failures_are_injected_and_texts_listed() -> None:
    flight = GroundedFlight()
    shell = flight.shell
    assert shell("param set SYS_FAILURE_EN 0") == "+ SYS_FAILURE_EN: curr: 1 -> new: 0\n"
    assert "disabled by SYS_FAILURE_EN" in shell("failure gps off")
    assert shell("param set SYS_FAILURE_EN 1") == "+ SYS_FAILURE_EN: curr: 0 -> new: 1\n"
    assert "Component 'gpz' not found: there are gyro accel" in shell("failure gpz off")
    assert "Failure type 'of' not found: there are ok off" in shell("failure gps of")
    assert shell("failure gps off -i x").startswith("usage: failure COMPONENT TYPE")
    assert shell("failure gps off") == (
        "WARN  [failure] inject failure unit: gps (4), type: off (1), instance: 0\n"
    )
    flight.run(3.0)
    # The arming checks hold.
    assert shell("commander arm") == (
        "ERROR [commander] COMPONENT_ARM_DISARM: TEMPORARILY_REJECTED\n"
    )
    assert "Arming denied: Resolve system health failures first" in shell("dmesg")
    flags = shell("listener failsafe_flags")
    assert "    global_position_invalid: True\n" in flags


class GroundedFlight:
    """The built-in flight controller on the ground, ready to arm, with a client's shell."""

    def __init__(self) -> None:
        self.simulation = Simulation(
            EpisodeSetup(load_vehicle("quad"), None, 1), start_us=0, clock=SimClock()
        )
        self.endpoint = MemoryEndpoint()
        self.server = MavlinkServer([onboard_link(self.endpoint)], boot_unix_us=0)
        self.simulation.tick()
        assert self.simulation.autopilot.internals is not None
        self.server.attach(self.simulation.autopilot.internals, None)
        self.client = RawClient(self.endpoint)
        self.run(6.0)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 250)):
            self.server.receive(self.simulation.time_us)
            self.simulation.tick()
            self.server.send(self.simulation.time_us, self.simulation.flown)

    def shell(self, line: str) -> str:
        self.client.received()
        data = list(f"{line}\n".encode().ljust(DATA_BYTES, b"\0"))
        message = dialect.MAVLink_serial_control_message(SHELL, 6, 0, 0, len(line) + 1, data)
        self.client.send(message)
        self.run(0.3)
        parts = [m for m in self.client.received() if m.get_type() == "SERIAL_CONTROL"]
        text = b"".join(bytes(m.data[: m.count]) for m in parts).decode("ascii")
        return text.removeprefix(f"{line}\n").removesuffix("pxh> ")
