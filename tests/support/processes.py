"""Real processes under test: started, watched from outside, and surely ended."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib import get_cachedir
from pymavlink.dialects.v20 import common as dialect

from tests.support.ports import LOOPBACK

ROOT = Path(__file__).resolve().parents[2]

OFFBOARD, HOLD, POSITION, LAND = 6 << 16, 3 << 24 | 4 << 16, 3 << 16, 6 << 24 | 4 << 16
"""PX4 custom modes."""

NO_REPORT = """
from airl_mav.cli import sitl_command as sitl
sitl.conclude = lambda *_: 0
"""
"""Before airl-sitl: pictures take longer than flights."""

# Several suites share two cores, at many times real time: the tests do not judge the host.
SITL = ("-m", "airl_mav.cli.sitl_command", "--no-validity")
SITL_WITHOUT_REPORT = (
    "-c",
    f"{NO_REPORT}\nfrom airl_mav.cli import main\nmain.sitl()",
    "--no-validity",
)

PATIENCE_S = 150.0
"""Longest wait for anything [wall s]: after a change of the sources, a first start compiles."""


def wait_until(condition: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S) -> Any:
    """Return the condition's value once it is true; fail after the timeout."""
    deadline = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline, f"timed out waiting for {what}"
        time.sleep(0.01)
    return value


def run_alone(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a program in a new interpreter with every warning as an error."""
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        cwd=folder,
        # matplotlib lists the fonts of this machine once for each place where it may keep the list.
        env={"PYTHONPATH": str(ROOT), "HOME": str(folder), "MPLCONFIGDIR": get_cachedir()},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def has_ended(pid: int) -> bool:
    """Return whether a process is gone, as a condition to wait for."""
    return not is_running(pid)


def state_of(pid: int) -> str:
    """Return a process's state letter, "X" when it is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "X"


def is_running(pid: int) -> bool:
    """Return True if a process still runs; an unreaped dead process does not."""
    return state_of(pid) not in "ZX"


def children_of(pid: int) -> dict[str, int]:
    """Return the children of a process: firmware, companion, or their module's name -> pid."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        # Already ended, or another program (git).
        with suppress(OSError, IndexError, ValueError):
            if int((entry / "stat").read_text().rpartition(")")[2].split()[1]) != pid:
                continue
            words = (entry / "cmdline").read_bytes().split(b"\0")
            module = words[words.index(b"-m") + 1].decode()
            found[module.rpartition(".")[2].removesuffix("_process")] = int(entry.name)
    return found


def allow_interrupt() -> None:
    """Let a child be interrupted: children inherit SIGINT ignored from a background runner."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Running:
    """Python process of the project, with its output."""

    def __init__(self, words: list[str], folder: Path, *, path: Path = ROOT) -> None:
        self.output = folder / f"output-{time.monotonic_ns()}.txt"
        environment = {**os.environ, "PYTHONPATH": str(path), "COLUMNS": "200"}
        with self.output.open("wb") as file:
            self.process = subprocess.Popen(
                [sys.executable, *words],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env=environment,
                preexec_fn=allow_interrupt,
            )
        self.pid = self.process.pid
        self.children: dict[str, int] = {}

    def text(self) -> str:
        """Return what it has printed so far."""
        return self.output.read_text(encoding="utf-8", errors="replace")

    def find_children(self, *names: str) -> dict[str, int]:
        """Wait until it has the children named, and return their pids."""

        def all_there() -> bool:
            assert self.process.poll() is None, self.text()
            self.children = children_of(self.pid)
            return set(names) <= set(self.children)

        wait_until(all_there, f"the processes {names}")
        return self.children

    def wait_for_text(self, pattern: str) -> re.Match[str]:
        """Wait until it has printed something."""

        def found() -> re.Match[str] | None:
            ended = self.process.poll() is not None
            match = re.search(pattern, self.text())
            assert match or not ended, f"ended without {pattern!r}:\n{self.text()}"
            return match

        match: re.Match[str] = wait_until(found, repr(pattern))
        return match

    def wait(self, timeout_s: float = PATIENCE_S) -> int:
        """Wait for its end and return its exit status."""
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {timeout_s:g} s:\n{self.text()}") from None

    def interrupt(self) -> None:
        """Press Ctrl-C."""
        self.process.send_signal(signal.SIGINT)

    def no_child_left(self) -> None:
        """Fail when a child outlives it by more than a moment."""
        for name, pid in self.children.items():
            wait_until(partial(has_ended, pid), f"{name} to end", 30.0)

    def end(self) -> None:
        """Kill what is left: this process and the children seen."""
        for pid in self.children.values():
            if is_running(pid):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        if self.process.poll() is None:
            for pid in children_of(self.pid).values():
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            self.process.kill()
            self.process.wait()


@contextmanager
def running(words: list[str], folder: Path, *, path: Path = ROOT) -> Iterator[Running]:
    """Run `python WORDS` in a folder for a while."""
    process = Running(words, folder, path=path)
    try:
        yield process
    finally:
        process.end()


class Ground:
    """Listener on the ground station's port: the vehicle's messages, seen from outside."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((LOOPBACK, 0))
        self.socket.settimeout(0.1)
        self.port: int = self.socket.getsockname()[1]
        self.latest: dict[str, Any] = {}
        """Newest message by type."""
        self.texts: list[str] = []
        self.track: list[tuple[int, float, float]] = []
        """(time [ms], horizontal speed [m/s], height [m]) at every LOCAL_POSITION_NED."""
        self._mav = dialect.MAVLink(None, 255, 190)
        self._mav.robust_parsing = True
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="ground", daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        while not self._stop.is_set():
            try:
                data = self.socket.recv(4096)
            except TimeoutError:
                continue
            except OSError:
                return
            for message in self._mav.parse_buffer(data) or []:
                self._take(message)

    def _take(self, message: Any) -> None:
        name = message.get_type()
        if name == "HEARTBEAT" and message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
            return  # a companion's, which is forwarded
        self.latest[name] = message
        if name == "STATUSTEXT":
            self.texts.append(message.text)
        elif name == "LOCAL_POSITION_NED":
            speed = (message.vx**2 + message.vy**2) ** 0.5
            self.track.append((message.time_boot_ms, speed, -message.z))

    def send(self, message: Any, port: int) -> None:
        """Send a message to the vehicle."""
        self.socket.sendto(message.pack(self._mav), (LOOPBACK, port))

    @property
    def mode(self) -> int | None:
        """PX4 custom mode."""
        beat = self.latest.get("HEARTBEAT")
        return None if beat is None else int(beat.custom_mode)

    @property
    def armed(self) -> bool:
        """True if the last heartbeat reported armed."""
        beat = self.latest.get("HEARTBEAT")
        return beat is not None and bool(beat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def speed(self) -> float:
        """Horizontal speed [m/s]."""
        return self.track[-1][1] if self.track else 0.0

    @property
    def height(self) -> float:
        """Height above the start [m]."""
        return self.track[-1][2] if self.track else 0.0

    def heard(self, text: str) -> bool:
        """Return True if a message of the autopilot contains a text."""
        return any(text in said for said in list(self.texts))

    def wait_flying(self, speed: float = 1.5, *processes: Running) -> None:
        """Wait until the vehicle flies under offboard control, faster than `speed` [m/s]."""

        def flying() -> bool:
            for process in processes:
                assert process.process.poll() is None, process.text()
            return self.mode == OFFBOARD and self.armed and self.speed > speed

        wait_until(flying, f"an offboard flight at {speed} m/s")

    def wait_down(self) -> None:
        """Wait until the vehicle has come down and is disarmed."""
        wait_until(lambda: self.track and not self.armed, "the vehicle to come down")

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        self._thread.join()
        self.socket.close()


@contextmanager
def ground_station() -> Iterator[Ground]:
    """Listen for a while."""
    ground = Ground()
    try:
        yield ground
    finally:
        ground.close()


def write_arena(folder: Path, goal_north_m: float = 8.0) -> Path:
    """Write the profile of an empty corridor with the goal straight ahead."""
    path = folder / "corridor.toml"
    path.write_text(
        f"""description = "an empty corridor"
zones_m = [750.0]
[size]
north_m = {goal_north_m + 15.0}
east_m = 20.0
height_m = 5.0
[start]
north_m = 3.0
east_m = 10.0
clearance_m = 1.0
[goal]
north_m = {goal_north_m}
east_m = 0.0
clearance_m = 1.0
[static]
count = [0, 0]
""",
        encoding="utf-8",
    )
    return path
