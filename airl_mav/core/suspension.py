"""A process that is suspended, and surely resumed, also when whoever suspended it is killed.

A stopped process does not see that the pipe from its parent has closed, and would be left behind
for ever. While it is suspended, a guard reads a pipe for it.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress


class Suspension:
    """Holds a process from its making to `end`."""

    def __init__(self, pid: int) -> None:
        """Suspend a process of ours (SIGSTOP)."""
        self._pid = pid
        os.kill(pid, signal.SIGSTOP)
        self._guard = subprocess.Popen(  # noqa: S603 - a list of arguments, no shell
            [sys.executable, "-m", "airl_mav.core.suspension", str(pid)],
            stdin=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            start_new_session=True,
        )

    def end(self) -> None:
        """Resume it; harmless when it has ended, or when called again."""
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
