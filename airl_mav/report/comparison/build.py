"""Construction of a comparison from run folders, and the frame of its page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from airl_mav.core.errors import UsageError
from airl_mav.core.frames import Goal
from airl_mav.flight.episode_record import EpisodeRecord, run_sha256
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import aggregate, compare_pairs, pair_by_seed, percent_change
from airl_mav.latency.stages import ALL_STAGES, Samples, pool, stage_samples, summarize
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report import document, run_tables
from airl_mav.report.comparison import comparison_model
from airl_mav.report.comparison.comparison_model import Comparison

SHORT_NAME = 14
"""Maximum length of names that are used as marks."""

LONGEST_PART = 24
"""Maximum length of roles that are used as marks."""

UNCOMPARED = ("sha256 of the flights",)
"""Terms that always differ and explain no difference."""

MACHINE_TERMS = ("cpu", "os")
"""Entries of `run.json` about the machine that are shown in a comparison."""


def compare(
    runs: Mapping[str, LoadedRun],
    contrasts: Sequence[comparison_model.ContrastEntry] | None = None,
    *,
    kind: comparison_model.Kind = "compare",
    title: str = "",
    facts: Mapping[str, Any] | None = None,
    entries: Sequence[comparison_model.RunEntry] = (),
) -> comparison_model.Comparison:
    """Compare runs in the order of the tables; by default, each with the first."""
    if not runs:
        raise UsageError(f"no run here; accepted: a {kind} of one run or more")
    by_name = {entry.name: entry for entry in entries}
    given = [
        by_name.get(name) or comparison_model.RunEntry(name, str(run.path))
        for name, run in runs.items()
    ]
    for run in runs.values():
        if not run.episodes:
            raise UsageError(f"{run.path}: no flight was finished: nothing to compare")
    if contrasts is None:
        first = next(iter(runs))
        contrasts = [
            comparison_model.ContrastEntry(name, first, title=f"{name} against {first}")
            for name in runs
            if name != first
        ]
    marks = _marks(given)
    compared = tuple(_compared_run(entry, marks[entry.name], runs[entry.name]) for entry in given)
    figures = {run.name: run for run in compared}
    return comparison_model.Comparison(
        kind=kind,
        title=title,
        facts=dict(facts or {}),
        runs=compared,
        contrasts=tuple(_contrast(entry, runs, figures) for entry in contrasts),
    )


def tests_of(run: LoadedRun) -> list[EpisodeRecord]:
    """Return the valid flights."""
    return [episode for episode in run.episodes if not episode.invalid]


def samples_of(run: LoadedRun) -> dict[str, Samples]:
    """Return the durations of all stages [µs] in valid flights."""
    tests = tests_of(run)
    return pool(stage_samples(run.latency[e.index]) for e in tests if e.index in run.latency)


def letter(index: int) -> str:
    """Return the letters of an index: A to Z, then AA, AB and so on."""
    rest, last = divmod(index, 26)
    return ("" if not rest else letter(rest - 1)) + chr(ord("A") + last)


def _marks(entries: Sequence[comparison_model.RunEntry]) -> dict[str, str]:
    """Return the mark of each run: a short name, its role in the comparison, or a letter."""
    if all(len(entry.label or entry.name) <= SHORT_NAME for entry in entries):
        return {entry.name: entry.label or entry.name for entry in entries}
    parts = {entry.name: comparison_model.part_of(entry) for entry in entries}
    if all(entry.role for entry in entries) and max(map(len, parts.values())) <= LONGEST_PART:
        return parts
    counts: dict[str, int] = {}
    marks = {}
    for entry in entries:
        marks[entry.name] = letter(counts.get(entry.group, 0))
        counts[entry.group] = counts.get(entry.group, 0) + 1
    return marks


def _compared_run(
    entry: comparison_model.RunEntry, mark: str, run: LoadedRun
) -> comparison_model.ComparedRun:
    tests = tests_of(run)
    samples = samples_of(run)
    planned = len(run.info.seeds) if entry.planned is None else entry.planned
    return comparison_model.ComparedRun(
        entry=entry,
        mark=mark,
        setup=run.info.setup,
        planned=planned,
        flown=len(run.episodes),
        facts=_facts(run),
        quality=aggregate(run.episodes),
        stages={stage.key: summarize(samples[stage.key]) for stage in ALL_STAGES},
        slipped_us=sum(episode.slipped_us for episode in run.episodes),
        start=_navigation_start(run, tests),
        position_error_m=_position_error(run, tests),
        sha256=run_sha256(run.episodes) if len(run.episodes) == planned else None,
    )


def _contrast(
    entry: comparison_model.ContrastEntry,
    runs: Mapping[str, LoadedRun],
    figures: Mapping[str, comparison_model.ComparedRun],
) -> comparison_model.Contrast:
    reference, target = runs[entry.reference], runs[entry.target]
    flown = {episode.seed: _task(episode) for episode in reference.episodes}
    known = [episode for episode in target.episodes if episode.seed in flown]
    same = [episode for episode in known if _task(episode) == flown[episode.seed]]
    try:
        paired = compare_pairs(reference.episodes, same)
    except ValueError as error:
        raise UsageError(f"{reference.path} and {target.path}: {error}") from None
    early, late = (figures[name].stages["t2"].mean for name in (entry.reference, entry.target))
    return comparison_model.Contrast(
        entry=entry,
        paired=paired,
        unmatched=len(known) - len(same),
        t2_percent=percent_change(early, late) if early and late is not None else None,
    )


def _task(episode: EpisodeRecord) -> tuple[str, int, Goal]:
    """Return the task of a flight; equal for flights of one seed that form a pair."""
    return episode.arena, episode.arena_seed, episode.goal


def _facts(run: LoadedRun) -> dict[str, str]:
    facts = dict(run_tables.setup_rows(run))
    facts["flights"] = f"{len(tests_of(run)):,}"
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
    facts["flown on"] = ", ".join(
        f"{run.info.machine[key]}" for key in MACHINE_TERMS if run.info.machine.get(key)
    )
    return {term: text for term, text in facts.items() if text and term not in UNCOMPARED}


def _hold(config: Mapping[str, Any]) -> float | None:
    """Return the hold time [s] from the table in which the level stores it."""
    held = config.get("hold_s")
    if isinstance(held, (int, float)):
        return float(held)
    tables = (value for value in config.values() if isinstance(value, Mapping))
    return next((found for table in tables if (found := _hold(table)) is not None), None)


def _navigation_start(
    run: LoadedRun, tests: Sequence[EpisodeRecord]
) -> comparison_model.NavigationStart | None:
    rows = []
    energies: list[float] = []
    for episode in tests:
        path = run.trajectories.get(episode.index)
        if path is None or episode.navigation_us is None or episode.quality is None:
            continue
        at = path.between(episode.navigation_us, episode.navigation_us)
        if len(at):
            takeoff = episode.quality.takeoff
            (north, east, down), speed = at.position[0], at.speed()[0]
            leg = (takeoff.time_s, takeoff.distance_m)
            rows.append((*leg, float(np.hypot(north, east)), -down, speed))
            energies += [] if takeoff.energy_j is None else [takeoff.energy_j]
    if not rows:
        return None
    time_s, distance_m, *place = (float(mean) for mean in np.mean(rows, axis=0))
    energy_j = float(np.mean(energies)) if len(energies) == len(rows) else None
    return comparison_model.NavigationStart(len(rows), time_s, distance_m, energy_j, *place)


def _position_error(run: LoadedRun, tests: Sequence[EpisodeRecord]) -> float | None:
    errors = []
    for episode in tests:
        path = run.trajectories.get(episode.index)
        arrays = run.latency.get(episode.index, {})
        if path is None or episode.navigation_us is None or "estimate/time_us" not in arrays:
            continue
        times, believed = arrays["estimate/time_us"], arrays["estimate/position"]
        flown = (times >= episode.navigation_us) & (times <= episode.ended_us)
        if len(path) and flown.any():
            away = [
                believed[flown, axis]
                - np.interp(times[flown], path.time_us, path.position[:, axis])
                for axis in (0, 1)
            ]
            errors.append(float(np.hypot(*away).mean()))
    return float(np.mean(errors)) if errors else None


WORST = 6
"""Number of worst seeds listed."""

WIDEST = 3
"""Number of pairs with the largest differences listed."""


def worst_seeds(reference: Sequence[EpisodeRecord], target: Sequence[EpisodeRecord]) -> list[int]:
    """Return the worst seeds: half failures, half the slowest relative to the reference."""
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
    chosen = sorted(failed)[: max(WORST // 2, WORST - len(longest))]
    return [*chosen, *longest[: WORST - len(chosen)]]


def split_seeds(runs: Mapping[str, LoadedRun]) -> list[dict[str, Any]]:
    """Return `seed` and `outcomes` by run for seeds that only some runs completed."""
    flights: dict[int, dict[str, EpisodeRecord]] = {}
    for name, run in runs.items():
        for episode in tests_of(run):
            flights.setdefault(episode.seed, {})[name] = episode
    return [
        {"seed": seed, "outcomes": {name: f.outcome.value for name, f in flights[seed].items()}}
        for seed in sorted(flights)
        if len({f.outcome is Outcome.SUCCESS for f in flights[seed].values()}) > 1
    ]


def widest_seeds(reference: LoadedRun, level: LoadedRun) -> dict[str, Any] | None:
    """Return median and extreme time differences [%]; None below three common successes."""
    percent = {
        first.seed: 100.0 * (second.quality.flight_time_s / first.quality.flight_time_s - 1.0)
        for first, second in pair_by_seed(reference.episodes, level.episodes)
        if first.outcome is second.outcome is Outcome.SUCCESS and first.quality and second.quality
    }
    if len(percent) < WIDEST:
        return None
    widest = sorted(percent, key=lambda seed: -abs(percent[seed]))[:WIDEST]
    return {
        "median": median(percent.values()),
        "seeds": [{"seed": seed, "percent": percent[seed]} for seed in widest],
    }


def comparison_document(
    comparison: Comparison,
    runs: Mapping[str, LoadedRun],
    folder: Path,
    *,
    kicker: str,
    sections: Sequence[document.Section],
    facts: document.Facts,
    lead: str = "",
    facts_title: str = "What flew",
) -> document.Document:
    """Return the dated document of a comparison, with run links relative to `folder`."""
    first = comparison.runs[0]
    made = runs[first.name].info
    created = made.created_utc.replace("T", " ").replace("+00:00", " UTC")
    version = made.versions.get("airl-mav", "")
    several = len(comparison.groups) > 1
    return document.Document(
        name=comparison.kind,
        title=comparison.title,
        kicker=f"{kicker} · {created}",
        lead=lead,
        answers=comparison.answers,
        sections=tuple(sections),
        facts=facts,
        facts_title=facts_title,
        remarks=tuple(comparison.facts.get("remarks") or ()),
        runs=tuple(
            document.run_link(
                f"{Path(run.entry.group).stem}: {run.heading}" if several else run.heading,
                runs[run.name].path,
                folder,
            )
            for run in comparison.runs
        ),
        provenance=document.provenance_facts(made.machine, made.git, made.versions),
        configurations=((first.heading, json.dumps(made.config, indent=2, ensure_ascii=False)),),
        footer=(
            f"airl-mav {version} · machine, versions and configuration: those of {first.heading}; "
            f"figures as data in {comparison.kind}.json, tables in {comparison.kind}.md beside "
            "this page"
        ),
    )
