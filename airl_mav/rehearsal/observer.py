"""Live display of a rehearsal: a line per episode, and the vehicle's state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar

from airl_mav.core import constants, frames
from airl_mav.core.progress import Event, Progress
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import reached_goals, wilson
from airl_mav.rehearsal.channel import State, Text

WARNING = 4
"""MAV_SEVERITY_WARNING: shows texts of this severity or worse."""

FLOWN_AGAIN = "flown again: "
"""Start of a note about an attempt before the recorded one."""

OUTCOME_STYLES = {
    Outcome.SUCCESS: "green",
    Outcome.COLLISION: "red",
    Outcome.TIMEOUT: "yellow",
    Outcome.BATTERY: "magenta",
    Outcome.ABORTED: "red",
}


class Observer:
    """Base class of observers of episodes; called from one thread at a time, does nothing."""

    shows_states = False
    """True if `state` has an effect. Creating a state takes longer than a tick."""

    def waiting(self, what: str) -> None:
        """Called when the rehearsal waits for something."""

    def episode(self, index: int, seed: int, goal: frames.Goal) -> None:
        """Called when an episode begins; its goal is (north, east) [m]."""

    def phase(self, phase: str, time_us: int) -> None:
        """Called when the companion enters a phase, at a simulated time [µs]."""

    def state(self, state: State, started_us: int) -> None:
        """Called with the vehicle's true state, and the start of the episode [µs]."""

    def text(self, text: Text) -> None:
        """Called for a text of the autopilot."""

    def poses(self, source: str) -> None:
        """Called with the source of the poses of a vehicle elsewhere, when it changes."""

    def finished(self, record: EpisodeRecord) -> None:
        """Called when an episode has been saved."""

    def lost(self, what: str) -> None:
        """Called when an episode was lost and begins again."""


class LiveObserver(Observer):
    """Shows a rehearsal on the terminal."""

    shows_states = True

    def __init__(
        self, progress: Progress, folder: Path, done: tuple[EpisodeRecord, ...], episodes: int
    ) -> None:
        """Begin with the episodes in a run folder, out of `episodes` in total."""
        self.finished_records: list[EpisodeRecord] = []
        """Records of episodes finished since the start, in that order."""
        self._progress = progress
        self._tally = Tally(progress, "flights", folder, done, episodes)
        self._flight = ""
        self._goal: frames.Goal = (0.0, 0.0)
        self._phase = ""

    def waiting(self, what: str) -> None:
        """Show the reason of a wait."""
        self._progress.status(what)

    def episode(self, index: int, seed: int, goal: frames.Goal) -> None:
        """Show that an episode begins."""
        self._goal = goal
        self._phase = "booting"
        self._flight = f"flight {index:03d}"
        self._progress.status(f"{self._flight}, seed {seed}")

    def phase(self, phase: str, time_us: int) -> None:
        """Show the phase."""
        self._phase = phase
        self._progress.status(f"{self._flight}: {phase} at {time_us / constants.US_PER_S:.1f} s")

    def state(self, state: State, started_us: int) -> None:
        """Show the vehicle's true state."""
        away = frames.goal_distance_m(self._goal, state.position)
        flown_s = (state.time_us - started_us) / constants.US_PER_S
        self._progress.watch(
            f"{self._flight}: {self._phase:<10} {flown_s:5.1f} s "
            f"{away:5.1f} m to goal {state.speed_m_s:4.1f} m/s "
            f"{-state.position[2]:4.1f} m high {100 * state.battery:3.0f} %"
        )

    def text(self, text: Text) -> None:
        """Print an autopilot text of severity warning or worse."""
        if text.severity <= WARNING:
            self._progress.note(f"  autopilot: {text.text}", "yellow")

    def poses(self, source: str) -> None:
        """Print the source of the poses."""
        self._progress.note(f"  poses: {source}; a collision only ends the flight")

    def finished(self, record: EpisodeRecord) -> None:
        """Print an episode's line and advance the bar."""
        self.finished_records.append(record)
        quality = record.quality
        figures = ""
        if quality is not None:
            figures = f"{quality.flight_time_s:6.1f} s {quality.distance_m:6.1f} m "
            if quality.energy_j is not None:
                figures += f"{quality.energy_j / 1e3:6.2f} kJ "
            figures += " "
        self._progress.note(
            f"  flight {record.index:03d}  seed {record.seed:<5} "
            f"{record.outcome.value:<10}{figures}{record.reason}"
            f"{' (invalid)' if record.invalid else ''}",
            "yellow" if record.invalid else OUTCOME_STYLES[record.outcome],
        )
        for note in record.notes:
            if not note.startswith(FLOWN_AGAIN):  # `lost` has printed it.
                self._progress.note(f"    {note}", "yellow")
        if record.sha256 is not None:
            self._progress.note(f"    sha256 {record.sha256['flight']}", "dim")
        self._tally.add(record)

    def lost(self, what: str) -> None:
        """Print the loss of an episode that begins again."""
        self._progress.note(f"  {what}", "yellow")

    def close(self) -> None:
        """Remove the bar."""
        self._progress.status(None)
        self._tally.close()


FIGURES = ("flight_time_s", "distance_m", "energy_j")
"""Quality figures sent to programs at once; the record contains all of them."""


@dataclass(frozen=True)
class RunOpened(Event):
    """Start or resumption of a run."""

    event: ClassVar[str] = "run"
    path: str
    """Path of the run folder."""
    planned: int
    """Total number of flights."""
    done: int
    """Number of flights finished before."""


@dataclass(frozen=True)
class FlightEnded(Event):
    """End of a saved flight."""

    event: ClassVar[str] = "flight"
    path: str
    """Run folder of the flight."""
    index: int
    """Index in the run, from 0."""
    seed: int
    outcome: str
    """`success`, `collision`, `timeout`, `battery` or `aborted`."""
    reason: str
    invalid: tuple[str, ...]
    """Reasons why the flight is no valid test and enters no figure; usually empty."""
    flight_time_s: float | None
    """This and the next two: None if the policy never flew."""
    distance_m: float | None
    energy_j: float | None
    sha256: str | None
    """Hash of the flight in lockstep; None elsewhere."""

    @classmethod
    def of(cls, path: Path, record: EpisodeRecord) -> FlightEnded:
        """Return the event of a record in a run folder."""
        return cls(
            path=str(path),
            index=record.index,
            seed=record.seed,
            outcome=record.outcome.value,
            reason=record.reason,
            invalid=record.invalid,
            sha256=None if record.sha256 is None else record.sha256["flight"],
            **{name: getattr(record.quality, name, None) for name in FIGURES},
        )


class Tally:
    """Counts the flights of a run as they end."""

    def __init__(
        self,
        progress: Progress,
        label: str,
        folder: Path,
        done: Sequence[EpisodeRecord],
        planned: int,
    ) -> None:
        """Open a labeled bar with the flights finished before."""
        self._progress, self._folder = progress, folder
        self._reached = list(reached_goals(done))
        self._bar = progress.bar(label, planned, completed=len(done), unit="flights")
        progress.tell(RunOpened(str(folder), planned, len(done)))
        if done:
            self._show()

    def add(self, record: EpisodeRecord) -> None:
        """Add a finished flight."""
        if not record.invalid:
            self._reached.append(record.outcome is Outcome.SUCCESS)
        self._progress.tell(FlightEnded.of(self._folder, record))
        self._show()
        self._bar.advance()

    def _show(self) -> None:
        rate = wilson(sum(self._reached), len(self._reached))
        text = ""
        if rate.value is not None and rate.low is not None and rate.high is not None:
            text = f"{100 * rate.value:.0f} % [{100 * rate.low:.0f}, {100 * rate.high:.0f}] reached"
        self._bar.update(postfix=text, figures={"success": asdict(rate)})

    def close(self) -> None:
        """Remove the bar."""
        self._bar.close()
