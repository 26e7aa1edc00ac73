"""Whole rehearsals with real firmware's place taken by peers that speak as it was measured to."""

from __future__ import annotations

import json
import signal
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil

from tests.support.hitl_peer import HitlPeer
from tests.support.ports import choose_ports, free_ports
from tests.support.processes import (
    ROOT,
    SITL,
    SITL_WITHOUT_REPORT,
    Running,
    children_of,
    has_ended,
    is_running,
    running,
    wait_until,
    write_arena,
)
from tests.support.px4_peer import write_build

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("rehearsal"), pytest.mark.timeout(300)]

SPEED = "6"


def sitl(firmware: str, *options: str, report: bool = False) -> list[str]:
    _, (camera,) = free_ports(0, 1)
    return [
        *(SITL if report else SITL_WITHOUT_REPORT),
        *("--firmware", firmware, "--camera-port", str(camera)),
        *("--speed", SPEED, "--episodes", "1", "--out", "run", *options),
    ]


def px4(build: Path, instance: int, *options: str, report: bool = False) -> list[str]:
    number = ("--instance", str(instance))
    return sitl("px4", "--px4-dir", str(build), *number, *options, report=report)


def leashed(process: Running) -> list[int]:
    """Return the firmware programs that a rehearsal has started."""
    firmware = children_of(process.pid).get("firmware")
    return [] if firmware is None else list(children_of(firmware).values())


def episode(folder: Path) -> dict[str, Any]:
    (line,) = (folder / "run" / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    flown: dict[str, Any] = json.loads(line)
    return flown


def setup(folder: Path) -> dict[str, Any]:
    info: dict[str, dict[str, Any]] = json.loads((folder / "run" / "run.json").read_text())
    return info["setup"]


@pytest.mark.nightly
def test_a_rehearsal_with_px4_that_dies_once(tmp_path: Path, px4_instance: int) -> None:
    """It dies in its first flight only; the rehearsal takes a new one, and says so."""
    healthy = write_build(tmp_path / "healthy")
    build = write_build(tmp_path / "px4", "--fault", "die@12")
    program = build / "bin" / "px4"
    mark = tmp_path / "flown"
    faulty = program.read_text()
    program.write_text(
        f'#!/bin/sh\nif [ -e {mark} ]; then exec {healthy / "bin" / "px4"} "$@"; fi\n'
        f"touch {mark}\n{faulty}"
    )
    arena = write_arena(tmp_path, 10.0)
    with running(px4(build, px4_instance, "--arena", str(arena), report=True), tmp_path) as process:
        programs = wait_until(lambda: leashed(process), "PX4")
        assert process.wait(250.0) == 0, process.text()
        for pid in programs:
            wait_until(partial(has_ended, pid), "PX4 to end", 30.0)
    run, flown = tmp_path / "run", episode(tmp_path)
    assert "begins again: the firmware gave up: PX4" in process.text()
    assert flown["outcome"] == "success"
    assert flown["notes"][0].startswith("flown again: the firmware gave up: PX4")
    told = setup(tmp_path)
    assert told["level"] == "firmware"
    assert told["firmware"].startswith("PX4 1.")
    assert "PX4 SITL" in process.text()
    assert told["firmware"] in process.text()
    assert told["firmware"] in (run / "report.html").read_text(encoding="utf-8")
    assert "peer: simulator on TCP port" in (run / "autopilot.log").read_text(encoding="utf-8")
    with np.load(run / "latency.npz") as archive:
        names = {name.partition("/")[2] for name in archive.files}
    # Unobservable quantities are absent.
    assert "sent_us" in names
    assert not names & {"accepted_us", "motor_us", "estimate/position"}
    log = mavutil.mavlogfile(str(run / "flight-000.tlog"))
    modes = set()
    while (message := log.recv_match(type="HEARTBEAT")) is not None:
        modes.add(message.custom_mode)
    log.close()
    assert 6 << 16 in modes  # offboard, heard on the payload link
    for name in ("firmware.log", "companion.log"):
        assert (run / name).read_text(encoding="utf-8") == ""


@pytest.mark.nightly  # test_real_firmware_parts.py finds each.
def test_a_wrong_motor_order_is_found_on_the_ground(tmp_path: Path, px4_instance: int) -> None:
    build = write_build(tmp_path / "px4", "--fault", "motors")
    with running(px4(build, px4_instance), tmp_path) as process:
        assert process.wait(100.0) == 2, process.text()
    (line,) = [line for line in process.text().splitlines() if "error" in line]
    assert "wrong motor order" in line
    assert not (tmp_path / "run").exists()


@pytest.mark.nightly
def test_px4_does_not_outlive_a_killed_rehearsal(tmp_path: Path, px4_instance: int) -> None:
    build = write_build(tmp_path / "px4")
    with running(px4(build, px4_instance), tmp_path) as process:
        (program,) = wait_until(lambda: leashed(process), "PX4")
        process.process.send_signal(signal.SIGKILL)
        wait_until(lambda: not is_running(program), "PX4 to end", 60.0)


@pytest.mark.nightly
def test_a_px4_that_never_comes_is_waited_for_in_vain(tmp_path: Path, px4_instance: int) -> None:
    words = sitl("px4", "--px4-connect", "--instance", str(px4_instance), "--firmware-timeout", "2")
    with running(words, tmp_path) as process:
        assert process.wait(100.0) == 2, process.text()
    assert f"PX4 did not connect to TCP port {4560 + px4_instance} within 2 s" in process.text()
    assert f"bin/px4 -d -i {px4_instance}; do sleep 1; done" in process.text()
    assert not (tmp_path / "run").exists()


@pytest.mark.nightly
def test_a_rehearsal_with_ardupilot(tmp_path: Path, px4_instance: int) -> None:
    program = tmp_path / "arducopter"
    peer = ROOT / "tests" / "support" / "ardupilot_peer.py"
    program.write_text(f'#!/bin/sh\nexec env PYTHONPATH={ROOT} {sys.executable} {peer} "$@"\n')
    program.chmod(0o755)
    ports = choose_ports()
    words = [
        *sitl("ardupilot", "--ardupilot-dir", str(program), "--instance", str(px4_instance)),
        *("--api-port", str(ports.api), "--gcs-port", str(ports.gcs)),
        *("--arena", str(write_arena(tmp_path, 10.0))),
    ]
    with running(words, tmp_path) as process:
        assert process.wait(250.0) == 0, process.text()
    assert episode(tmp_path)["outcome"] == "success"
    assert setup(tmp_path)["firmware"] == "ArduPilot SITL"
    assert "Starting sketch" in (tmp_path / "run" / "autopilot.log").read_text(encoding="utf-8")


@pytest.mark.nightly
def test_a_rehearsal_with_a_board(tmp_path: Path) -> None:
    """The board runs at real time on a pseudo-terminal; its different airframe is reported."""
    ports = choose_ports()
    peer = HitlPeer(tmp_path)
    words = [
        *sitl("px4-hitl", "--serial", peer.device, "--arena", str(write_arena(tmp_path, 10.0))),
        *("--speed", "1", "--api-port", str(ports.api), "--gcs-port", str(ports.gcs)),
        *("--api-local-port", str(ports.api_local), "--gcs-local-port", str(ports.gcs_local)),
    ]
    try:
        with running(words, tmp_path) as process:
            assert process.wait(200.0) == 0, process.text()
    finally:
        peer.close()
    assert episode(tmp_path)["outcome"] == "success"
    assert setup(tmp_path)["firmware"] == "PX4 on a board"
    assert "CA_ROTOR0_PX = 0.1515 (vehicle: 0.13)" in process.text()
    assert peer.boots > 1  # rebooted before it flew
    assert peer.received["HIL_SENSOR"] > 1000
    assert peer.received["HIL_STATE_QUATERNION"] == 0
