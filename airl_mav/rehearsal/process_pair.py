"""Firmware and companion processes: start, events, faults and end."""

from __future__ import annotations

import os
import queue
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from airl_mav.core import child_process, clock, constants, errors, files, machine
from airl_mav.faults import Fault
from airl_mav.rehearsal.channel import Begin, Compiling, Due, Event, Failed, Ready, parse_event

FIRMWARE, COMPANION = "firmware", "companion"

MODULES = {
    FIRMWARE: "airl_mav.rehearsal.firmware_process",
    COMPANION: "airl_mav.rehearsal.companion_process",
}
"""Python module of each process."""

READY_TIMEOUT_S = 180.0
"""Maximum time until both are ready, without kernel compilation, on an idle host [wall s]."""

REPLY_TIMEOUT_S = 30.0
"""Reply timeout of a healthy process [wall s]."""

LOOK_S = 0.2
"""Maximum length of one wait, so that Ctrl-C acts at once on every platform [wall s]."""


class LostError(Exception):
    """A process died, hangs or lost contact; `what` is one line for the records."""

    def __init__(self, what: str, detail: str = "") -> None:
        super().__init__(what + detail)
        self.what, self.detail = what, detail


class Child(child_process.ChildProcess):
    """One process of the pair; its events and its end arrive in a shared queue."""

    def __init__(
        self,
        name: str,
        module: str,
        log: Path,
        events: queue.Queue[tuple[str, Event | child_process.Exited]],
        *,
        keeps: Sequence[int] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Start `python -m module`; `events` gets (name, event), and finally (name, Exited)."""
        super().__init__(
            [sys.executable, "-m", module],
            log,
            capture_stdout=True,
            inherited=keeps,
            environment=environment,
        )
        self.name = name
        self.ending = False
        """True once its end is expected."""
        self._events = events
        self._reader = threading.Thread(target=self._read, name=f"{name}-events", daemon=True)
        self._reader.start()

    def send(self, request: BaseModel) -> None:
        """Send a request; the queue reports the end of a dead child."""
        if self.stdin is not None:
            with suppress(BrokenPipeError, ValueError):
                self.stdin.write(request.model_dump_json().encode() + b"\n")
                self.stdin.flush()

    def stop(self) -> None:
        """End the process; see `ChildProcess.stop`. All its events are then in the queue."""
        self.ending = True
        super().stop()
        self._reader.join(child_process.GRACE_S)

    def kill(self) -> None:
        """End the process at once, without waiting."""
        self.ending = True
        super().kill()

    def _read(self) -> None:
        if self.stdout is not None:
            for line in self.stdout:
                with suppress(ValidationError):  # Not an event line.
                    self._events.put((self.name, parse_event(line)))
            self.stdout.close()
        self._events.put((self.name, self.wait()))


class ProcessPair:
    """Two processes that fly together; after a loss a new pair replaces them."""

    def __init__(self) -> None:
        self._events: queue.Queue[tuple[str, Event | child_process.Exited]] = queue.Queue()
        self._children: dict[str, Child] = {}
        self._scratch = ExitStack()
        """Folder of the companion's temporary files. MAVSDK creates one folder per system, and
        leaves it behind when its process is killed."""
        self._clock = clock.WallClock()
        self._suspended: dict[str, tuple[int, int | None]] = {}
        """Start and end of the suspension by process [wall µs]; end None: until `resume`."""
        self._suspended_us: dict[str, int] = {}
        """Duration of earlier suspensions by process [wall µs]."""

    def start(
        self, begin: Begin, logs: Path, keeps: Sequence[int], compiling: Callable[[], None]
    ) -> None:
        """Start both processes and wait until they are ready. Raises UsageError or LostError."""
        scratch = self._scratch.enter_context(files.scratch_folder("airl-companion-"))
        places = {COMPANION: {"TMPDIR": f"{scratch}"}}
        for name, module in MODULES.items():
            log, place = logs / f"{name}.log", places.get(name)
            self._children[name] = child = Child(
                name, module, log, self._events, keeps=keeps, environment=place
            )
            child.send(begin)
        ready, compiles = set[str](), set[str]()

        def note(name: str, event: Event) -> bool:
            if isinstance(event, Ready):
                ready.add(name)
            elif isinstance(event, Compiling):
                (compiles.add if event.begins else compiles.discard)(name)
                if event.begins:
                    compiling()
            return len(ready) == len(self._children)

        busy = max(1.0, os.getloadavg()[0] / machine.usable_cores())
        limit_s = READY_TIMEOUT_S * busy
        self.pump(note, limit_s, "both processes to be ready", lambda: bool(compiles))

    def stop(self) -> None:
        """End both processes and wait for their exit."""
        try:
            # Companion first: its last commands are part of the flight.
            for name in (COMPANION, FIRMWARE):
                self.stop_one(name)
        except BaseException:
            # A second Ctrl-C: kill all children without waiting.
            for child in self._children.values():
                child.kill()
            raise
        finally:
            self._scratch.close()

    def stop_one(self, name: str) -> None:
        """End one process, if it was started, and wait for its exit."""
        if name in self._children:
            self._children[name].stop()

    def lives(self, name: str) -> bool:
        """Return True if the process is expected to run."""
        return not self._children[name].ending

    def suspend(self, name: str, for_s: float | None = None) -> None:
        """Suspend a process, like a hanging computer, for some wall time [s] or until `resume`."""
        now_us = self._clock.time_us()
        until_us = None if for_s is None else now_us + round(for_s * constants.US_PER_S)
        self._children[name].suspend()
        self._suspended[name] = now_us, until_us

    def resume(self, name: str) -> None:
        """Resume a process if it is suspended."""
        if name in self._suspended:
            suspended_us = self.suspended_us(name)
            del self._suspended[name]
            self._suspended_us[name] = suspended_us
            self._children[name].resume()

    def suspended_us(self, name: str) -> int:
        """Return the total suspension time of a process [wall µs]."""
        before_us = self._suspended_us.get(name, 0)
        if name not in self._suspended:
            return before_us
        return before_us + self._clock.time_us() - self._suspended[name][0]

    def kill(self, name: str) -> None:
        """Kill a process (SIGKILL) on purpose: its end does not count as a loss."""
        self._suspended.pop(name, None)
        self._children[name].kill()

    def send(self, name: str, request: BaseModel) -> None:
        """Send a request; the wait for the answer reports the end of a dead process."""
        self._children[name].send(request)

    def wait_for(
        self, kind: type[Any], look: Callable[[Event], None], timeout_s: float | None = None
    ) -> Any:
        """Return the next event of a kind; `look` gets the events before it. Raises as `pump`."""
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

    def pump(
        self,
        take: Callable[[str, Event], bool],
        timeout_s: float,
        what: str,
        paused: Callable[[], bool] = lambda: False,
    ) -> None:
        """Feed events, with their process name, to `take` until it returns True.

        Time does not count while `paused`. Raises UsageError if a process reports one, and
        LostError if a process died or failed, or after the timeout [wall s]; `what` describes the
        expected event.
        """
        since = clock.WallClock()
        paused_us = before_us = 0
        while True:
            now_us = since.time_us()
            paused_us += now_us - before_us if paused() else 0
            before_us = now_us
            left_s = timeout_s - (now_us - paused_us) / constants.US_PER_S
            if left_s <= 0.0:
                raise LostError(f"gave up waiting for {what} after {timeout_s:.0f} s")
            try:
                name, event = self._events.get(timeout=min(left_s, self._look_s()))
            except queue.Empty:
                continue
            if isinstance(event, child_process.Exited):
                self._died(name, event)
            elif isinstance(event, Failed):
                self._failed(name, event)
            elif take(name, event):
                return

    def _look_s(self) -> float:
        """Resume processes whose suspension is over; return the time to the next check [wall s]."""
        now_us, look_us = self._clock.time_us(), round(LOOK_S * constants.US_PER_S)
        for name, (_, until_us) in list(self._suspended.items()):
            if until_us is None:
                continue
            if until_us <= now_us:
                self.resume(name)
            else:
                look_us = min(look_us, until_us - now_us)
        return look_us / constants.US_PER_S

    def _failed(self, name: str, event: Failed) -> None:
        self._children[name].ending = True
        if event.usage:
            raise errors.UsageError(event.message)
        if event.errno is not None:
            raise OSError(event.errno, os.strerror(event.errno), event.message or None)
        raise LostError(f"the {name} gave up: {event.message}")

    def _died(self, name: str, exited: child_process.Exited) -> None:
        child = self._children[name]
        if child.ending:
            return
        child.ending = True
        tail = child.log_tail()
        raise LostError(
            f"the {name} died ({exited})", f"; log: {child.log}" + (f"\n{tail}" if tail else "")
        )


KILLED = "killed"


class ProcessFaults:
    """Executes process faults that are due."""

    def __init__(self, pair: ProcessPair, speed: float) -> None:
        """Take the processes, and simulated seconds per wall second."""
        self._pair = pair
        self._speed = speed
        self._suspended_before_us = pair.suspended_us(FIRMWARE)
        self._out: dict[str, str] = {}

    def out(self, name: str) -> str | None:
        """Return the fault kind that ended a process for this episode, as "killed", or None."""
        return self._out.get(name)

    @property
    def reason(self) -> str | None:
        """Return the reason why a lost process ends the flight; None: both fly."""
        return "; ".join(f"{name} {kind}" for name, kind in self._out.items()) or None

    @property
    def paused_us(self) -> int:
        """Return the time that the firmware was suspended by faults [simulated µs]."""
        return round((self._pair.suspended_us(FIRMWARE) - self._suspended_before_us) * self._speed)

    def carry_out(self, due: Due) -> str | None:
        """Begin or end a fault; return a note for the records, or None."""
        fault = Fault.model_validate(due.fault)
        name, kind, at_s = fault.part, fault.kind, due.time_us / constants.US_PER_S
        if name in self._out:
            return None
        if not due.begins:
            # The suspended firmware itself is timed by the wall clock.
            if name == COMPANION:
                self._pair.resume(name)
                return f"{name} resumed at {at_s:.2f} s"
            return None
        if fault.for_good:
            self._out[name] = kind
        if kind == KILLED:
            self._pair.kill(name)
        else:
            for_s = fault.for_s if name == FIRMWARE else None
            self._pair.suspend(name, None if for_s is None else for_s / self._speed)
        return f"{name} {kind} at {at_s:.2f} s, as asked for"

    def undo(self) -> None:
        """Resume both processes."""
        for name in (FIRMWARE, COMPANION):
            self._pair.resume(name)
