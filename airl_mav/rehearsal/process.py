"""A supervised child process: started, talked to, and surely ended."""

from __future__ import annotations

import contextlib
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ValidationError

from airl_mav.rehearsal.channel import Event, parse_event

GRACE_S = 5.0
"""How long a child may take to end by itself once its pipe is closed [wall s]."""

TAIL_LINES = 12
"""Lines of a dead child's log that are shown."""


@dataclass(frozen=True)
class Exited:
    """A child has ended."""

    code: int
    """Exit status; negative = the signal that killed it."""

    def __str__(self) -> str:
        """Return it in words: SIGKILL, or exit status 1."""
        if self.code < 0:
            with contextlib.suppress(ValueError):
                return signal.Signals(-self.code).name
        return f"exit status {self.code}"


class Child:
    """One process behind a control channel; its events and its end arrive in a shared queue."""

    def __init__(
        self,
        name: str,
        module: str,
        arguments: list[str],
        log: Path,
        events: queue.Queue[tuple[str, Event | Exited]],
        *,
        keeps: Sequence[int] = (),
    ) -> None:
        """Start `python -m module arguments`.

        Args:
            name: What it is called in messages and in the queue.
            module: Python module with a `__main__` guard.
            arguments: Its arguments.
            log: Its standard error goes here.
            events: Gets (name, event); after the last one (name, Exited).
            keeps: File descriptors that it inherits and never looks at: locks.
        """
        self.name = name
        self.log = log
        self.ending = False
        """Its end is wanted: no surprise when it comes."""
        self._events = events
        with log.open("ab") as file:
            self._log_start = file.tell()
            # A session of its own: Ctrl-C at the terminal reaches the harness alone, which then
            # ends the children in order. A fixed argument list, no shell.
            self._process = subprocess.Popen(  # noqa: S603
                [sys.executable, "-m", module, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                start_new_session=True,
                pass_fds=keeps,
            )
        self._reader = threading.Thread(target=self._read, name=f"{name}-events", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def send(self, request: BaseModel) -> None:
        """Send a request; a dead child's end is reported through the queue."""
        pipe = self._process.stdin
        if pipe is None:
            return
        try:
            pipe.write(request.model_dump_json().encode() + b"\n")
            pipe.flush()
        except (BrokenPipeError, ValueError):
            return

    def stop(self) -> None:
        """Close its pipe, wait, then terminate, then kill. Returns when it is gone."""
        self.ending = True
        process = self._process
        if process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
        for insist in (None, process.terminate, process.kill):
            if insist is not None:
                insist()
            try:
                process.wait(GRACE_S)
                break
            except subprocess.TimeoutExpired:
                continue
        self._reader.join(GRACE_S)

    def kill(self) -> None:
        """End it at once; does not wait."""
        self.ending = True
        self._process.kill()

    def log_tail(self) -> str:
        """Return the last lines that it wrote to its log."""
        try:
            written = self.log.read_bytes()[self._log_start :]
        except OSError:
            return ""
        lines = written.decode(errors="replace").splitlines()
        return "\n".join(lines[-TAIL_LINES:])

    def _read(self) -> None:
        pipe = self._process.stdout
        if pipe is not None:
            for line in pipe:
                try:
                    self._events.put((self.name, parse_event(line)))
                except ValidationError:
                    continue  # a line that is not ours: nothing to act on
            pipe.close()
        self._events.put((self.name, Exited(self._process.wait())))
