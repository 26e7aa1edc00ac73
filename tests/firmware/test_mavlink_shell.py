"""The shell over MAVLink, by the real MAVSDK and by hand."""

from __future__ import annotations

import time

import pytest
from mavsdk.plugins.shell import Device, Shell

from firmware_sim.addons.ground_station_services.shell import DATA_BYTES, MESSAGES_PER_TICK
from firmware_sim.mavlink.codec import dialect
from tests.support.kinematic_autopilot import DEFAULT_PARAMETERS
from tests.support.mavlink_clients import Rig, mavsdk_over_memory

SHELL = 10
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
        while "PX4 version: 1.17" not in "".join(heard):
            assert time.monotonic() < deadline, heard
            time.sleep(0.01)


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("", ""),
        ("nosuch x", "Invalid command: nosuch\ntype 'help' for a list of commands\n"),
        ("commander", "usage: commander status\n"),
        ("param set A 1", "usage: param show [NAME]\n"),
        ("help", "  commander\n  help\n  listener\n  param\n  uptime\n  ver\n"),
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
    assert "MIS_TAKEOFF_ALT [2,2] : 2.5000\n" in shown
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
    type_in(rig, b"help\n" * 60)
    rig.bench.tick()
    parts = [m for m in rig.client.received() if m.get_type() == "SERIAL_CONTROL"]
    assert len(parts) == MESSAGES_PER_TICK


def test_other_devices_and_replies_are_not_ours() -> None:
    rig = Rig()
    type_in(rig, b"help\n", device=0)
    type_in(rig, b"help\n", flags=dialect.SERIAL_CONTROL_FLAG_REPLY)
    assert printed(rig) == ""
