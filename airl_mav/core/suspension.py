"""Suspension of a process, with a guaranteed resume even if the suspending program is killed.

A stopped process cannot notice that the pipe from its parent has closed, and would never exit. A
guard reads a pipe on its behalf during the suspension.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress


class Suspension:
    """Suspension of a process, from construction to `end`."""

    def __init__(self, pid: int) -> None:
        """Suspend a child process (SIGSTOP)."""
        self._pid = pid
        os.kill(pid, signal.SIGSTOP)
        self._guard = subprocess.Popen(  # noqa: S603 - a list of arguments, no shell
            [sys.executable, "-m", "airl_mav.core.suspension", str(pid)],
            stdin=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            start_new_session=True,
        )

    def end(self) -> None:
        """Resume the process; no effect if it has ended or is already resumed."""
        _resume(self._pid)
        if self._guard.stdin is not None:
            self._guard.stdin.close()
        self._guard.wait()


def _resume(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


def main() -> None:
    """Resume the process of the command line when standard input ends."""
    while os.read(0, 4096):
        pass
    _resume(int(sys.argv[1]))


if __name__ == "__main__":
    main()
