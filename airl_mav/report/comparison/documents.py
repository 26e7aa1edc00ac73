"""Common parts of the documents of all kinds of comparison."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from airl_mav.flight.judge import Outcome
from airl_mav.flight.paired import pair_by_seed
from airl_mav.flight.record import EpisodeRecord
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.comparison.build import tests_of
from airl_mav.report.comparison.model import Comparison
from airl_mav.report.document import Document, Facts, Section, provenance_facts, run_link

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
    sections: Sequence[Section],
    facts: Facts,
    lead: str = "",
    facts_title: str = "What flew",
) -> Document:
    """Return the dated document of a comparison, with run links relative to `folder`."""
    first = comparison.runs[0]
    made = runs[first.name].info
    created = made.created_utc.replace("T", " ").replace("+00:00", " UTC")
    version = made.versions.get("airl-mav", "")
    several = len(comparison.groups) > 1
    return Document(
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
            run_link(
                f"{Path(run.entry.group).stem}: {run.heading}" if several else run.heading,
                runs[run.name].path,
                folder,
            )
            for run in comparison.runs
        ),
        provenance=provenance_facts(made.machine, made.git, made.versions),
        configurations=((first.heading, json.dumps(made.config, indent=2, ensure_ascii=False)),),
        footer=(
            f"airl-mav {version} · machine, versions and configuration: those of {first.heading}; "
            f"figures as data in {comparison.kind}.json, tables in {comparison.kind}.md beside "
            "this page"
        ),
    )
