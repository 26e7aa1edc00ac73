"""Any number of runs beside each other: the first is the reference of all others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from airl_mav.core.errors import UsageError
from airl_mav.core.files import read_json, write_json
from airl_mav.flight.judge import Outcome
from airl_mav.flight.paired import Comparison, compare
from airl_mav.flight.record import EpisodeRecord, run_sha256
from airl_mav.flight.statistics import Aggregate
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report.ladder.build import LADDER_FILE
from airl_mav.report.matrix import MATRIX_FILE
from airl_mav.report.summary import RunSummary, summarize_run
from airl_mav.report.tables import setup_rows

SCHEMA = 1
"""Version of `compare.json`; docs/run-folder.md describes it."""

COMPARE_FILE = "compare.json"

NAMING = ("policy", "arena", "computer", "level", "vehicle")
"""Parts of a setup that may tell runs apart in a few words."""

LONGEST_NAME = 48
"""A name of more letters than this is no name any more."""

SHORT_NAME = 14
"""Names up to this length need no letter."""

UNCOMPARED = ("sha256 of the flights",)
"""Terms that always differ, and explain nothing."""

MACHINE_TERMS = ("cpu", "os")
"""What is told of the machine that flew, of what its run says."""

_COMPARISON = TypeAdapter(Comparison)
_AGGREGATE = TypeAdapter(Aggregate)


@dataclass(frozen=True)
class Side:
    """One of the runs."""

    name: str
    """No two sides have the same."""
    run: LoadedRun
    summary: RunSummary
    facts: dict[str, str]
    """What was flown on what, by term."""


@dataclass(frozen=True)
class Pairing:
    """A run against the reference."""

    name: str
    comparison: Comparison
    strangers: int
    """Flights of a seed that the reference flew in another arena, or to another goal: no pairs."""

    @property
    def pairs(self) -> int:
        """Number of flights of the same episode."""
        return self.comparison.agreement.n


@dataclass(frozen=True)
class Compared:
    """Two or more runs, and each one against the first."""

    sides: tuple[Side, ...]
    pairings: tuple[Pairing, ...]
    """Of the second run and those after it."""

    @property
    def reference(self) -> Side:
        """The run that the others are compared with."""
        return self.sides[0]

    @property
    def terms(self) -> tuple[str, ...]:
        """All that is said of any of the runs, in order."""
        return tuple(dict.fromkeys(term for side in self.sides for term in side.facts))

    @property
    def different(self) -> tuple[str, ...]:
        """The terms in which the runs differ."""
        return tuple(
            term for term in self.terms if len({side.facts.get(term) for side in self.sides}) > 1
        )

    @property
    def same(self) -> dict[str, str]:
        """What is the same in all runs, by term."""
        different = set(self.different)
        return {k: v for k, v in self.reference.facts.items() if k not in different}


def lettered(compared: Compared) -> Compared:
    """Return the same with letters for long names, from A on: where there is little room."""
    return _renamed(compared, [letter or name for letter, name in _keys(compared)])


def keyed(compared: Compared) -> Compared:
    """Return the same with the letter of `lettered` before each name that has one."""
    return _renamed(compared, [f"{a}  {name}" if a else name for a, name in _keys(compared)])


def _keys(compared: Compared) -> list[tuple[str, str]]:
    """Return letter and name of every run; no letters where all names are short."""
    names = [side.name for side in compared.sides]
    short = all(len(name) <= SHORT_NAME for name in names)
    return [("" if short else _letter(i), name) for i, name in enumerate(names)]


def _renamed(compared: Compared, names: Sequence[str]) -> Compared:
    return Compared(
        tuple(replace(side, name=name) for side, name in zip(compared.sides, names, strict=True)),
        tuple(
            replace(pairing, name=name)
            for pairing, name in zip(compared.pairings, names[1:], strict=True)
        ),
    )


def _letter(index: int) -> str:
    """Return A to Z, then AA, AB and so on."""
    rest, last = divmod(index, 26)
    return ("" if not rest else _letter(rest - 1)) + chr(ord("A") + last)


def load_compared(paths: Sequence[Path], names: Sequence[str] = ()) -> Compared:
    """Read runs and work out what differs.

    Args:
        paths: Run folders; a ladder's folder stands for those of its levels, that of a table of
            policies x arenas for those of its cells.
        names: What the runs are called, in the same order; none: what tells them apart.

    Raises:
        UsageError: A folder holds no run, or one of no flights; fewer than two runs; one twice;
            names that do not fit.
    """
    folders = [folder for path in paths for folder in run_folders(path)]
    if len(folders) < 2:
        raise UsageError(f"{len(folders)} run: accepted: two or more to compare")
    resolved = [folder.resolve() for folder in folders]
    if twice := [f for f, r in zip(folders, resolved, strict=True) if resolved.count(r) > 1]:
        raise UsageError(f"{twice[0]}: twice; accepted: each run once")
    runs = [load(folder) for folder in folders]
    for run in runs:
        if not run.episodes:
            raise UsageError(f"{run.path}: no flight was finished: nothing to compare")
    return compare_runs(runs, names)


def run_folders(path: Path) -> list[Path]:
    """Return the run folders that a folder stands for: itself, or those of its ladder or table."""
    for file, key in ((LADDER_FILE, "levels"), (MATRIX_FILE, "cells")):
        if (path / file).exists():
            try:
                parts = read_json(path / file, None, "table of runs")[key]
                names = [n for part in parts for n in part.get("folders", [part.get("folder")])]
                return [path / name for name in names]
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                raise UsageError(f"{path / file}: cannot be read: {error}") from None
    return [path]


def compare_runs(runs: Sequence[LoadedRun], names: Sequence[str] = ()) -> Compared:
    """Work out what differs between runs that are loaded; see `load_compared`."""
    facts = [_facts(run) for run in runs]
    sides = tuple(
        Side(name, run, summarize_run(run), each)
        for name, run, each in zip(_checked(names, runs), runs, facts, strict=True)
    )
    reference = sides[0]
    return Compared(sides, tuple(_pairing(reference, side) for side in sides[1:]))


def _pairing(reference: Side, other: Side) -> Pairing:
    """Compare a run with the reference on the episodes that both flew."""
    held = {episode.seed: episode for episode in reference.run.episodes}
    known = [episode for episode in other.run.episodes if episode.seed in held]
    same = [episode for episode in known if _same_task(episode, held[episode.seed])]
    try:
        comparison = compare(reference.run.episodes, same)
    except ValueError as error:
        raise UsageError(f"{reference.run.path} and {other.run.path}: {error}") from None
    return Pairing(other.name, comparison, len(known) - len(same))


def _same_task(first: EpisodeRecord, second: EpisodeRecord) -> bool:
    """Return whether two flights had the same way to go."""
    return (first.arena, first.arena_seed, first.goal) == (
        second.arena,
        second.arena_seed,
        second.goal,
    )


def _facts(run: LoadedRun) -> dict[str, str]:
    """Return what was flown on what, by term: the setup, then the settings."""
    facts = dict(setup_rows(run))
    flown = [e for e in run.episodes if e.outcome is not Outcome.ABORTED]
    facts["flights"] = f"{len(flown):,}"
    seeds = [episode.seed for episode in run.episodes]
    low, high = min(seeds), max(seeds)
    facts["seeds"] = f"{low} to {high}" if low != high else f"{low}"
    radii = dict.fromkeys(f"{episode.goal_radius_m:g} m" for episode in run.episodes)
    limits = dict.fromkeys(f"{episode.time_limit_s:g} s" for episode in run.episodes)
    facts["goal radius"], facts["time limit"] = ", ".join(radii), ", ".join(limits)
    if (seed := run.info.config.get("arena_seed")) is not None:
        facts["arena and goal of seed"] = f"{seed}"
    if (hold := _hold(run.info.config)) is not None:
        facts["hold t3"] = f"{hold:g} s"
    facts["commit"] = _commit(run.info.git)
    facts["flown on"] = ", ".join(
        f"{run.info.machine[key]}" for key in MACHINE_TERMS if run.info.machine.get(key)
    )
    return {term: text for term, text in facts.items() if text and term not in UNCOMPARED}


def _commit(git: Mapping[str, Any] | None) -> str:
    if git is None or not git.get("commit"):
        return ""
    changed = " (with changes)" if git.get("changed") else ""
    return f"{str(git['commit'])[:10]}{changed}"


def _hold(config: Mapping[str, Any]) -> float | None:
    """Return the hold time, in whatever table the level writes it down [s]."""
    held = config.get("hold_s")
    if isinstance(held, (int, float)):
        return float(held)
    tables = (value for value in config.values() if isinstance(value, Mapping))
    return next((found for table in tables if (found := _hold(table)) is not None), None)


def _checked(names: Sequence[str], runs: Sequence[LoadedRun]) -> list[str]:
    """Return the names of runs: those given, or else what tells them apart."""
    if not names:
        return _names(runs)
    if len(names) != len(runs):
        raise UsageError(f"--names: {len(names)} for {len(runs)} runs; accepted: one a run")
    for name in names:
        if not name.strip() or list(names).count(name) > 1:
            raise UsageError(f"--names {name!r}: accepted: words, each name once")
    return list(names)


def _names(runs: Sequence[LoadedRun]) -> list[str]:
    """Name runs by what tells them apart; by their folders where that does not do it."""
    rows = [_words(run) for run in runs]
    telling = [key for key in rows[0] if len({row[key] for row in rows}) > 1]
    names = [", ".join(row[key] for key in telling if row[key]) for row in rows]
    if len(set(names)) == len(runs) and all(0 < len(name) <= LONGEST_NAME for name in names):
        return names
    folders = [run.path.resolve().name for run in runs]
    if len(set(folders)) == len(runs):
        return folders
    return [str(run.path) for run in runs]


def _words(run: LoadedRun) -> dict[str, str]:
    """Return what might tell a run apart, by kind."""
    setup, config = run.info.setup, run.info.config
    parts = {kind: getattr(setup, kind) for kind in NAMING}
    words = {
        k: part if isinstance(part, str) else Path(part.name).stem for k, part in parts.items()
    }
    t2 = setup.injection
    words["t2"] = _short_t2(run) if t2.latency is not None else ""
    words["ablate"] = f"no {config['ablate']}" if config.get("ablate") else ""
    return words


def _short_t2(run: LoadedRun) -> str:
    """Return the latency that was injected in a few letters."""
    latency = run.info.setup.injection.latency
    if latency is None:
        return ""
    if latency.samples_ms is not None:
        return f"{sum(latency.samples_ms) / len(latency.samples_ms):.0f} ms"
    return f"{latency.mean_ms:.4g} ms"


def write_compared(compared: Compared, folder: Path) -> None:
    """Write `compare.json`, whole or not at all."""
    data = {
        "schema": SCHEMA,
        "reference": compared.reference.name,
        "runs": [_side_data(side) for side in compared.sides],
        "different": list(compared.different),
        "comparisons": [
            {
                "run": pairing.name,
                "pairs": pairing.pairs,
                "strangers": pairing.strangers,
                **_COMPARISON.dump_python(pairing.comparison, mode="json"),
            }
            for pairing in compared.pairings
        ],
    }
    write_json(folder / COMPARE_FILE, data)


def _side_data(side: Side) -> dict[str, Any]:
    return {
        "name": side.name,
        "folder": str(side.run.path),
        "created_utc": side.run.info.created_utc,
        "facts": side.facts,
        **_AGGREGATE.dump_python(side.summary.quality, mode="json"),
        "stages": {
            stage.key: _stage_data(side.summary, stage.key) for stage in side.summary.shown_stages
        },
        "sha256": run_sha256(side.run.episodes),
    }


def _stage_data(summary: RunSummary, key: str) -> dict[str, Any]:
    """Return a stage's figures with their unit in their names."""
    data = asdict(summary.stages[key])
    return {"n": data.pop("n"), **{f"{name}_us": value for name, value in data.items()}}
