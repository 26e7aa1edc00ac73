"""The real airl-firmware, flown by clients of other makes: MAVSDK over gRPC, dronekit, MAVProxy.

They are installed by `scripts/foreign_clients.py FOLDER`, and found through AIRL_FOREIGN_CLIENTS.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.support.ports import TestPorts, choose_ports, free_ports
from tests.support.processes import ROOT, Running, running, wait_until

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.slow,
    pytest.mark.xdist_group("flight"),
    pytest.mark.timeout(300),
]

FOLDER = "AIRL_FOREIGN_CLIENTS"
PROGRAMS = ROOT / "tests" / "support" / "foreign_clients"
LEAST_PARAMETERS = 877
"""A PX4 1.16 SITL's."""


def interpreter(client: str) -> str:
    """Return the Python of a client's environment; skip the test without an environment."""
    folder = os.environ.get(FOLDER)
    if folder is None:
        pytest.skip(f"{FOLDER} is not set: scripts/foreign_clients.py FOLDER installs {client}")
    python = Path(folder).expanduser() / client / "bin" / "python"
    if not python.exists():
        pytest.skip(f"{python} is not there: scripts/foreign_clients.py {folder} installs {client}")
    return str(python)


@contextmanager
def vehicle(folder: Path) -> Iterator[tuple[Running, TestPorts]]:
    """Start the vehicle, in real time."""
    ports = choose_ports()
    words = ["-m", "airl_mav.cli.firmware_command", "--arena", "no-obstacles", *ports.options()]
    with running(words, folder) as firmware:
        wait_until(lambda: "Ctrl-C ends it" in firmware.text(), "the vehicle")
        yield firmware, ports


@contextmanager
def started(words: list[str], folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], Path]]:
    """Start a client; end it and all that it has started (mavsdk-grpc leaves its server behind)."""
    said = folder / "client.txt"
    environment = {"HOME": str(folder), "PATH": os.environ["PATH"]}
    with said.open("wb") as out:
        client = subprocess.Popen(
            words,
            stdin=subprocess.PIPE,
            stdout=out,
            stderr=subprocess.STDOUT,
            cwd=folder,
            env=environment,
            start_new_session=True,
        )
    try:
        yield client, said
    finally:
        with suppress(ProcessLookupError):
            os.killpg(client.pid, signal.SIGKILL)
        client.wait()
        if client.stdin is not None:
            client.stdin.close()


def flown_by(words: list[str], folder: Path) -> dict[str, float]:
    """Let a client's program fly; return the figures in its last line."""
    with started(words, folder) as (client, said):
        wait_until(lambda: client.poll() is not None, f"the end of {words[1]}", 200.0)
        text = said.read_text(encoding="utf-8", errors="replace")
        assert client.returncode == 0, text
    got: dict[str, float] = json.loads(text.splitlines()[-1])
    return got


def test_mavsdk_over_grpc(tmp_path: Path) -> None:
    python = interpreter("mavsdk-grpc")
    with vehicle(tmp_path) as (firmware, ports):
        _, (server,) = free_ports(0, 1)
        program = str(PROGRAMS / "mavsdk_grpc_client.py")
        got = flown_by([python, program, str(ports.api), str(server)], tmp_path)
        wait_until(lambda: "Disarmed by landing" in firmware.text(), "the landing")
    assert got["parameters"] >= LEAST_PARAMETERS
    assert got["moved_m"] > 2.0


def test_dronekit(tmp_path: Path) -> None:
    python = interpreter("dronekit")
    with vehicle(tmp_path) as (firmware, ports):
        program = str(PROGRAMS / "dronekit_client.py")
        got = flown_by([python, program, str(ports.gcs)], tmp_path)
        assert "Disarmed by landing" in firmware.text()
    assert got["parameters"] >= LEAST_PARAMETERS
    assert got["height_m"] > 3.0


def test_mavproxy(tmp_path: Path) -> None:
    python = interpreter("mavproxy")
    with vehicle(tmp_path) as (firmware, ports):
        program = str(Path(python).with_name("mavproxy.py"))
        words = [python, program, f"--master=udpin:127.0.0.1:{ports.gcs}"]
        words.append("--default-modules=param,arm,cmdlong,mode")
        with started(words, tmp_path) as (client, said):

            def type_in(line: str) -> None:
                assert client.stdin is not None
                client.stdin.write(line.encode() + b"\n")
                client.stdin.flush()

            def wait_for(pattern: str, retype: Callable[[], None] = lambda: None) -> re.Match[str]:
                def found() -> re.Match[str] | None:
                    return re.search(pattern, said.read_text(errors="replace"))

                for _ in range(10):
                    retype()
                    with suppress(AssertionError):
                        match: re.Match[str] = wait_until(found, pattern, 10.0)
                        return match
                raise AssertionError(f"no {pattern!r} in {said.read_text(errors='replace')}")

            wait_for("online system 1")
            type_in("param fetch")
            downloaded = wait_for(r"Received (\d+) parameters", lambda: type_in("param status"))
            assert int(downloaded[1]) >= LEAST_PARAMETERS
            type_in("param set MIS_TAKEOFF_ALT 4")
            wait_for(r"MIS_TAKEOFF_ALT\s+4", lambda: type_in("param show MIS_TAKEOFF_ALT"))
            wait_for("ARMED", lambda: type_in("arm throttle"))
            type_in("long MAV_CMD_NAV_TAKEOFF 0 0 0 nan nan nan nan")
            wait_for("Mode TAKEOFF")
            wait_for("Mode TAKEOFF(.|\n)*Mode LOITER")
            type_in("long MAV_CMD_NAV_LAND 0 0 0 nan nan nan nan")
            wait_for("Mode LAND")
            wait_for("DISARMED")
        assert "Disarmed by landing" in firmware.text()
