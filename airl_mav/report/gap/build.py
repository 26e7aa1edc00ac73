"""The hardware gap of a policy as a report shows it: what flew, what it lost, beside the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from airl_mav.core.constants import US_PER_MS
from airl_mav.core.errors import UsageError
from airl_mav.flight.gap import HardwareGap, hardware_gap, relative_gap, total_energy_j
from airl_mav.flight.judge import Outcome
from airl_mav.flight.paired import pair_by_seed
from airl_mav.flight.paper import MITIGATION, SYSTEM_EVALUATION, PaperFigures, PrintedGaps, gap_of
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.setup import Setup
from airl_mav.flight.statistics import Aggregate, Estimate, aggregate, bootstrap_mean
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.percentiles import Summary, summarize
from airl_mav.latency.stages import pool, stage_samples
from airl_mav.rehearsal.run_folder import LoadedRun, RunInfo, load

Role = Literal["reference", "target", "mitigated", "training", "mitigated-reference"]

OVERLAID = 100
"""Flights of a column that are drawn over each other: the first seeds."""

WORST = 6
"""Seeds that are looked at one by one."""


@dataclass(frozen=True)
class Held:
    """A column of an arena's table: one policy on one computer."""

    role: Role
    """`training` there may be several of: one for each source of latency."""
    title: str
    folder: str
    """Run folder inside that of the gap."""
    planned: int
    """Number of episodes asked for."""
    rules: str
    """Goal radius, hold, height and time limit in words."""


@dataclass(frozen=True)
class HeldArena:
    """The columns of one arena."""

    arena: str
    columns: tuple[Held, ...]


@dataclass(frozen=True)
class Flown:
    """A column, flown."""

    letter: str
    """By which it is called: a, b, c ..."""
    held: Held
    setup: Setup
    episodes: tuple[EpisodeRecord, ...]
    quality: Aggregate
    total_energy_j: Estimate
    """Vehicle and computer together."""
    t2: Summary
    """Of every decision that was flown [µs]."""
    paths: dict[int, Trajectory]
    """True paths of the flights that are drawn, by seed."""
    paper: PaperFigures | None
    """The same column in the paper, if it has it."""

    @property
    def name(self) -> str:
        """Letter and title."""
        return f"{self.letter}  {self.held.title}"


@dataclass(frozen=True)
class Gap:
    """A column against another one."""

    key: str
    title: str
    """In words, the reference named."""
    short: str
    target: Flown
    reference: Flown
    gap: HardwareGap
    t2_percent: float | None
    """Gap of the mean t2 [%]: not paired, every decision counts."""
    paper: PrintedGaps | None
    """The same gap from the paper's figures, by our definition; None: it has not both of them."""

    @property
    def letters(self) -> str:
        """The columns, as `b against a`."""
        return f"{self.target.letter} against {self.reference.letter}"


@dataclass(frozen=True)
class ArenaGap:
    """All that was flown in one arena."""

    arena: str
    columns: tuple[Flown, ...]
    gaps: tuple[Gap, ...]
    paper_table: str | None
    """Which of the paper's tables stands beside it."""
    worst: tuple[int, ...]
    """Seeds that the reference reached the goal with and that the target came off worst with."""

    def column(self, role: Role) -> Flown | None:
        """Return the first column of a role, if there is one."""
        return next((c for c in self.columns if c.held.role == role), None)

    def gap(self, key: str) -> Gap | None:
        """Return the first gap of a key, if there is one."""
        return next((gap for gap in self.gaps if gap.key == key), None)


@dataclass(frozen=True)
class GapStudy:
    """The hardware gap in one arena or several."""

    path: Path
    facts: dict[str, Any]
    """What was asked for; all arenas share it."""
    arenas: tuple[ArenaGap, ...]
    made: RunInfo
    """Of the first run: machine, commit and versions."""


@dataclass(frozen=True)
class _Kind:
    """Which two columns make a gap."""

    key: str
    target: Role
    reference: Role
    title: str
    short: str


WITHOUT, WITH = "without-mitigation", "with-mitigation"
WITH_TRAINED, WITHOUT_TRAINED = "with-mitigation-trained", "without-mitigation-trained"
COST, HELP = "cost-on-reference", "mitigation-on-target"

KINDS = (
    _Kind(
        WITHOUT, "target", "reference", "without mitigation, reference undelayed", "no mitigation"
    ),
    _Kind(WITH, "mitigated", "reference", "with mitigation, reference undelayed", "mitigated"),
    _Kind(
        WITHOUT_TRAINED,
        "target",
        "training",
        "without mitigation, reference delay-trained (the paper's way)",
        "no mitigation",
    ),
    _Kind(
        WITH_TRAINED,
        "mitigated",
        "training",
        "with mitigation, reference delay-trained (the paper's way)",
        "mitigated",
    ),
    _Kind(HELP, "mitigated", "target", "mitigation against none, both on the target", "mitigation"),
    _Kind(
        COST,
        "mitigated-reference",
        "reference",
        "mitigated policy where nothing is late, reference undelayed",
        "mitigated, undelayed",
    ),
)


def build_gap(path: Path, facts: Mapping[str, Any], held: Sequence[HeldArena]) -> GapStudy:
    """Work out the gaps from the run folders.

    Args:
        path: Folder of the gap.
        facts: What was asked for.
        held: The arenas, one or more, each with one column or more.

    Raises:
        UsageError: A folder holds no run, or a file of it cannot be read.
    """
    arenas, made = [], None
    for arena in held:
        runs = {column.folder: load(path / column.folder) for column in arena.columns}
        made = made or next(iter(runs.values())).info
        arenas.append(_arena(arena, facts, runs))
    if made is None:
        raise UsageError(f"{path}: no run here")
    return GapStudy(path, dict(facts), tuple(arenas), made)


def _arena(held: HeldArena, facts: Mapping[str, Any], runs: Mapping[str, LoadedRun]) -> ArenaGap:
    """Work out what was flown in one arena."""
    by_role = {column.role: runs[column.folder] for column in reversed(held.columns)}
    worst: tuple[int, ...] = ()
    if "reference" in by_role and "target" in by_role:
        worst = worst_seeds(by_role["reference"].episodes, by_role["target"].episodes)
    flown = tuple(
        _flown(letter, column, runs[column.folder], worst)
        for letter, column in zip("abcdefghijklmnopqrstuvwxyz", held.columns, strict=False)
    )
    table, columns = _beside_paper(held.arena, flown, facts)
    gaps = tuple(
        _gap(kind, target, reference)
        for kind in KINDS
        for target in columns
        for reference in columns
        if (target.held.role, reference.held.role) == (kind.target, kind.reference)
    )
    return ArenaGap(held.arena, columns, gaps, table, worst)


def _flown(
    letter: str,
    held: Held,
    run: LoadedRun,
    worst: Sequence[int],
) -> Flown:
    """Work out one column, and keep of its paths what will be drawn."""
    tests = [episode for episode in run.episodes if episode.outcome is not Outcome.ABORTED]
    drawn = [*tests[:OVERLAID], *(episode for episode in tests if episode.seed in worst)]
    good = [e.quality for e in tests if e.outcome is Outcome.SUCCESS and e.quality is not None]
    samples = pool(
        stage_samples(run.latency[episode.index])
        for episode in tests
        if episode.index in run.latency
    )
    return Flown(
        letter=letter,
        held=held,
        setup=run.info.setup,
        episodes=run.episodes,
        quality=aggregate(run.episodes),
        total_energy_j=bootstrap_mean([total_energy_j(quality) for quality in good]),
        t2=summarize(samples["t2"]),
        paths={e.seed: run.trajectories[e.index] for e in drawn if e.index in run.trajectories},
        paper=None,
    )


def _gap(kind: _Kind, target: Flown, reference: Flown) -> Gap:
    """Work out one gap."""
    late, early = target.t2.mean, reference.t2.mean
    paper = None
    if target.paper is not None and reference.paper is not None:
        paper = gap_of(reference.paper, target.paper)
    return Gap(
        key=kind.key,
        title=kind.title,
        short=kind.short,
        target=target,
        reference=reference,
        gap=hardware_gap(reference.episodes, target.episodes),
        t2_percent=relative_gap(early, late) if early and late is not None else None,
        paper=paper,
    )


def _beside_paper(
    arena: str, columns: tuple[Flown, ...], facts: Mapping[str, Any]
) -> tuple[str | None, tuple[Flown, ...]]:
    """Put the paper's columns beside those that are the same: its computers, as late as there.

    Returns:
        Which of its tables that is, and the columns.
    """
    asked = facts.get("computer"), facts.get("reference"), facts.get("latency")
    if asked != ("ras-pi-4", "workstation", None):
        return None, columns
    for table, figures in _paper_tables(Path(arena).stem):
        found = tuple(
            replace(column, paper=paper)
            if (paper := figures.get(column.held.role)) is not None
            and _as_late(column.t2.mean, paper.latency_ms)
            else column
            for column in columns
        )
        if any(column.held.role == "target" and column.paper is not None for column in found):
            return table, found
    return None, columns


def _paper_tables(arena: str) -> list[tuple[str, dict[Role, PaperFigures]]]:
    """Return the paper's tables of an arena by role, that with most columns first."""
    tables: list[tuple[str, dict[Role, PaperFigures]]] = []
    if arena == "static-obstacles":
        m = MITIGATION
        figures: dict[Role, PaperFigures] = {
            "reference": m.undelayed,
            "target": m.unmitigated,
            "mitigated": m.mitigated,
            "training": m.delay_trained,
        }
        tables.append((m.table, figures))
    for name, system in SYSTEM_EVALUATION.items():
        if name == arena:
            tables.append((system.table, {"reference": system.reference, "target": system.target}))
    return tables


def _as_late(t2_us: float | None, paper_ms: float) -> bool:
    """Return whether decisions come as late as in the paper, for the purpose of a comparison."""
    if t2_us is None:
        return False
    return abs(t2_us / US_PER_MS - paper_ms) <= max(0.2 * paper_ms, 20.0)


def worst_seeds(
    reference: Sequence[EpisodeRecord], target: Sequence[EpisodeRecord]
) -> tuple[int, ...]:
    """Return seeds that lost most: half of them failed, half took longest against the reference.

    The reference reached the goal with all of them. Of those that failed the first seeds are taken.
    """
    failed: list[int] = []
    slower: dict[int, float] = {}
    for first, second in pair_by_seed(reference, target):
        if first.outcome is not Outcome.SUCCESS or first.quality is None:
            continue
        if second.outcome is not Outcome.SUCCESS:
            failed.append(first.seed)
        elif second.quality is not None:
            slower[first.seed] = second.quality.flight_time_s / first.quality.flight_time_s
    longest = sorted(slower, key=lambda seed: (-slower[seed], seed))
    lost = sorted(failed)
    of_lost = max(WORST // 2, WORST - len(longest))
    chosen = lost[:of_lost]
    return (*chosen, *longest[: WORST - len(chosen)])
