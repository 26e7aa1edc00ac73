"""Service manager notifications of the companion, on a socket created by the test."""

from __future__ import annotations

import os
import queue
import socket
import sys
import tempfile
import threading
import uuid
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from companion.status_reports import (
    NO_TEMPERATURE,
    NOT_KNOWN_8,
    ServiceManager,
    computer_status,
    service,
)
from tests.support.ports import LOOPBACK, choose_ports
from tests.support.processes import running

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="systemd is Linux'")


class Listener:
    """The service manager's end; it reads on from a thread, as systemd does."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address.replace("@", "\0", 1))
        self.socket.settimeout(0.05)
        self.lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)

    def listen(self) -> None:
        self._thread.start()

    def _read(self) -> None:
        while not self._ended.is_set():
            with suppress(TimeoutError):
                for line in self.socket.recv(4096).decode().splitlines():
                    self.lines.put(line)

    def until(self, last: str) -> list[str]:
        """Return the lines up to one."""
        found: list[str] = []
        while not found or found[-1] != last:
            found.append(self.lines.get(timeout=30.0))
        return found

    def close(self) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        self.socket.close()


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest) -> Iterator[Listener]:
    # Short: a socket's path has 108 bytes at most.
    with tempfile.TemporaryDirectory() as folder:
        kind = request.param
        listener = Listener(f"{folder}/notify" if kind == "path" else f"@{uuid.uuid4().hex}")
        yield listener
        listener.close()


def test_facts_arrive_as_lines(manager: Listener) -> None:
    manager.listen()
    with service({"NOTIFY_SOCKET": manager.address}) as told:
        told.tell(READY="1", STATUS="waiting\nfor nobody")
    assert manager.until("STOPPING=1") == ["READY=1", "STATUS=waiting for nobody", "STOPPING=1"]


def test_signs_of_life_only_where_they_are_wanted(manager: Listener) -> None:
    manager.listen()
    known = {"NOTIFY_SOCKET": manager.address}
    for watched in ({"WATCHDOG_PID": f"{os.getpid()}"}, {}):
        with service(known | watched | {"WATCHDOG_USEC": "40000"}):
            for _ in range(3):
                assert manager.until("WATCHDOG=1") == ["WATCHDOG=1"]
        manager.until("STOPPING=1")
    for other in ({"WATCHDOG_PID": "1"}, {"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "soon"}):
        found = ServiceManager(known | {"WATCHDOG_USEC": "40000"} | other)
        assert found.watchdog_us is None
        found.close()


def test_a_manager_that_reads_nothing_holds_nobody_up(manager: Listener) -> None:
    with service({"NOTIFY_SOCKET": manager.address}) as told:
        for number in range(5_000):
            told.tell(STATUS=f"{number}")
        manager.listen()
        manager.until("STATUS=0")
        # Room again: it is heard again.
        while manager.lines.empty():
            told.tell(STATUS="on")
    assert manager.until("STOPPING=1")


@pytest.mark.parametrize("address", ["", "/nowhere/at/all", "tcp:1234"])
def test_without_a_manager_nothing_is_told(address: str) -> None:
    with service({"NOTIFY_SOCKET": address}) as told:
        told.tell(READY="1")


def test_a_manager_that_goes_away_is_no_failure(manager: Listener) -> None:
    with service({"NOTIFY_SOCKET": manager.address}) as told:
        manager.close()
        told.tell(STATUS="still here")
        told.tell(STATUS="and here")


def test_the_program_says_that_it_is_ready_and_alive(manager: Listener, tmp_path: Path) -> None:
    manager.listen()
    ports = choose_ports()
    words = [
        *("-m", "airl_mav.cli.companion_command", "--policy", "greedy", "--connect-timeout", "1.5"),
        *("--connect", f"udpin://{LOOPBACK}:{ports.api}"),
        *("--camera", f"tcp://{LOOPBACK}:{ports.camera}"),
    ]
    told = {"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "200000"}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in told.items():
            patch.setenv(name, value)
        with running(words, tmp_path) as program:
            assert program.wait(60.0) == 1, program.text()
    lines = manager.until("STOPPING=1")
    assert lines.index("READY=1") > lines.index("WATCHDOG=1")
    assert f"STATUS=waiting for a flight controller on udpin://{LOOPBACK}:{ports.api}" in lines
    assert lines.count("WATCHDOG=1") >= 5


def test_what_is_not_known_says_so() -> None:
    fields = computer_status(2_500_000, [12.4, 99.6], (3 * 2**20, 2**33), None)
    assert fields["time_usec"] == 2_500_000
    assert fields["uptime"] == 2_500
    assert fields["cpu_cores"] == [12, 100] + [NOT_KNOWN_8] * 6
    assert (fields["ram_usage"], fields["ram_total"]) == (3, 8192)
    assert fields["temperature_core"] == [NO_TEMPERATURE] * 8
    hot = computer_status(0, [50.0] * 64, (0, 0), 71.6)
    assert hot["cpu_cores"] == [50] * 8
    assert hot["temperature_core"][0] == 72
