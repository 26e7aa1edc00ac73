"""Child processes with a log, supervision, suspension, and an end with their parent.

A child's standard input is a pipe held by its parent. The child must exit when the pipe closes,
because the parent stopped the child or ended unexpectedly. Programs of this package read the pipe.
All other programs run behind a parent-death guard, which reads the pipe for them: `python -m
airl_mav.core.child_process PROGRAM ARGUMENT...`.
"""

from __future__ import annotations

import importlib
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

GRACE_S = 5.0
"""Timeout for a child to exit after its pipe is closed, and again after SIGTERM [wall s]."""

GUARDED_GRACE_S = 2.0
"""Timeout for a guarded program to exit after SIGTERM, shorter than its guard's [wall s]."""

SIGNALLED = 128
"""Offset of a guard's exit status: added to the signal's number if a signal killed its program."""

TAIL_LINES = 12
"""Number of log lines shown after a child has ended."""


@dataclass(frozen=True)
class Exited:
    """Exit of a child."""

    code: int
    """Exit status; negative = the signal that killed the child."""

    @property
    def by_signal(self) -> bool:
        """True if a signal killed the child, or the program behind its guard."""
        return self.code < 0 or SIGNALLED < self.code < SIGNALLED + signal.NSIG

    def __str__(self) -> str:
        """Return the name of the signal, such as SIGKILL, or the text "exit status 1"."""
        if self.code < 0:
            with suppress(ValueError):
                return signal.Signals(-self.code).name
        return f"exit status {self.code}"


RESUME = "--resume"
"""First argument of the guard of a suspended process."""


class Suspension:
    """Suspension of a process, from construction to `end`.

    A stopped process cannot notice that the pipe from its parent has closed, and would never exit.
    A guard reads a pipe on its behalf, and resumes it if this program is killed.
    """

    def __init__(self, pid: int) -> None:
        """Suspend a child process (SIGSTOP)."""
        self._pid = pid
        os.kill(pid, signal.SIGSTOP)
        self._guard = subprocess.Popen(  # noqa: S603 - a list of arguments, no shell
            [sys.executable, "-m", "airl_mav.core.child_process", RESUME, str(pid)],
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


class ChildProcess:
    """One child process in a new session.

    Ctrl-C at the terminal reaches only the parent, which then ends its children in order.
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

        Its output is appended to `log`. With `capture_stdout`, only standard error is logged and
        the parent reads standard output (`stdout`). Programs that do not read their pipe need the
        parent-death guard (`guarded`). `environment` extends the parent's environment. The program
        inherits the file descriptors in `inherited` as locks.
        """
        guard = [sys.executable, "-m", "airl_mav.core.child_process"] if guarded else []
        path = {"PYTHONPATH": os.pathsep.join(sys.path)} if guarded else {}
        self.log = log
        # Imported here: guards need none of it.
        from airl_mav.core.files import open_to_append

        with open_to_append(log, 0o600) as file:
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
        """Pipe to the child's standard input; never None."""
        self.stdout = self._process.stdout
        """Pipe from the child's standard output; None = not captured."""

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def poll(self) -> Exited | None:
        """Return the exit; None while the child runs."""
        code = self._process.poll()
        return None if code is None else Exited(code)

    def wait(self) -> Exited:
        """Wait for the exit and return it."""
        return Exited(self._process.wait())

    def log_tail(self) -> str:
        """Return the last lines of the child's log."""
        try:
            written = self.log.read_bytes()[self._log_start :]
        except OSError:
            return ""
        return "\n".join(written.decode(errors="replace").splitlines()[-TAIL_LINES:])

    def suspend(self) -> None:
        """Suspend the child (SIGSTOP) until `resume`; it also resumes if the parent is killed."""
        if self._suspension is None and self._process.poll() is None:
            self._suspension = Suspension(self._process.pid)

    def resume(self) -> None:
        """Resume the child if it is suspended (SIGCONT)."""
        suspension, self._suspension = self._suspension, None
        if suspension is not None:
            suspension.end()

    def stop(self) -> None:
        """Close the pipe, wait, terminate, kill; return after the exit. May be repeated."""
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
        """Kill the child without waiting."""
        self._process.kill()
        self.resume()


# --- functions with limits

LIMITED = "--limited"
"""First argument of a process that runs a function with limits."""


def run_limited(function: str, data: bytes, memory_bytes: int, timeout_s: float) -> str:
    """Run a function MODULE:NAME of bytes in a child with limits; return its result, a string.

    Use it for foreign data that may take all memory, never end, or crash the process. The child
    cannot write files. `memory_bytes` limits its address space, `timeout_s` its wall time.

    Raises:
        ValueError: The child exceeded a limit or crashed.
    """
    process = subprocess.Popen(  # noqa: S603 - a list of arguments, no shell
        [sys.executable, "-m", __name__, LIMITED, function, f"{memory_bytes}", f"{timeout_s}"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=os.sep,  # -m imports from the current folder, which may be foreign.
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path)),
            "PYTHONDONTWRITEBYTECODE": "1",
            "OPENBLAS_NUM_THREADS": "1",  # Each thread reserves memory.
        },
    )
    with process:
        try:
            result = process.communicate(data, timeout_s)[0]
        except subprocess.TimeoutExpired:
            raise ValueError(f"takes more than {timeout_s:g} s") from None
        finally:
            process.kill()
    if process.returncode:
        raise ValueError(
            f"ended by {Exited(process.returncode)} with {memory_bytes / 2**20:,.0f} MiB of memory"
        )
    return result.decode(errors="replace")


def _run_limited(function: str, memory_bytes: int, timeout_s: float) -> None:
    """Run the function of `run_limited` in this process, and write its result."""
    for kind, most in (
        (resource.RLIMIT_AS, memory_bytes),
        (resource.RLIMIT_CPU, int(timeout_s) + 5),  # If the parent is killed meanwhile.
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        resource.setrlimit(kind, (most, most))
    module, _, name = function.partition(":")
    result = getattr(importlib.import_module(module), name)(sys.stdin.buffer.read())
    sys.stdout.write(result)


# --- the parent-death guard


def main() -> None:
    """Run the command line's program until it or standard input ends; exit with its status.

    With `RESUME` and a process id, resume that process when standard input ends. For `LIMITED` see
    `run_limited`.
    """
    if sys.argv[1] == LIMITED:
        _run_limited(sys.argv[2], int(sys.argv[3]), float(sys.argv[4]))
        return
    if sys.argv[1] == RESUME:
        _read_to_end()
        _resume(int(sys.argv[2]))
        return
    # A new session: signals to the parent do not reach the program, and it can be ended together
    # with all of its children.
    program = subprocess.Popen(  # noqa: S603 - a list of arguments, no shell
        sys.argv[1:], stdin=subprocess.DEVNULL, start_new_session=True
    )
    signal.signal(signal.SIGTERM, lambda number, _: _signal_group(program.pid, number))
    threading.Thread(target=_end_with_stdin, args=(program,), daemon=True).start()
    code = program.wait()
    _signal_group(program.pid, signal.SIGKILL)
    sys.exit(code if code >= 0 else SIGNALLED - code)


def _end_with_stdin(program: subprocess.Popen[bytes]) -> None:
    _read_to_end()
    _signal_group(program.pid, signal.SIGTERM)
    try:
        program.wait(GUARDED_GRACE_S)
    except subprocess.TimeoutExpired:
        _signal_group(program.pid, signal.SIGKILL)


def _read_to_end() -> None:
    while os.read(0, 4096):
        pass


def _signal_group(group: int, number: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(group, number)


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True after Ctrl-C or SIGTERM; a second one interrupts at once.

    This allows the caller to save finished work first. Outside the main thread, where Python
    delivers no signals, the function always returns False.
    """
    seen: list[int] = []

    def note(number: int, _frame: object) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(number)

    with signal_handlers(note, signal.SIGINT, signal.SIGTERM):
        yield lambda: bool(seen)


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Treat SIGTERM as Ctrl-C in this context; does nothing outside the main thread."""

    def interrupt(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    with signal_handlers(interrupt, signal.SIGTERM):
        yield


@contextmanager
def signal_handlers(handler: Callable[[int, object], None], *numbers: int) -> Iterator[None]:
    """Handle signals in this context; does nothing outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


if __name__ == "__main__":
    main()
