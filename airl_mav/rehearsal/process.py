"""A child process behind a control channel: JSON lines in, events out."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel, ValidationError

from airl_mav.core.child_process import GRACE_S, ChildProcess, Exited
from airl_mav.rehearsal.channel import Event, parse_event


class Child(ChildProcess):
    """One of our programs; its events and its end arrive in a shared queue."""

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
            keeps: File descriptors that it inherits and never uses: locks.
        """
        super().__init__(
            [sys.executable, "-m", module, *arguments], log, capture_stdout=True, inherited=keeps
        )
        self.name = name
        self.ending = False
        """Its end is wanted: no surprise when it comes."""
        self._events = events
        self._reader = threading.Thread(target=self._read, name=f"{name}-events", daemon=True)
        self._reader.start()

    def send(self, request: BaseModel) -> None:
        """Send a request; a dead child's end is reported through the queue."""
        if self.stdin is not None:
            with suppress(BrokenPipeError, ValueError):
                self.stdin.write(request.model_dump_json().encode() + b"\n")
                self.stdin.flush()

    def stop(self) -> None:
        """End it; see `ChildProcess.stop`. All its events are in the queue then."""
        self.ending = True
        super().stop()
        self._reader.join(GRACE_S)

    def kill(self) -> None:
        """End it at once; does not wait."""
        self.ending = True
        super().kill()

    def _read(self) -> None:
        if self.stdout is not None:
            for line in self.stdout:
                with suppress(ValidationError):  # a line that is not ours: nothing to act on
                    self._events.put((self.name, parse_event(line)))
            self.stdout.close()
        self._events.put((self.name, self.wait()))
