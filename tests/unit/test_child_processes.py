"""Child processes of a rehearsal: they report any input other than a scenario, and exit."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from airl_mav.core.child_process import ChildProcess
from airl_mav.core.errors import EXIT_BROKEN, EXIT_USAGE
from airl_mav.rehearsal.channel import Begin, Failed, parse_event
from airl_mav.rehearsal.process_pair import MODULES
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from tests.support.processes import ROOT, wait_until


def told(module: str, first: bytes, folder: Path) -> subprocess.CompletedProcess[bytes]:
    """Start a process, say one thing to it, and close the pipe."""
    return subprocess.run(
        [sys.executable, "-m", module],
        input=first,
        cwd=folder,
        env={"PYTHONPATH": str(ROOT), "HOME": str(folder)},
        capture_output=True,
        timeout=120,
        check=False,
    )


def of_another_version() -> bytes:
    line: dict[str, Any] = json.loads(Begin(scenario=resolve(Scenario())).to_line())
    line["scenario"]["scenario"]["colour"] = "blue"
    return json.dumps(line).encode() + b"\n"


@pytest.mark.parametrize("module", MODULES.values(), ids=MODULES)
@pytest.mark.parametrize(
    ("first", "named"),
    [
        (b"\x00\xff garbage \xfe\n", "not a scenario"),
        # Refused by the same lines.
        pytest.param(b'{"type":"begin"}\n', "scenario", marks=pytest.mark.nightly),
        pytest.param(b'{"type":"shutdown"}\n', "not a scenario", marks=pytest.mark.nightly),
        pytest.param(b'{"type":"begin","scenario":', "not a scenario", marks=pytest.mark.nightly),
        (of_another_version(), "colour"),
    ],
    ids=["garbage", "nothing in it", "a request", "cut short", "another version"],
)
def test_something_else_is_refused_in_one_line(
    module: str, first: bytes, named: str, tmp_path: Path
) -> None:
    done = told(module, first, tmp_path)
    assert done.returncode == EXIT_USAGE
    (line,) = done.stdout.splitlines()
    event = parse_event(line)
    assert isinstance(event, Failed)
    assert event.usage
    assert named in event.message
    assert len(event.message.splitlines()) == 1
    assert done.stderr == b""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("module", MODULES.values(), ids=MODULES)
def test_a_pipe_that_ends_at_once_ends_the_process(module: str, tmp_path: Path) -> None:
    done = told(module, b"", tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (EXIT_BROKEN, b"", b"")


SLEEPS = "import time; time.sleep(60)"
STOPS_IT_AND_IS_KILLED = f"""
import os, signal, sys
from pathlib import Path
from airl_mav.core.child_process import ChildProcess
child = ChildProcess([sys.executable, "-c", {SLEEPS!r}], Path(sys.argv[1]))
child.suspend()
print(child.pid, flush=True)
sys.stdin.readline()
"""


def state_of(pid: int) -> str:
    """Return the kernel's letter for the state of a process; T = stopped."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def test_a_suspended_child_waits_until_it_is_resumed(tmp_path: Path) -> None:
    child = ChildProcess([sys.executable, "-c", SLEEPS], tmp_path / "log")
    assert stat.S_IMODE((tmp_path / "log").stat().st_mode) == 0o600
    try:
        child.suspend()
        wait_until(lambda: state_of(child.pid) == "T", "stopped")
        child.resume()
        wait_until(lambda: state_of(child.pid) != "T", "going on")
        child.resume()  # Harmless.
        child.suspend()
        child.kill()
        assert child.wait().code == -signal.SIGKILL
    finally:
        child.stop()


def test_a_child_goes_on_when_who_stopped_it_is_killed(tmp_path: Path) -> None:
    words = [sys.executable, "-c", STOPS_IT_AND_IS_KILLED, str(tmp_path / "log")]
    with subprocess.Popen(
        words,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        try:
            wait_until(lambda: state_of(pid) == "T", "stopped")
            parent.kill()
            wait_until(lambda: state_of(pid) != "T", "going on")
        finally:
            os.kill(pid, signal.SIGKILL)
