"""Parts that several studies are made of: keys, cells of text, fans, facts."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from airl_mav.flight.paired import Change, PairedComparison
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.statistics import Aggregate, Estimate, bootstrap_mean
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.percentiles import Summary
from airl_mav.report.document import Document, Facts, RunLink, Section, provenance_facts
from airl_mav.report.flights_above import Panel, flight_pictures
from airl_mav.report.arenas import arena_of
from airl_mav.report.measures import rate_with_interval, with_interval
from airl_mav.report.table import NONE, Column, TableView
from airl_mav.studies.findings import Findings
from airl_mav.studies.study import Flown, StudyConfig

AGGREGATE = TypeAdapter(Aggregate)
GAP = TypeAdapter(PairedComparison)
ESTIMATE = TypeAdapter(Estimate)

GAP_METRICS = (
    ("flight_time_s", "flight time"),
    ("distance_m", "distance"),
    ("energy_j", "energy, vehicle"),
)
"""Field of a `PairedComparison`, and its title."""


def slug(text: str) -> str:
    """Return words as part of a folder's name."""
    return re.sub(r"[^\w.]+", "-", text).strip("-")


def change(estimate: Estimate, unit: str) -> str:
    """Return a difference with its unit, then its 95 % interval in brackets."""
    if estimate.value is None:
        return NONE
    text = f"{estimate.value:+.1f} {unit}"
    if estimate.low is not None and estimate.high is not None:
        text += f" [{estimate.low:+.1f}, {estimate.high:+.1f}]"
    return text


def rate(estimate: Estimate) -> str:
    """Return a rate in percent with its interval."""
    return rate_with_interval(estimate)


def percent(value: float | None, digits: int = 1) -> str:
    """Return a figure of the paper that it may not have."""
    return NONE if value is None else f"{value:.{digits}f}"


def quality_of(flown: Flown) -> Aggregate:
    """Return a cell in figures."""
    return flown.quality


def t2_of(flown: Flown) -> Summary:
    """Return the latencies t2 of a cell's decisions [µs]."""
    return flown.t2


def metric(gap: PairedComparison, key: str) -> Change:
    """Return the difference of one metric."""
    found: Change = getattr(gap, key)
    return found


def findings_of(
    key: str,
    config: StudyConfig,
    flown: Mapping[str, Flown],
    *,
    title: str,
    question: str,
    answers: Sequence[str],
    sections: Sequence[Section],
    data: Mapping[str, Any],
    facts: Facts = (),
) -> Findings:
    """Return what a study found, with what all of them say of their flights."""
    first = next(iter(flown.values())).run.info
    document = Document(
        name="study",
        title=title,
        kicker="Study",
        lead=question,
        answers=tuple(answers),
        sections=tuple(sections),
        facts=(*facts_of(config, flown), *facts, ("command", shlex.join(["python", *sys.argv]))),
        runs=tuple(RunLink(f.cell.title, f.held.folder, None) for f in flown.values()),
        provenance=provenance_facts(first.machine, first.git, first.versions),
        footer="figures as data in study.json beside this page",
    )
    return Findings(key, document, data)


def facts_of(config: StudyConfig, flown: Mapping[str, Flown]) -> tuple[tuple[str, str], ...]:
    """Return what all cells of a study share."""
    first = next(iter(flown.values()))
    rules = dict.fromkeys(each.held.rules for each in flown.values())
    last = config.seed + config.episodes - 1
    return (
        ("study", config.description),
        ("level", config.level),
        ("vehicle", config.vehicle),
        ("episodes of a cell", f"{config.episodes:,}, seeds {config.seed} to {last}"),
        ("rules", "; ".join(rules)),
        ("between commands", first.run.info.setup.between_commands),
    )


# --- fans: many flights to one goal


def path_lengths(flown: Flown) -> Estimate:
    """Return the mean path length of the flights that reached the goal [m]."""
    return flown.quality.distance_m


def widest_aside(flown: Flown) -> Estimate:
    """Return how far aside of the straight line to the goal flights came, mean of each widest [m].

    Over all flights, whatever their end.
    """
    widths = [
        aside(flown.run.trajectories[e.index], e)
        for e in flown.run.episodes
        if e.index in flown.run.trajectories
    ]
    return bootstrap_mean(widths)


def aside(path: Trajectory, episode: EpisodeRecord) -> float:
    """Return the greatest distance of a path from the line through start and goal [m]."""
    start_us = episode.started_us if episode.navigation_us is None else episode.navigation_us
    part = path.between(start_us, episode.ended_us)
    goal = np.array(episode.goal)
    along = goal / np.linalg.norm(goal)
    across: NDArray[np.float64] = part.position[:, :2] @ np.array([-along[1], along[0]])
    return float(np.abs(across).max(initial=0.0))


def fan_gallery(prefix: str, title: str, fans: Sequence[tuple[str, Flown]]) -> Section:
    """Draw fans side by side on the same axes."""

    def panel(name: str, flown: Flown) -> Panel:
        success, length = quality_of(flown).success_rate, path_lengths(flown)
        told = "" if length.value is None else f", mean path {length.value:.1f} m"
        detail = f"{100.0 * (success.value or 0.0):.0f} % of {success.n} reached it{told}"
        run = flown.run
        arena = arena_of(run, run.episodes[0])
        return Panel(name, detail, run.episodes, run.trajectories, arena)

    return Section(
        title,
        3,
        draw=lambda: flight_pictures(prefix, [panel(*fan) for fan in fans]),
        sheet=f"{prefix}.png",
        note="The same arena, start and goal in every flight, all panels on the same axes; "
        "obstacles that move are drawn where they begin.",
        in_terminal=False,
    )


def fan_table(title: str, fans: Sequence[tuple[str, Flown]]) -> TableView:
    """Return how long and how wide the paths of fans are."""
    columns = (
        Column("flights of", number=False),
        Column("success", "%"),
        Column("path length", "m"),
        Column("flight time", "s"),
        Column("widest aside", "m"),
    )
    rows = tuple(
        (
            name,
            rate(quality_of(flown).success_rate),
            with_interval(path_lengths(flown), 2),
            with_interval(quality_of(flown).flight_time_s, 2),
            with_interval(widest_aside(flown), 2),
        )
        for name, flown in fans
    )
    counts = sorted({len(flown.run.episodes) for _, flown in fans})
    notes = (
        f"{' or '.join(f'{count:,}' for count in counts)} flights in each row. Length and time: "
        "means over those that reached the goal. Widest aside: greatest distance from the straight "
        "line between start and goal, mean over all flights.",
    )
    return TableView(slug(title), title, columns, rows, notes)


def fan_data(fans: Sequence[tuple[str, Flown]]) -> list[dict[str, object]]:
    """Return the figures of fans for `study.json`."""
    return [
        {
            "name": name,
            "folder": flown.held.folder,
            "flights": len(flown.run.episodes),
            "success_rate": ESTIMATE.dump_python(quality_of(flown).success_rate, mode="json"),
            "path_length_m": ESTIMATE.dump_python(path_lengths(flown), mode="json"),
            "widest_aside_m": ESTIMATE.dump_python(widest_aside(flown), mode="json"),
        }
        for name, flown in fans
    ]
