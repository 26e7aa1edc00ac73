"""Observer that reports a rehearsal to a view: flight, phases and texts."""

from __future__ import annotations

from airl_mav.core.frames import Goal
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.rehearsal.channel import State, Text
from airl_mav.rehearsal.observer import WARNING, Observer
from airl_mav.view.ends import ViewEnds
from airl_mav.view.feed import Feed
from airl_mav.view.view_messages import Flight, PhaseStart, Said

INFO = 6
"""MAV_SEVERITY_INFO."""


class ViewObserver(Observer):
    """Reports to a view, and forwards all events to another observer."""

    def __init__(self, ends: ViewEnds, onwards: Observer) -> None:
        """Connect to a view."""
        self._feed = Feed(ends)
        self._onwards = onwards
        self.shows_states = onwards.shows_states

    def waiting(self, what: str) -> None:
        """Forward the reason of a wait."""
        self._onwards.waiting(what)

    def episode(self, index: int, seed: int, goal: Goal) -> None:
        """Report the start of an episode."""
        self._feed.send(Flight(index=index, seed=seed, goal=goal))
        self._onwards.episode(index, seed, goal)

    def phase(self, phase: str, time_us: int) -> None:
        """Report the phase."""
        self._feed.send(PhaseStart(time_us=time_us, phase=phase))
        self._onwards.phase(phase, time_us)

    def state(self, state: State, started_us: int) -> None:
        """Forward the state: the view gets it from the simulation, and more often."""
        self._onwards.state(state, started_us)

    def text(self, text: Text) -> None:
        """Report a text of the autopilot."""
        self._feed.send(Said(time_us=text.time_us, severity=text.severity, text=text.text))
        self._onwards.text(text)

    def finished(self, record: EpisodeRecord) -> None:
        """Report the end of an episode."""
        how = f"flight {record.index:03d}: {record.outcome.value}, {record.reason}"
        self._feed.send(Said(time_us=record.ended_us, severity=INFO, text=how))
        for note in record.notes:
            self._feed.send(Said(time_us=None, severity=WARNING, text=note))
        self._onwards.finished(record)

    def lost(self, what: str) -> None:
        """Report that an episode begins again."""
        self._feed.send(Said(time_us=None, severity=WARNING, text=what))
        self._onwards.lost(what)

    def close(self) -> None:
        """Disconnect."""
        self._feed.close()
