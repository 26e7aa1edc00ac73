"""Firmware and companion as one: started, listened to and ended together."""

from __future__ import annotations

import queue
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from airl_mav.core.child_process import Exited
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.rehearsal.channel import Begin, Event, Failed, Ready
from airl_mav.rehearsal.process import Child

FIRMWARE, COMPANION = "firmware", "companion"

MODULES = {
    FIRMWARE: "airl_mav.rehearsal.firmware_process",
    COMPANION: "airl_mav.rehearsal.companion_process",
}
"""What each process runs."""

READY_TIMEOUT_S = 180.0
"""The first start after an install compiles the kernels [wall s]."""

REPLY_TIMEOUT_S = 30.0
"""Longest wait for an answer of a healthy process [wall s]."""

LOOK_S = 0.2
"""Waits are cut this short, so that Ctrl-C is seen at once on every platform [wall s]."""


class LostError(Exception):
    """A process died or hangs, or they lost each other: the flight is no test of anything.

    The message says all that is known; `what` is one line for the records.
    """

    def __init__(self, what: str, detail: str = "") -> None:
        super().__init__(what + detail)
        self.what, self.detail = what, detail


class ProcessPair:
    """Two processes that fly together; after a loss a new pair takes over."""

    def __init__(self) -> None:
        self._events: queue.Queue[tuple[str, Event | Exited]] = queue.Queue()
        self._children: dict[str, Child] = {}

    def start(self, begin: Begin, logs: Path, keeps: Sequence[int]) -> None:
        """Start both processes and wait until they are ready.

        Args:
            begin: What both are told first.
            logs: Folder that their standard error goes to.
            keeps: File descriptors that they inherit: locks.

        Raises:
            UsageError: A process says that its input cannot be used.
            LostError: A process died or did not become ready in time.
        """
        for name, module in MODULES.items():
            log = logs / f"{name}.log"
            self._children[name] = child = Child(name, module, [], log, self._events, keeps=keeps)
            child.send(begin)
        ready: set[str] = set()

        def note(name: str, event: Event) -> bool:
            if isinstance(event, Ready):
                ready.add(name)
            return len(ready) == len(self._children)

        self.pump(note, READY_TIMEOUT_S, "both processes to be ready")

    def stop(self) -> None:
        """End both processes; returns when they are gone."""
        try:
            # The companion first: what it commands last is part of the flight.
            for name in (COMPANION, FIRMWARE):
                self.stop_one(name)
        except BaseException:
            # A second Ctrl-C: no more patience, but nobody is left behind.
            for child in self._children.values():
                child.kill()
            raise

    def stop_one(self, name: str) -> None:
        """End one process, if it was started; returns when it is gone."""
        if name in self._children:
            self._children[name].stop()

    def lives(self, name: str) -> bool:
        """Return whether a process is there and meant to be."""
        return not self._children[name].ending

    def send(self, name: str, request: BaseModel) -> None:
        """Send a request; a dead process's end is found by who waits for the answer."""
        self._children[name].send(request)

    def wait_for(
        self, kind: type[Any], look: Callable[[Event], None], timeout_s: float | None = None
    ) -> Any:
        """Return the next event of a kind; `look` sees those before it. Raises as `pump`."""
        found: list[Any] = []

        def take(_name: str, event: Event) -> bool:
            if isinstance(event, kind):
                found.append(event)
            else:
                look(event)
            return bool(found)

        limit_s = REPLY_TIMEOUT_S if timeout_s is None else timeout_s
        self.pump(take, limit_s, f"the event {kind.__name__!r}")
        return found[0]

    def pump(self, take: Callable[[str, Event], bool], timeout_s: float, what: str) -> None:
        """Feed events to `take` until it returns True.

        Args:
            take: Gets the name of a process and what it says.
            timeout_s: Longest wait [wall s].
            what: What is waited for, in words.

        Raises:
            UsageError: A process says that its input cannot be used.
            LostError: A process died or failed, or the time is over.
        """
        deadline = WallClock()
        while True:
            left_s = timeout_s - deadline.time_us() / US_PER_S
            if left_s <= 0.0:
                raise LostError(f"gave up waiting for {what} after {timeout_s:.0f} s")
            try:
                name, event = self._events.get(timeout=min(left_s, LOOK_S))
            except queue.Empty:
                continue
            if isinstance(event, Exited):
                self._died(name, event)
            elif isinstance(event, Failed):
                self._failed(name, event)
            elif take(name, event):
                return

    def _failed(self, name: str, event: Failed) -> None:
        self._children[name].ending = True
        if event.usage:
            raise UsageError(event.message)
        raise LostError(f"the {name} gave up: {event.message}")

    def _died(self, name: str, exited: Exited) -> None:
        child = self._children[name]
        if child.ending:
            return
        child.ending = True
        tail = child.log_tail()
        raise LostError(
            f"the {name} died ({exited})", f"; log: {child.log}" + (f"\n{tail}" if tail else "")
        )
