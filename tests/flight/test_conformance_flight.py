"""airl conformance as a process, against the airl-firmware process."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from airl_mav.addons.conformance.telemetry import STEP_NAMES
from airl_mav.profiles.loading import profiles_dir
from airl_mav.profiles.px4_release import CURRENT
from tests.support.ports import LOOPBACK, TestPorts, choose_ports, free_ports
from tests.support.processes import Running, running, write_arena

SPEED = 3.0

QUIET = """base = "quad"
[sensors.gps]
velocity_noise_m_s = 0.004
horizontal_noise_m = 0.02
vertical_noise_m = 0.02
[parameters]
"""
"""Sensors of a simulator with little noise, similar to the simulator of PX4's column."""


@contextmanager
def firmware(folder: Path, vehicle: str) -> Iterator[TestPorts]:
    """The built-in firmware, above an empty corridor."""
    ports = choose_ports()
    profile = folder / "vehicle.toml"
    profile.write_text(vehicle, encoding="utf-8")
    words = [
        *("-m", "airl_mav.cli.firmware_command", "--arena", str(write_arena(folder, 60.0))),
        *("--vehicle", str(profile), "--speed", str(SPEED), *ports.options()),
    ]
    with running(words, folder) as process:
        process.wait_for_text("Ctrl-C ends it")
        yield ports
        process.process.terminate()
        assert process.wait() == 0, process.text()


@contextmanager
def conformance(folder: Path, *options: str) -> Iterator[Running]:
    """The command."""
    with running(["-m", "airl_mav.cli.main", "conformance", *options], folder) as process:
        yield process


def connect(ports: TestPorts) -> list[str]:
    """Options for a firmware process."""
    return ["--connect", f"udpin://{LOOPBACK}:{ports.api}", "--speed", str(SPEED)]


def checks_of(path: Path) -> dict[str, dict[str, Any]]:
    """Return the checks of a result by name."""
    data = json.loads(path.read_text(encoding="utf-8"))
    assert data["schema"] == 1
    return {check["name"]: check for check in data["checks"]}


def patient_reference(folder: Path) -> Path:
    """Return the column of the release flown, with a tolerance of 0.2 s on times.

    These tests run at three times real time: a delay of 10 ms between two processes on a busy host
    is 30 ms of simulated time. tests/flight/test_step_response.py checks the latencies to 10 % in
    simulated time.
    """
    column = (profiles_dir() / "conformance" / f"px4-{CURRENT}.toml").read_text(encoding="utf-8")
    path = folder / "px4.toml"
    assert "floor_s = 0.015" in column
    path.write_text(column.replace("floor_s = 0.015", "floor_s = 0.200"), encoding="utf-8")
    return path


@pytest.mark.slow
@pytest.mark.xdist_group("rehearsal")
@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    "steps",
    # Its answers by PX4's own ways are held to PX4's in simulated time: test_px4_walk.py.
    [("north-2",), pytest.param(STEP_NAMES, marks=pytest.mark.nightly)],
    ids=["one step", "all steps"],
)
def test_the_built_in_firmware_conforms_to_px4(steps: tuple[str, ...], tmp_path: Path) -> None:
    """Steps are held to PX4's in simulated time by tests/flight/test_step_response.py, too."""
    out, whole = tmp_path / "result.json", steps == STEP_NAMES
    options = ["--reference", str(patient_reference(tmp_path)), "--steps", *steps]
    options += [] if whole else ["--steps-only", "--altitude-m", "3"]
    with (
        firmware(tmp_path, QUIET) as ports,
        conformance(tmp_path, *connect(ports), *options, "--out", str(out)) as command,
    ):
        status = command.wait()
        text = command.text()
    assert status == 0, text
    assert re.search(
        rf"^CONFORMS to PX4 {CURRENT}: \d+ passed, 0 failed, 0 not applicable; PX4 {CURRENT}",
        text,
        re.M,
    )
    checks = checks_of(out)
    assert {check["outcome"] for check in checks.values()} == {"pass"}
    assert {f"step {name}" for name in steps} < set(checks)
    if whole:
        # By PX4's own ways, not just anyhow.
        assert "refused" in checks["frame 9 BODY_OFFSET_NED"]["finding"]
        assert "Failsafe activated" in checks["offboard loss"]["finding"]
        assert "TEMPORARILY_REJECTED" in checks["disarming in the air"]["finding"]
    # The table has both columns.
    data = json.loads(out.read_text(encoding="utf-8"))
    assert [step["name"] for step in data["steps"]] == [
        each for each in STEP_NAMES if each in steps
    ]
    for step in data["steps"]:
        stored = data["reference"]["steps"][step["name"]]
        rise_ms = f"{1e3 * step['median']['rise_s']:.0f}"
        (row,) = re.findall(rf"│ {step['name']} +│ measured +│(.*)", text)
        assert rise_ms in row.replace(" ", "").split("│")
        assert f"{1e3 * stored['rise_s']:.0f}" in text
    assert len(data["transcript"]) > (100 if whole else 50)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.xdist_group("rehearsal")
@pytest.mark.timeout(300)
def test_a_detuned_vehicle_does_not_conform(tmp_path: Path) -> None:
    out = tmp_path / "result.json"
    options = ["--steps-only", "--steps", "north-2", "--altitude-m", "3", "--out", str(out)]
    with (
        firmware(tmp_path, QUIET + "MPC_XY_VEL_P_ACC = 1.2\n") as ports,
        conformance(tmp_path, *connect(ports), *options) as command,
    ):
        status = command.wait()
        text = command.text()
    assert status == 1, text
    failed = rf"^FAILED: \d+ passed, 1 failed, .*: step north-2; PX4 {CURRENT}"
    assert re.search(failed, text, re.M), text
    checks = checks_of(out)
    assert checks["step north-2"]["outcome"] == "fail"
    assert "rise" in checks["step north-2"]["finding"]
    assert checks["auto-disarm"]["outcome"] == "pass"


@pytest.mark.nightly  # The end of a flight is noted: test_conformance.py.
@pytest.mark.slow
@pytest.mark.xdist_group("rehearsal")
@pytest.mark.timeout(300)
def test_ctrl_c_lands(tmp_path: Path) -> None:
    out = tmp_path / "result.json"
    options = ["--steps-only", "--altitude-m", "3", "--out", str(out)]
    with (
        firmware(tmp_path, QUIET) as ports,
        conformance(tmp_path, *connect(ports), *options) as command,
    ):
        command.wait_for_text("-> set_velocity_ned")
        command.process.send_signal(signal.SIGINT)
        assert command.wait() == 130, command.text()
        text = command.text()
    assert "landed and disarmed" in text
    assert "INTERRUPTED" in text
    data = json.loads(out.read_text(encoding="utf-8"))
    assert (data["interrupted"], data["passed"], data["known_to_be_down"]) == (True, False, True)


def test_nobody_there(tmp_path: Path) -> None:
    (port,), _ = free_ports(1, 0)
    url = f"udpin://{LOOPBACK}:{port}"
    with conformance(tmp_path, "--connect", url, "--connect-timeout-s", "1") as command:
        assert command.wait() == 2, command.text()
        assert f"--connect {url}: no flight controller heard in 1 s" in command.text()
