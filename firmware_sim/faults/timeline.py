"""Faults of an episode that act now or have acted. Clients may add some."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from airl_mav.core.constants import US_PER_S
from airl_mav.core.streams import Stream, stream
from airl_mav.faults.kinds import Part
from airl_mav.faults.model import Fault
from airl_mav.faults.schedule import FOREVER_US, active, next_change_us
from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.commander import Flight, Phase

PHASE_OF_MODE: Mapping[Mode, str] = {
    Mode.TAKEOFF: "climb",
    Mode.HOLD: "hold",
    Mode.OFFBOARD: "offboard",
    Mode.MISSION: "mission",
    Mode.RETURN: "return",
    Mode.LAND: "landing",
    Mode.PRECISION_LAND: "landing",
}
"""Phase of a flight in the air, by the mode that is flown."""


class Acting(NamedTuple):
    """A fault that acts now."""

    number: int
    """Number in the episode, from 0."""
    fault: Fault
    since_us: int
    until_us: int
    """`FOREVER_US` for never."""


class Acted(NamedTuple):
    """A fault that has acted."""

    fault: str
    """In words."""
    from_us: int
    to_us: int


def phase_of(flight: Flight) -> str | None:
    """Return the phase of a flight, as faults name it; None for one that sets nothing off."""
    if flight.phase is Phase.AIR:
        return PHASE_OF_MODE.get(flight.mode)
    return None if flight.phase is Phase.BOOT else "ground"


class FaultTimeline:
    """The faults of one episode. Asked once a tick; everything else only when something changes."""

    def __init__(self, faults: Sequence[Fault], seed: int, start_us: int) -> None:
        """Begin an episode with these faults at `start_us`."""
        self._faults = list(faults)
        self._seed = seed
        self._entered: dict[str, int] = {}
        self._acting: dict[int, tuple[int, int]] = {}
        """From when to when those that act now do [µs since the start], by their index."""
        self._spans: list[Acted] = []
        self._open: dict[int, int] = {}
        self._listeners: list[Callable[[], None]] = []
        self.begin(start_us)

    def begin(self, start_us: int) -> None:
        """Say that the episode begins at `start_us` [µs]. What acted before is forgotten."""
        self._start_us = start_us
        self._entered.clear()
        self._spans.clear()
        self._open.clear()
        self._acting = {}
        self._phase: str | None = None
        self._next_us = 0
        self._now_us = start_us
        self._tell()

    def on_change(self, listener: Callable[[], None]) -> None:
        """Have `listener` called whenever a fault begins or ends."""
        self._listeners.append(listener)

    def update(self, time_us: int, flight: Flight) -> None:
        """Look what begins or ends at simulated `time_us` [µs], in this state of the flight."""
        phase, since_us = phase_of(flight), time_us - self._start_us
        self._now_us = time_us
        if phase is not self._phase:
            self._phase = phase
            if phase is not None and phase not in self._entered:
                self._entered[phase] = since_us
                self._next_us = 0
        if since_us >= self._next_us:
            self._renew(since_us)

    def acting(self, *parts: Part) -> list[Acting]:
        """Return the faults of these parts that act now, in the order of the episode's faults."""
        return [
            self._acting_at(index) for index in self._acting if self._faults[index].part in parts
        ]

    def generator(self, index: int, *more: int) -> np.random.Generator:
        """Return the randomness of a fault: of the episode's seed, of no other's draws."""
        return stream(self._seed, Stream.FAULTS, index, *more)

    def inject(self, fault: Fault) -> None:
        """Let a fault act from now on, whatever it says of its beginning."""
        at_s = max(0, self._now_us - self._start_us) / US_PER_S
        self._faults.append(fault.model_copy(update={"phase": None, "at_s": at_s}))
        self._renew(self._now_us - self._start_us)

    def clear(self, *parts: Part) -> None:
        """End all that acts on these parts, as if its time were over."""
        since_us = self._now_us - self._start_us
        for index, (begin_us, _) in self._acting.items():
            fault = self._faults[index]
            if fault.part in parts:
                for_s = max(1, since_us - begin_us) / US_PER_S
                self._faults[index] = fault.model_copy(update={"for_s": for_s})
        self._renew(since_us)

    def acted(self, now_us: int) -> list[Acted]:
        """Return all that has acted by `now_us` [µs], in the order of its beginning."""
        open_ = [
            Acted(str(self._faults[index]), from_us, now_us)
            for index, from_us in self._open.items()
        ]
        return sorted([*self._spans, *open_], key=lambda span: span.from_us)

    def _renew(self, since_us: int) -> None:
        before = self._acting
        self._acting = active(self._faults, since_us, self._entered)
        self._next_us = next_change_us(self._faults, since_us, self._entered)
        if self._acting.keys() == before.keys():
            return
        for index in before:
            if index not in self._acting:
                from_us = self._open.pop(index)
                self._spans.append(Acted(str(self._faults[index]), from_us, self._now_us))
        for index in self._acting:
            self._open.setdefault(index, self._now_us)
        self._tell()

    def _tell(self) -> None:
        for listener in self._listeners:
            listener()

    def _acting_at(self, index: int) -> Acting:
        begin_us, end_us = self._acting[index]
        until_us = end_us if end_us == FOREVER_US else self._start_us + end_us
        return Acting(index, self._faults[index], self._start_us + begin_us, until_us)


class ClientFaults:
    """Puts what clients inject among the faults of an episode. Implements `port.Failures`."""

    def __init__(self, timeline: Callable[[], FaultTimeline]) -> None:
        """Take what returns the faults of the episode, at the present time.

        It is asked first when something is injected. Until then nothing lies between the plant and
        the flight controller.
        """
        self._timeline = timeline
        self._injected = False

    def inject(self, fault: Fault) -> None:
        """Let a part fail from now on."""
        self._injected = True
        self._timeline().inject(fault)

    def clear(self, part: Part) -> None:
        """End all that acts on a part."""
        if self._injected:
            self._timeline().clear(part)
