"""Child processes: started with a log, watched, and surely ended, also when their parent is killed.

A child's standard input is a pipe that its parent holds. When it closes, because the parent ended
the child or died itself, the child has to end. Our own programs read that pipe. Any other program
runs behind a parent-death guard, which reads it for them:
`python -m airl_mav.core.child_process PROGRAM ARGUMENT...`.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from airl_mav.core.suspension import Suspension

GRACE_S = 5.0
"""How long a child may take to end once its pipe is closed, and again once terminated [wall s]."""

GUARDED_GRACE_S = 2.0
"""How long a guarded program may take to end when terminated, less than its guard [wall s]."""

SIGNALLED = 128
"""A guard's exit status is this and the signal's number when a signal killed its program."""

TAIL_LINES = 12
"""Lines of a dead child's log that are shown."""


@dataclass(frozen=True)
class Exited:
    """A child has ended."""

    code: int
    """Exit status; negative = the signal that killed it."""

    @property
    def by_signal(self) -> bool:
        """Whether a signal killed it, or the program behind its guard."""
        return self.code < 0 or SIGNALLED < self.code < SIGNALLED + signal.NSIG

    def __str__(self) -> str:
        """Return the name of the signal, as SIGKILL, or the exit status, as exit status 1."""
        if self.code < 0:
            with suppress(ValueError):
                return signal.Signals(-self.code).name
        return f"exit status {self.code}"


class ChildProcess:
    """One child process in a session of its own.

    Ctrl-C at the terminal reaches the parent alone, which then ends its children in order.
    """

    def __init__(
        self,
        argv: Sequence[str],
        log: Path,
        *,
        guarded: bool = False,
        capture_stdout: bool = False,
        cwd: Path | None = None,
        environment: Mapping[str, str] | None = None,
        inherited: Sequence[int] = (),
    ) -> None:
        """Start a program.

        What it prints is appended to `log`. With `capture_stdout` only its standard error is, and
        the parent reads its standard output (`stdout`). It needs the parent-death guard (`guarded`)
        unless it reads its pipe itself. `environment` is added to our own. File descriptors in
        `inherited` are locks that it never uses.
        """
        guard = [sys.executable, "-m", "airl_mav.core.child_process"] if guarded else []
        path = {"PYTHONPATH": os.pathsep.join(sys.path)} if guarded else {}
        self.log = log
        with log.open("ab") as file:
            self._log_start = file.tell()
            self._process = subprocess.Popen(  # noqa: S603 - a list of arguments, no shell
                [*guard, *argv],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE if capture_stdout else file,
                stderr=file,
                cwd=cwd,
                env={**os.environ, **path, **(environment or {})},
                start_new_session=True,
                pass_fds=inherited,
            )
        self._suspension: Suspension | None = None
        self.stdin = self._process.stdin
        """The pipe that it reads; None never."""
        self.stdout = self._process.stdout
        """The pipe that it writes to; None where that is not captured."""

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def poll(self) -> Exited | None:
        """Return how it ended; None while it runs."""
        code = self._process.poll()
        return None if code is None else Exited(code)

    def wait(self) -> Exited:
        """Return how it ended, once it has."""
        return Exited(self._process.wait())

    def log_tail(self) -> str:
        """Return the last lines that it wrote to its log."""
        try:
            written = self.log.read_bytes()[self._log_start :]
        except OSError:
            return ""
        return "\n".join(written.decode(errors="replace").splitlines()[-TAIL_LINES:])

    def suspend(self) -> None:
        """Suspend it (SIGSTOP) until `resume`; it is also resumed when we are killed."""
        if self._suspension is None and self._process.poll() is None:
            self._suspension = Suspension(self._process.pid)

    def resume(self) -> None:
        """Resume it, if it is suspended (SIGCONT)."""
        suspension, self._suspension = self._suspension, None
        if suspension is not None:
            suspension.end()

    def stop(self) -> None:
        """Close its pipe, wait, terminate, kill; return when it is gone. Harmless if repeated."""
        self.resume()
        if self.stdin is not None:
            with suppress(BrokenPipeError):
                self.stdin.close()
        for insist in (None, self._process.terminate, self._process.kill):
            if insist is not None:
                insist()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(GRACE_S)
                return

    def kill(self) -> None:
        """End it at once; does not wait."""
        self._process.kill()
        self.resume()


# --- the parent-death guard


def main() -> None:
    """Run the command line's program until it or standard input ends; exit with its status."""
    # A session of its own: signals meant for the parent pass it by, and it can be ended with all
    # that it has started.
    program = subprocess.Popen(  # noqa: S603 - a list of arguments, no shell
        sys.argv[1:], stdin=subprocess.DEVNULL, start_new_session=True
    )
    signal.signal(signal.SIGTERM, lambda number, _: _signal_group(program.pid, number))
    threading.Thread(target=_end_with_stdin, args=(program,), daemon=True).start()
    code = program.wait()
    _signal_group(program.pid, signal.SIGKILL)
    sys.exit(code if code >= 0 else SIGNALLED - code)


def _end_with_stdin(program: subprocess.Popen[bytes]) -> None:
    while os.read(0, 4096):
        pass
    _signal_group(program.pid, signal.SIGTERM)
    try:
        program.wait(GUARDED_GRACE_S)
    except subprocess.TimeoutExpired:
        _signal_group(program.pid, signal.SIGKILL)


def _signal_group(group: int, number: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(group, number)


if __name__ == "__main__":
    main()
