"""The calibration that is going on: what it will say, and when."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import Message


class Step(NamedTuple):
    """A text of a calibration."""

    after_s: float
    """How long after the one before [s]."""
    message: Message


class RunningCalibration:
    """One vehicle's calibration, for all of its clients."""

    def __init__(self) -> None:
        self.sensor = ""
        self.radio = False
        """Whether a ground station calibrates a radio: it ends that with a cancellation."""
        self._steps: Iterator[Step] = iter(())
        self._next: Step | None = None
        self._due_us = 0

    @property
    def forbids_arming(self) -> bool:
        """Whether PX4 refuses to arm meanwhile."""
        return self.active or self.radio

    @property
    def active(self) -> bool:
        """Whether there is more to come."""
        return self._next is not None

    def start(self, sensor: str, steps: Iterator[Step], now_us: int) -> None:
        """Begin to calibrate a sensor, in the place of what may be running."""
        self.sensor, self._steps, self._due_us = sensor, steps, now_us
        self._plan()

    def due(self, now_us: int) -> list[Message]:
        """Return what is due at `now_us` [µs], in order."""
        messages: list[Message] = []
        while self._next is not None and self._due_us <= now_us:
            messages.append(self._next.message)
            self._plan()
        return messages

    def _plan(self) -> None:
        self._next = next(self._steps, None)
        if self._next is not None:
            self._due_us += round(self._next.after_s * US_PER_S)
