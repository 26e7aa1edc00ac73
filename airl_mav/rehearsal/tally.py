"""How a run goes while it is flown: a bar with the success rate so far, lines for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from airl_mav.core.progress import Event, Progress
from airl_mav.flight.judge import Outcome
from airl_mav.flight.quality import Quality
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.statistics import reached_goals, wilson

FIGURES = ("flight_time_s", "distance_m", "energy_j")
"""Of a flight's quality, that programs hear at once; all of them are in its record."""


@dataclass(frozen=True)
class RunOpened(Event):
    """A run begins, or goes on."""

    event: ClassVar[str] = "run"
    path: str
    """Its folder."""
    planned: int
    """Number of flights in all."""
    done: int
    """Number of those that were flown before."""


@dataclass(frozen=True)
class FlightEnded(Event):
    """A flight has ended and is saved."""

    event: ClassVar[str] = "flight"
    path: str
    """Folder of its run."""
    index: int
    """Its number in the run, from 0."""
    seed: int
    outcome: str
    """`success`, `collision`, `timeout`, `battery` or `aborted`."""
    reason: str
    invalid: tuple[str, ...]
    """Why it is no test of its policy and enters no figure; mostly empty."""
    flight_time_s: float | None
    """This and the next two: None where the policy never flew."""
    distance_m: float | None
    energy_j: float | None
    sha256: str | None
    """Fingerprint of the flight in lockstep; None elsewhere."""

    @classmethod
    def of(cls, path: Path, record: EpisodeRecord) -> FlightEnded:
        """Return what is heard of a record in a run folder."""
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
        """Open a bar of that label, with the flights that were there before."""
        self._progress, self._folder = progress, folder
        self._reached = list(reached_goals(done))
        self._bar = progress.bar(label, planned, completed=len(done), unit="flights")
        progress.tell(RunOpened(str(folder), planned, len(done)))
        if done:
            self._show()

    def add(self, record: EpisodeRecord) -> None:
        """Take a flight that has just ended."""
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
