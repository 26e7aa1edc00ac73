"""Reports a rehearsal to a view: the flight, its phases, its texts."""

from __future__ import annotations

from airl_mav.core.goals import Goal
from airl_mav.flight.record import EpisodeRecord
from airl_mav.rehearsal.channel import State, Text
from airl_mav.rehearsal.progress import WARNING, Observer
from airl_mav.view.ends import ViewEnds
from airl_mav.view.feed import Feed
from airl_mav.view.messages import Flight, Phase, Said

INFO = 6
"""MAV_SEVERITY_INFO."""


class ViewObserver(Observer):
    """Tells a view, and passes everything on to another observer."""

    def __init__(self, ends: ViewEnds, onwards: Observer) -> None:
        """Connect to a view."""
        self._feed = Feed(ends)
        self._onwards = onwards

    def waiting(self, what: str) -> None:
        """Pass on what is being waited for."""
        self._onwards.waiting(what)

    def episode(self, index: int, seed: int, goal: Goal) -> None:
        """Tell that an episode begins."""
        self._feed.send(Flight(index=index, seed=seed, goal=goal))
        self._onwards.episode(index, seed, goal)

    def phase(self, phase: str, time_us: int) -> None:
        """Tell the phase."""
        self._feed.send(Phase(time_us=time_us, phase=phase))
        self._onwards.phase(phase, time_us)

    def state(self, state: State, started_us: int) -> None:
        """Pass the state on: the view has it from the simulation, and more often."""
        self._onwards.state(state, started_us)

    def text(self, text: Text) -> None:
        """Tell what the autopilot says."""
        self._feed.send(Said(time_us=text.time_us, severity=text.severity, text=text.text))
        self._onwards.text(text)

    def finished(self, record: EpisodeRecord) -> None:
        """Tell how an episode has ended."""
        how = f"flight {record.index:03d}: {record.outcome.value}, {record.reason}"
        self._feed.send(Said(time_us=record.ended_us, severity=INFO, text=how))
        for note in record.notes:
            self._feed.send(Said(time_us=None, severity=WARNING, text=note))
        self._onwards.finished(record)

    def lost(self, what: str) -> None:
        """Tell that an episode begins again."""
        self._feed.send(Said(time_us=None, severity=WARNING, text=what))
        self._onwards.lost(what)

    def close(self) -> None:
        """Disconnect."""
        self._feed.close()
