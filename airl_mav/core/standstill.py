"""A process that stands still, and surely goes on, also when whoever stopped it is killed.

A stopped process does not see that the pipe from its parent has closed, and would be left behind
for ever: while it stands still, a guard reads a pipe for it.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress


class Standstill:
    """Holds a process from its making to `end`."""

    def __init__(self, pid: int) -> None:
        """Stop a process of ours."""
        self._pid = pid
        os.kill(pid, signal.SIGSTOP)
        self._guard = subprocess.Popen(  # noqa: S603 - a list of arguments, no shell
            [sys.executable, "-m", "airl_mav.core.standstill", str(pid)],
            stdin=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            start_new_session=True,
        )

    def end(self) -> None:
        """Let it go on; harmless when it has ended, or when called again."""
        _go_on(self._pid)
        if self._guard.stdin is not None:
            self._guard.stdin.close()
        self._guard.wait()


def _go_on(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


def main() -> None:
    """Let the process of the command line go on when standard input ends."""
    while os.read(0, 4096):
        pass
    _go_on(int(sys.argv[1]))


if __name__ == "__main__":
    main()
