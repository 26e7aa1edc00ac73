"""Comparison model: runs, and contrasts between two runs over pairs of flights."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

from pydantic import TypeAdapter

from airl_mav.core.files import read_typed, write_json
from airl_mav.flight import episode_record, statistics
from airl_mav.latency.stages import SETPOINT_TO_MOTOR, Stage, Summary
from airl_mav.profiles.loading import PublishedGap, PublishedRun

T = TypeVar("T")

SCHEMA = 3
"""Schema version of a comparison's files, described in docs/reference/run-folder.md."""

Kind = Literal["compare", "hardware-gap", "compare-levels", "matrix", "latency-sweep"]
"""Kind of comparison and stem of its files: `matrix.json`, `matrix.html`, `matrix.md`."""

FLOWN_UNTIL = "flown_until"
"""Fact of a comparison with a sequential test, whose flights stop at a decision."""

KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class RunEntry:
    """Name and folder of a run in a comparison."""

    name: str
    """Name, unique within the comparison."""
    folder: str
    """Path relative to the comparison's folder, or absolute."""
    label: str = ""
    """Display name on one line; empty = the name."""
    role: str = ""
    """Role of the run: `reference`, `target`, ..."""
    group: str = ""
    """Arena or policy; runs of one group share tables and figures."""
    planned: int | None = None
    """Number of requested episodes; None = the number planned by the run."""
    rules: str = ""
    """Rules of judging: goal radius, hold, height and time limit."""
    trained_in: str | None = None
    """Training arena of the policy, if trained."""


@dataclass(frozen=True)
class ContrastEntry:
    """Names of a run and the reference for its contrast."""

    target: str
    reference: str
    key: str = ""
    title: str = ""
    """Title on one line that names the reference."""
    short: str = ""


def part_of(entry: RunEntry) -> str:
    """Return a run's name without its group, as words that narrow columns can wrap."""
    return entry.name.removeprefix(f"{Path(entry.group).stem}-").replace("-", " ")


@dataclass(frozen=True)
class NavigationStart:
    """Start of navigation: means over the flights with navigation."""

    n: int
    takeoff_s: float
    """Time from the reset to the start of navigation [s]; 0 = the level starts in a hover."""
    takeoff_distance_m: float
    takeoff_energy_j: float | None
    """Take-off energy [J]; None if not measured in all flights."""
    aside_m: float
    """Horizontal distance from the vehicle's position at the reset [m]."""
    height_m: float
    speed_m_s: float


@dataclass(frozen=True)
class ComparedRun:
    """Figures of one run."""

    entry: RunEntry
    mark: str
    """Abbreviation of the run for narrow columns: its role in the comparison (`target`), a short
    name, or a letter."""
    setup: episode_record.Setup
    planned: int
    flown: int
    facts: dict[str, str]
    """Setup of the run as text, by term."""
    quality: statistics.Aggregate
    stages: dict[str, Summary]
    """Durations of decision stages by stage key [µs], without invalid flights."""
    slipped_us: int
    """Simulated time skipped by a host too slow for real time [µs]."""
    start: NavigationStart | None
    """Start of navigation; None if navigation never started."""
    position_error_m: float | None
    """Mean horizontal distance between estimated and true position during navigation [m]; None
    without recorded estimates."""
    sha256: str | None
    """Checksum of all flights; None if flights are not reproducible or missing."""
    published: PublishedRun | None = None
    """Corresponding column of a publication, if any."""

    @property
    def name(self) -> str:
        """Name of the run in the comparison."""
        return self.entry.name

    @property
    def label(self) -> str:
        """Display name on one line."""
        return self.entry.label or self.entry.name

    @property
    def heading(self) -> str:
        """Mark and label."""
        return self.label if self.mark == self.label else f"{self.mark}  {self.label}"

    @property
    def named(self) -> bool:
        """True if the mark is the run's role in the comparison, for all runs alike."""
        return bool(self.entry.role) and self.mark == part_of(self.entry)

    @property
    def modelled(self) -> bool:
        """True if times come from a model instead of measurements: level gym."""
        return self.setup.level == "gym"

    def has_stage(self, stage: Stage) -> bool:
        """Return True if the run has durations of a stage that its level distinguishes."""
        if self.modelled and stage.key in ("send", "link", "control"):
            return False
        return self.stages[stage.key].n > 0 and (self.modelled or stage != SETPOINT_TO_MOTOR)


@dataclass(frozen=True)
class Contrast:
    """Differences between a run and a reference on the same seeds."""

    entry: ContrastEntry
    paired: statistics.PairedComparison
    unmatched: int
    """Flights without a pair: the reference flew their seed in another arena or to another goal."""
    t2_percent: float | None
    """Difference of the mean t2 [%] over all decisions, unpaired."""
    published: PublishedGap | None = None
    """Corresponding difference of a publication, if it has both columns."""

    @property
    def pairs(self) -> int:
        """Number of pairs of flights of the same episode."""
        return self.paired.agreement.n

    @property
    def successes(self) -> int:
        """Number of pairs in which both flights reached the goal."""
        return self.paired.flight_time_s.difference.n


@dataclass(frozen=True)
class Comparison:
    """Runs and the contrasts between them."""

    kind: Kind
    title: str
    facts: dict[str, Any]
    """Settings of the comparison, shared by all runs."""
    runs: tuple[ComparedRun, ...]
    """Runs in the order of the tables."""
    contrasts: tuple[Contrast, ...]
    answers: tuple[str, ...] = ()
    """Verdict in full sentences."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Data of this kind only: worst seeds by group, seeds with different outcomes, ..."""
    schema: int = SCHEMA

    @property
    def stopped(self) -> bool:
        """True if a sequential test ended the flights."""
        return FLOWN_UNTIL in self.facts

    @property
    def groups(self) -> tuple[str, ...]:
        """Groups in the order of the runs."""
        return tuple(dict.fromkeys(run.entry.group for run in self.runs))

    def group(self, name: str) -> tuple[ComparedRun, ...]:
        """Return the runs of a group."""
        return tuple(run for run in self.runs if run.entry.group == name)

    def contrasts_of(self, group: str) -> tuple[Contrast, ...]:
        """Return the contrasts within a group."""
        names = {run.name for run in self.group(group)}
        return tuple(c for c in self.contrasts if c.entry.target in names)

    def run(self, name: str) -> ComparedRun:
        """Return the run with a name. Raises KeyError."""
        for run in self.runs:
            if run.name == name:
                return run
        raise KeyError(name)

    def pair(self, contrast: Contrast) -> tuple[ComparedRun, ComparedRun]:
        """Return the target and the reference of a contrast."""
        return self.run(contrast.entry.target), self.run(contrast.entry.reference)

    @property
    def different(self) -> tuple[str, ...]:
        """Terms in which the facts of the runs differ."""
        terms = dict.fromkeys(term for run in self.runs for term in run.facts)
        return tuple(term for term in terms if len({r.facts.get(term) for r in self.runs}) > 1)

    @property
    def same(self) -> dict[str, str]:
        """Facts shared by all runs, by term."""
        different = set(self.different)
        return {term: text for term, text in self.runs[0].facts.items() if term not in different}


@dataclass(frozen=True)
class _StoredRun:
    entry: RunEntry


@dataclass(frozen=True)
class _StoredQuestion:
    """Part of a file from which, with the runs, a comparison is recomputed."""

    facts: dict[str, Any]
    runs: tuple[_StoredRun, ...]


_COMPARISON = TypeAdapter(Comparison)
_QUESTION = TypeAdapter(_StoredQuestion)

KIND_NAMES: dict[Kind, str] = {
    "compare": "comparison",
    "hardware-gap": "hardware gap",
    "compare-levels": "comparison of levels",
    "matrix": "table of policies x arenas",
    "latency-sweep": "latency sweep",
}


def comparison_file(folder: Path, kind: Kind) -> Path:
    """Return the path of a comparison's data."""
    return folder / f"{kind}.json"


def kind_of(folder: Path) -> Kind | None:
    """Return the kind of a folder's comparison; None without one."""
    return next((kind for kind in KINDS if comparison_file(folder, kind).exists()), None)


def save_comparison(comparison: Comparison, folder: Path) -> None:
    """Write a comparison's data atomically."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(
        comparison_file(folder, comparison.kind), _COMPARISON.dump_python(comparison, mode="json")
    )


def load_comparison(folder: Path, kind: Kind) -> Comparison:
    """Read a comparison's data; does not require the runs. Raises UsageError."""
    return _read(folder, kind, _COMPARISON)


def load_entries(folder: Path, kind: Kind) -> tuple[dict[str, Any], tuple[RunEntry, ...]]:
    """Read the facts and runs of a comparison, for recomputing it. Raises UsageError."""
    held = _read(folder, kind, _QUESTION)
    return held.facts, tuple(run.entry for run in held.runs)


def _read(folder: Path, kind: Kind, adapter: TypeAdapter[T]) -> T:
    return read_typed(comparison_file(folder, kind), adapter, SCHEMA, KIND_NAMES[kind])
