"""The comparison model: runs, and contrasts of two of them over pairs of flights."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

from pydantic import TypeAdapter

from airl_mav.core.files import read_typed, write_json
from airl_mav.flight.paired import PairedComparison
from airl_mav.flight.record import Setup
from airl_mav.flight.statistics import Aggregate
from airl_mav.latency.percentiles import Summary
from airl_mav.latency.stages import SETPOINT_TO_MOTOR, Stage
from airl_mav.profiles.published import PublishedGap, PublishedRun

T = TypeVar("T")

SCHEMA = 2
"""Version of the files of a comparison; docs/run-folder.md describes them."""

Kind = Literal["compare", "gap", "ladder", "matrix", "degradation"]
"""Names the files: `gap.json`, `gap.html`, `gap.md`."""

KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class RunEntry:
    """A run of a comparison: what it is called and where it lies."""

    name: str
    """No two runs of a comparison share it."""
    folder: str
    """From the folder of the comparison, or absolute."""
    label: str = ""
    """One line for people; empty: the name."""
    role: str = ""
    """What the run is for: `reference`, `target`, ..."""
    group: str = ""
    """Runs of one group share tables and figures: an arena, or a policy."""
    planned: int | None = None
    """Number of episodes asked for; None: as many as its run planned."""
    rules: str = ""
    """Goal radius, hold, height and time limit."""
    trained_in: str | None = None
    """Arena that its policy was trained in, if it was."""


@dataclass(frozen=True)
class ContrastEntry:
    """Which run is compared with which reference."""

    target: str
    reference: str
    key: str = ""
    title: str = ""
    """One line that names the reference."""
    short: str = ""


def part_of(entry: RunEntry) -> str:
    """Return a run's name without its group, as words, so that narrow columns can break it."""
    return entry.name.removeprefix(f"{Path(entry.group).stem}-").replace("-", " ")


@dataclass(frozen=True)
class NavigationStart:
    """Where navigation begins: means over the flights in which it did."""

    n: int
    takeoff_s: float
    """Time from the reset to the start of navigation [s]; 0: the level begins in a hover."""
    takeoff_distance_m: float
    takeoff_energy_j: float | None
    """None: not measured in all of them [J]."""
    aside_m: float
    """Distance from the vehicle's place at the reset, seen from above [m]."""
    height_m: float
    speed_m_s: float


@dataclass(frozen=True)
class ComparedRun:
    """One run in figures."""

    entry: RunEntry
    mark: str
    """Stands for the run where there is little room: its part in the comparison (`target`), a short
    name, or a letter."""
    setup: Setup
    planned: int
    flown: int
    facts: dict[str, str]
    """What was flown on what as text, by term."""
    quality: Aggregate
    stages: dict[str, Summary]
    """Durations of the stages of a decision by stage key [µs]; invalid flights left out."""
    slipped_us: int
    """Simulated time given up because the host could not keep pace [µs]."""
    start: NavigationStart | None
    """None where navigation never began."""
    position_error_m: float | None
    """Mean distance, seen from above, between the estimated and the true position during
    navigation [m]; None where no estimate is recorded."""
    sha256: str | None
    """Fingerprint of all flights; None where flights are never the same, or not all are there."""
    published: PublishedRun | None = None
    """The same column of a publication, if it has one."""

    @property
    def name(self) -> str:
        """Name of the run in the comparison."""
        return self.entry.name

    @property
    def label(self) -> str:
        """One line for people."""
        return self.entry.label or self.entry.name

    @property
    def heading(self) -> str:
        """Mark and label."""
        return self.label if self.mark == self.label else f"{self.mark}  {self.label}"

    @property
    def named(self) -> bool:
        """Whether its mark is what it is in the comparison, as those of all runs are then."""
        return bool(self.entry.role) and self.mark == part_of(self.entry)

    @property
    def modelled(self) -> bool:
        """Whether its times come from a model and were not measured: level gym."""
        return self.setup.level == "gym"

    def has_stage(self, stage: Stage) -> bool:
        """Return whether the run has durations of a stage that its level tells apart."""
        if self.modelled and stage.key in ("send", "link", "control"):
            return False
        return self.stages[stage.key].n > 0 and (self.modelled or stage != SETPOINT_TO_MOTOR)


@dataclass(frozen=True)
class Contrast:
    """A run against a reference on the same seeds."""

    entry: ContrastEntry
    paired: PairedComparison
    unmatched: int
    """Flights of a seed that the reference flew in another arena, or to another goal: no pairs."""
    t2_percent: float | None
    """Difference of the mean t2 [%]: over all decisions, not paired."""
    published: PublishedGap | None = None
    """The same difference of a publication's columns, if it has both of them."""

    @property
    def pairs(self) -> int:
        """Number of flights of the same episode."""
        return self.paired.agreement.n

    @property
    def successes(self) -> int:
        """Number of pairs of which both reached the goal."""
        return self.paired.flight_time_s.difference.n


@dataclass(frozen=True)
class Comparison:
    """Runs, and which of them is how much better or worse than which."""

    kind: Kind
    title: str
    facts: dict[str, Any]
    """What was asked for; all runs share it."""
    runs: tuple[ComparedRun, ...]
    """In the order of the tables."""
    contrasts: tuple[Contrast, ...]
    answers: tuple[str, ...] = ()
    """The verdict in whole sentences."""
    extra: dict[str, Any] = field(default_factory=dict)
    """What only this kind has: worst seeds by group, seeds with different outcomes, ..."""
    schema: int = SCHEMA

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups in the order of the runs."""
        return tuple(dict.fromkeys(run.entry.group for run in self.runs))

    def group(self, name: str) -> tuple[ComparedRun, ...]:
        """Return the runs of a group."""
        return tuple(run for run in self.runs if run.entry.group == name)

    def contrasts_of(self, group: str) -> tuple[Contrast, ...]:
        """Return the contrasts within a group."""
        names = {run.name for run in self.group(group)}
        return tuple(c for c in self.contrasts if c.entry.target in names)

    def run(self, name: str) -> ComparedRun:
        """Return the run of a name. Raises KeyError."""
        for run in self.runs:
            if run.name == name:
                return run
        raise KeyError(name)

    def pair(self, contrast: Contrast) -> tuple[ComparedRun, ComparedRun]:
        """Return the target and the reference of a contrast."""
        return self.run(contrast.entry.target), self.run(contrast.entry.reference)

    @property
    def different(self) -> tuple[str, ...]:
        """The terms in which the facts of the runs differ."""
        terms = dict.fromkeys(term for run in self.runs for term in run.facts)
        return tuple(term for term in terms if len({r.facts.get(term) for r in self.runs}) > 1)

    @property
    def same(self) -> dict[str, str]:
        """The facts that all runs share, by term."""
        different = set(self.different)
        return {term: text for term, text in self.runs[0].facts.items() if term not in different}


@dataclass(frozen=True)
class _StoredRun:
    entry: RunEntry


@dataclass(frozen=True)
class _StoredQuestion:
    """The part of a file that all else is worked out from again, with the runs."""

    facts: dict[str, Any]
    runs: tuple[_StoredRun, ...]


_COMPARISON = TypeAdapter(Comparison)
_QUESTION = TypeAdapter(_StoredQuestion)

KIND_NAMES: dict[Kind, str] = {
    "compare": "comparison",
    "gap": "hardware gap",
    "ladder": "ladder",
    "matrix": "table of policies x arenas",
    "degradation": "degradation curve",
}


def comparison_file(folder: Path, kind: Kind) -> Path:
    """Return the path of a comparison's data."""
    return folder / f"{kind}.json"


def kind_of(folder: Path) -> Kind | None:
    """Return the kind of comparison that a folder holds; None: none."""
    return next((kind for kind in KINDS if comparison_file(folder, kind).exists()), None)


def save_comparison(comparison: Comparison, folder: Path) -> None:
    """Write a comparison's data, whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(
        comparison_file(folder, comparison.kind), _COMPARISON.dump_python(comparison, mode="json")
    )


def load_comparison(folder: Path, kind: Kind) -> Comparison:
    """Read a comparison's data; its runs are not needed. Raises UsageError."""
    return _read(folder, kind, _COMPARISON)


def load_entries(folder: Path, kind: Kind) -> tuple[dict[str, Any], tuple[RunEntry, ...]]:
    """Read what a comparison is worked out from: its facts, and its runs. Raises UsageError."""
    held = _read(folder, kind, _QUESTION)
    return held.facts, tuple(run.entry for run in held.runs)


def _read(folder: Path, kind: Kind, adapter: TypeAdapter[T]) -> T:
    return read_typed(comparison_file(folder, kind), adapter, SCHEMA, KIND_NAMES[kind])
