"""The same policy and seeds at several levels of the fidelity ladder: what differs between them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from airl_mav.core.files import read_typed, write_json
from airl_mav.flight.judge import Outcome
from airl_mav.flight.paired import Comparison, compare
from airl_mav.flight.record import EpisodeRecord, run_sha256
from airl_mav.flight.statistics import Aggregate, aggregate
from airl_mav.latency.percentiles import Summary, summarize
from airl_mav.latency.stages import ALL_STAGES, pool, stage_samples
from airl_mav.rehearsal.run_folder import LoadedRun, RunInfo, load

SCHEMA = 1
"""Version of `ladder.json`; docs/run-folder.md describes it."""

LADDER_FILE = "ladder.json"


@dataclass(frozen=True)
class Start:
    """Where navigation begins: means over the flights in which it did."""

    n: int
    """Number of those flights."""
    takeoff_s: float
    """Time from the reset to the start of navigation [s]; 0: the level begins in a hover."""
    takeoff_distance_m: float
    takeoff_energy_j: float
    aside_m: float
    """Distance from the vehicle's place at the reset, seen from above [m]."""
    height_m: float
    speed_m_s: float


@dataclass(frozen=True)
class Level:
    """What was flown at one level."""

    name: str
    folders: tuple[str, ...]
    """Run folders inside that of the ladder; more than one where a run was interrupted."""
    planned: int
    """Number of episodes asked for."""
    t2: str
    """Where t2 comes from, in words."""
    speed: float | None
    """Simulated seconds per wall second; None where time was not paced."""
    slipped_us: int
    """Simulated time given up because the host could not keep pace [µs]."""
    episodes: tuple[EpisodeRecord, ...]
    quality: Aggregate
    stages: dict[str, Summary]
    """Durations of the stages of a decision by stage key [µs]."""
    start: Start | None
    """None when navigation never began."""
    position_error_m: float | None
    """Mean distance, seen from above, between where the autopilot believed to be and where it was,
    from the start of navigation to the verdict [m]; None where no estimate is recorded."""
    sha256: str | None
    """Fingerprint of all flights; None where flights are never the same, or not all are there."""


@dataclass(frozen=True)
class Ladder:
    """All levels, and each one against the first."""

    path: Path
    facts: dict[str, Any]
    """What all levels share: policy, arena, vehicle, computer, workload, seed, rules."""
    levels: tuple[Level, ...]
    comparisons: tuple[Comparison, ...]
    """Of the second level and those after it with the first, the reference."""
    made: RunInfo
    """Of the reference: machine, commit and versions."""

    @property
    def reference(self) -> Level:
        """The level that the others are compared with."""
        return self.levels[0]

    def split(self) -> tuple[tuple[int, dict[str, EpisodeRecord]], ...]:
        """Return the seeds of which not all flights reached the goal, but one did.

        Returns:
            Each seed with its flights by level; aborted ones are left out.
        """
        flights: dict[int, dict[str, EpisodeRecord]] = {}
        for level in self.levels:
            for episode in level.episodes:
                if episode.outcome is not Outcome.ABORTED:
                    flights.setdefault(episode.seed, {})[level.name] = episode
        return tuple(
            (seed, flights[seed])
            for seed in sorted(flights)
            if len({f.outcome is Outcome.SUCCESS for f in flights[seed].values()}) > 1
        )


@dataclass(frozen=True)
class Held:
    """Where a level's flights lie."""

    name: str
    folders: tuple[str, ...]
    planned: int


@dataclass(frozen=True)
class _HeldLadder:
    """What `ladder.json` is read for: everything else of it is worked out from the runs."""

    facts: dict[str, Any]
    levels: tuple[Held, ...]


_HELD = TypeAdapter(_HeldLadder)
_COMPARISON = TypeAdapter(Comparison)
_AGGREGATE = TypeAdapter(Aggregate)
_START = TypeAdapter(Start)


def build_ladder(path: Path, facts: Mapping[str, Any], held: Sequence[Held]) -> Ladder:
    """Work out a ladder from its run folders.

    Args:
        path: Folder of the ladder.
        facts: What all levels share.
        held: The levels, two or more, the reference first.

    Raises:
        UsageError: A folder holds no run, or a file of it cannot be read.
    """
    runs = [[load(path / folder) for folder in level.folders] for level in held]
    levels = tuple(_level(*level) for level in zip(held, runs, strict=True))
    return Ladder(
        path=path,
        facts=dict(facts),
        levels=levels,
        comparisons=tuple(compare(levels[0].episodes, level.episodes) for level in levels[1:]),
        made=runs[0][0].info,
    )


def _level(held: Held, runs: Sequence[LoadedRun]) -> Level:
    """Work out what was flown at one level."""
    # A flight that was aborted is flown again in the next folder.
    episodes = {episode.seed: episode for run in runs for episode in run.episodes}
    samples = pool(
        stage_samples(run.latency[episode.index])
        for run in runs
        for episode in _tests(run)
        if episode.index in run.latency
    )
    setup = runs[0].info.setup
    return Level(
        name=held.name,
        folders=held.folders,
        planned=held.planned,
        t2=setup.injection.label,
        speed=setup.speed,
        slipped_us=sum(episode.slipped_us for episode in episodes.values()),
        episodes=tuple(episodes[seed] for seed in sorted(episodes)),
        quality=aggregate(list(episodes.values())),
        stages={stage.key: summarize(samples[stage.key]) for stage in ALL_STAGES},
        start=_start(runs),
        position_error_m=_mean(_position_errors(runs)),
        sha256=run_sha256(runs[0].episodes) if len(runs[0].episodes) == held.planned else None,
    )


def _tests(run: LoadedRun) -> list[EpisodeRecord]:
    """Return the episodes that say something of the level: all but aborted ones."""
    return [episode for episode in run.episodes if episode.outcome is not Outcome.ABORTED]


def _start(runs: Sequence[LoadedRun]) -> Start | None:
    """Return where navigation begins."""
    rows = []
    for run in runs:
        for episode in _tests(run):
            path = run.trajectories.get(episode.index)
            if path is None or episode.navigation_us is None or episode.quality is None:
                continue
            at = path.between(episode.navigation_us, episode.navigation_us)
            if len(at):
                takeoff = episode.quality.takeoff
                (north, east, down), speed = at.position[0], at.speed()[0]
                aside = float(np.hypot(north, east))
                rows.append(
                    (takeoff.time_s, takeoff.distance_m, takeoff.energy_j, aside, -down, speed)
                )
    return Start(len(rows), *(float(mean) for mean in np.mean(rows, axis=0))) if rows else None


def _position_errors(runs: Iterable[LoadedRun]) -> list[float]:
    """Return the mean error of the estimated position in each flight that has one [m]."""
    errors = []
    for run in runs:
        for episode in _tests(run):
            path = run.trajectories.get(episode.index)
            arrays = run.latency.get(episode.index, {})
            if path is None or episode.navigation_us is None or "estimate/time_us" not in arrays:
                continue
            times, believed = arrays["estimate/time_us"], arrays["estimate/position"]
            flown = (times >= episode.navigation_us) & (times <= episode.ended_us)
            if not len(path) or not flown.any():
                continue
            away = [
                believed[flown, axis]
                - np.interp(times[flown], path.time_us, path.position[:, axis])
                for axis in (0, 1)
            ]
            errors.append(float(np.hypot(*away).mean()))
    return errors


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def write_ladder(ladder: Ladder) -> None:
    """Write `ladder.json`, whole or not at all."""
    data = {
        "schema": SCHEMA,
        "facts": ladder.facts,
        "reference": ladder.reference.name,
        "levels": [_level_data(level) for level in ladder.levels],
        "comparisons": [
            {"level": level.name, **_COMPARISON.dump_python(comparison, mode="json")}
            for level, comparison in zip(ladder.levels[1:], ladder.comparisons, strict=True)
        ],
        "split": [
            {"seed": seed, "outcomes": {name: f.outcome.value for name, f in flights.items()}}
            for seed, flights in ladder.split()
        ],
    }
    write_json(ladder.path / LADDER_FILE, data)


def _level_data(level: Level) -> dict[str, Any]:
    return {
        "name": level.name,
        "folders": list(level.folders),
        "planned": level.planned,
        "flown": len(level.episodes),
        "t2": level.t2,
        "speed": level.speed,
        "slipped_us": level.slipped_us,
        **_AGGREGATE.dump_python(level.quality, mode="json"),
        "stages": {
            key: {"n": summary.n, "mean_us": summary.mean} for key, summary in level.stages.items()
        },
        "start": None if level.start is None else _START.dump_python(level.start, mode="json"),
        "position_error_m": level.position_error_m,
        "sha256": level.sha256,
    }


def read_ladder(path: Path) -> Ladder:
    """Work out a ladder again from its folder.

    Raises:
        UsageError: The folder holds none, or its runs cannot be read.
    """
    held = read_typed(path / LADDER_FILE, _HELD, SCHEMA, "ladder")
    return build_ladder(path, held.facts, held.levels)
