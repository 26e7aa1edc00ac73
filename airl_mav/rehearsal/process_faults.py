"""Faults of the two processes in one episode, at the firmware's `channel.Due`."""

from __future__ import annotations

from airl_mav.core.constants import US_PER_S
from airl_mav.faults.model import Fault
from airl_mav.rehearsal.channel import Due
from airl_mav.rehearsal.process_pair import COMPANION, FIRMWARE, ProcessPair

KILLED = "killed"


class ProcessFaults:
    """Carries out what is due."""

    def __init__(self, pair: ProcessPair, speed: float) -> None:
        """Take the processes, and simulated seconds per wall second."""
        self._pair = pair
        self._speed = speed
        self._suspended_before_us = pair.suspended_us(FIRMWARE)
        self._out: dict[str, str] = {}

    def out(self, name: str) -> str | None:
        """Return what became of a process that flies no more in this episode, as "killed"."""
        return self._out.get(name)

    @property
    def reason(self) -> str | None:
        """Why a flight ends that one of them flies no more, in words; None: both fly."""
        return "; ".join(f"{name} {kind}" for name, kind in self._out.items()) or None

    @property
    def paused_us(self) -> int:
        """How long the firmware was suspended, as asked for [simulated µs]."""
        return round((self._pair.suspended_us(FIRMWARE) - self._suspended_before_us) * self._speed)

    def carry_out(self, due: Due) -> str | None:
        """Begin or end a fault; return what was done, for the records, or None."""
        fault = Fault.model_validate(due.fault)
        name, kind, at_s = fault.part, fault.kind, due.time_us / US_PER_S
        if name in self._out:
            return None
        if not due.begins:
            # The firmware, which is suspended itself, is timed by the wall clock.
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
        """Let those go on that still stand."""
        for name in (FIRMWARE, COMPANION):
            self._pair.resume(name)
