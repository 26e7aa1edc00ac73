"""Progress of a run: a bar with the current success rate, and events for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from airl_mav.core.progress import Event, Progress
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import reached_goals, wilson
from airl_mav.flight.trajectory import Quality

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
            **{name: _figure(record.quality, name) for name in FIGURES},
        )


def _figure(quality: Quality | None, name: str) -> Any:
    return None if quality is None else getattr(quality, name)


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
            interval = f"{100 * rate.low:.0f}, {100 * rate.high:.0f}"
            text = f"{100 * rate.value:.0f} % [{interval}] reached"
        self._bar.update(postfix=text, figures={"success": asdict(rate)})

    def close(self) -> None:
        """Remove the bar."""
        self._bar.close()
