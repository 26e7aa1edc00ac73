"""Timeline of the faults of an episode, to which clients can add faults.

An add-on executes the faults: table FAULT_EFFECTS.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from airl_mav.core import addons, constants, errors, streams
from airl_mav.core.clock import Clock
from airl_mav.faults import FOREVER_US, Fault, Part, active, next_change_us
from firmware_sim.autopilot.commander import CommanderState, FlightPhase
from firmware_sim.mavlink.endpoint import SharedEndpoint


class Acting(NamedTuple):
    """Active fault."""

    number: int
    """Index in the episode, from 0."""
    fault: Fault
    since_us: int
    until_us: int
    """Simulated time of the end [µs]; `FOREVER_US` = no end."""


class Acted(NamedTuple):
    """Past or present activity of a fault."""

    fault: str
    """Fault as text."""
    from_us: int
    to_us: int


def phase_of(flight: CommanderState) -> str | None:
    """Return the flight phase by the name used in faults; None = no fault starts in it."""
    if flight.phase is FlightPhase.AIR:
        return flight.mode.spec.phase
    return None if flight.phase is FlightPhase.BOOT else "ground"


class FaultTimeline:
    """Faults of one episode. Updated once per tick; listeners are called only on a change."""

    def __init__(self, faults: Sequence[Fault], seed: int, start_us: int) -> None:
        """Begin an episode with these faults at `start_us` [µs]."""
        self._faults = list(faults)
        self._seed = seed
        self._entered: dict[str, int] = {}
        self._acting: dict[int, tuple[int, int]] = {}
        """Begin and end of the active faults [µs since the start], by index."""
        self._spans: list[Acted] = []
        self._open: dict[int, int] = {}
        self._listeners: list[Callable[[], None]] = []
        self.begin(start_us)

    def begin(self, start_us: int) -> None:
        """Start the episode at `start_us` [µs]: discard earlier activity."""
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
        """Call `listener` whenever a fault begins or ends."""
        self._listeners.append(listener)

    def update(self, time_us: int, flight: CommanderState) -> None:
        """Begin and end faults at simulated `time_us` [µs], for this flight phase and mode."""
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
        """Return the active faults of these parts, in the order of the episode's faults."""
        return [
            self._acting_at(index) for index in self._acting if self._faults[index].part in parts
        ]

    def generator(self, index: int, *more: int) -> np.random.Generator:
        """Return the random generator of a fault, derived from the seed, independent of others."""
        return streams.stream(self._seed, streams.Stream.FAULTS, index, *more)

    def inject(self, fault: Fault) -> None:
        """Start a fault now, regardless of its configured start."""
        at_s = max(0, self._now_us - self._start_us) / constants.US_PER_S
        self._faults.append(fault.model_copy(update={"phase": None, "at_s": at_s}))
        self._renew(self._now_us - self._start_us)

    def clear(self, *parts: Part) -> None:
        """End all active faults of these parts, as if their duration were over."""
        since_us = self._now_us - self._start_us
        for index, (begin_us, _) in self._acting.items():
            fault = self._faults[index]
            if fault.part in parts:
                for_s = max(1, since_us - begin_us) / constants.US_PER_S
                self._faults[index] = fault.model_copy(update={"for_s": for_s})
        self._renew(since_us)

    def acted(self, now_us: int) -> list[Acted]:
        """Return all fault activity up to `now_us` [µs], sorted by start."""
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
    """Fault injection by clients into the faults of an episode."""

    def __init__(self, timeline: Callable[[], FaultTimeline]) -> None:
        """Set the function that returns the episode's faults, at the present time.

        The first injection calls it first, and only then is the fault layer inserted between the
        plant and the flight controller.
        """
        self._timeline = timeline
        self._injected = False

    def inject(self, fault: Fault) -> None:
        """Start a fault now."""
        self._injected = True
        self._timeline().inject(fault)

    def clear(self, part: Part) -> None:
        """End all active faults of a part."""
        if self._injected:
            self._timeline().clear(part)


class FailingLink(SharedEndpoint, Protocol):
    """Endpoint behind a failing link."""

    def begin(self, timeline: FaultTimeline | None) -> None:
        """Begin an episode with these faults, once per episode. Frames in transit are lost."""


def fault_effect(place: str) -> Any:
    """Return what executes the faults at a place: `parts`, `camera` or `link`.

    Raises UsageError without the add-on.
    """
    effects = addons.entries("firmware_sim", "FAULT_EFFECTS")
    if place not in effects:
        raise errors.UsageError("faults: require the add-on firmware_sim.addons.fault_injection")
    return addons.load(effects[place])


def failing_link(endpoint: SharedEndpoint, clock: Clock, *, conducted: bool = False) -> FailingLink:
    """Return an endpoint whose link can fail; `conducted`: the companion runs in lockstep."""
    link: FailingLink = fault_effect("link")(endpoint, clock, conducted=conducted)
    return link
