"""Parts that several studies are made of: keys, cells of text, fans, facts."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from airl_mav.flight.gap import HardwareGap, MetricGap
from airl_mav.flight.paired import Change
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.statistics import Aggregate, Estimate, bootstrap_mean
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.percentiles import Summary
from airl_mav.report.compare.page import first_arena
from airl_mav.report.fan import Panel, fan_pictures, fan_sheet
from airl_mav.report.html import provenance
from airl_mav.report.tables import NONE, Column, TableView, ms, rate_digits
from airl_mav.studies.sheet import Gallery
from airl_mav.studies.study import Flown, StudyConfig

AGGREGATE = TypeAdapter(Aggregate)
GAP = TypeAdapter(HardwareGap)
ESTIMATE = TypeAdapter(Estimate)

GAP_METRICS = (
    ("flight_time_s", "flight time"),
    ("distance_m", "distance"),
    ("energy_j", "energy, vehicle"),
)
"""Field of a `HardwareGap`, and its title."""


def slug(text: str) -> str:
    """Return words as part of a folder's name."""
    return re.sub(r"[^\w.]+", "-", text).strip("-")


def signed(value: float | None, digits: int = 1) -> str:
    """Return a difference with its sign."""
    return NONE if value is None else f"{value:+.{digits}f}"


def with_range(estimate: Estimate, scale: float = 1.0, digits: int = 1, sign: str = "") -> str:
    """Return a figure with its 95 % interval in brackets."""
    if estimate.value is None:
        return NONE
    text = f"{scale * estimate.value:{sign}.{digits}f}"
    if estimate.low is not None and estimate.high is not None:
        low, high = scale * estimate.low, scale * estimate.high
        text += f" [{low:{sign}.{digits}f}, {high:{sign}.{digits}f}]"
    return text


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
    return with_range(estimate, 100.0, rate_digits(estimate))


def percent(value: float | None, digits: int = 1) -> str:
    """Return a figure of the paper that it may not have."""
    return NONE if value is None else f"{value:.{digits}f}"


def quality_of(flown: Flown) -> Aggregate:
    """Return a cell in figures."""
    return flown.quality


def t2_of(flown: Flown) -> Summary:
    """Return the latencies t2 of a cell's decisions [µs]."""
    return flown.t2


def t2_ms(flown: Flown) -> str:
    """Return the mean latency t2 of a cell's decisions in ms."""
    return ms(t2_of(flown).mean, 0)


def metric(gap: HardwareGap, key: str) -> MetricGap:
    """Return the gap of one metric."""
    found: MetricGap = getattr(gap, key)
    return found


def gap_cells(gap: HardwareGap) -> tuple[str, ...]:
    """Return a gap as cells: success, time, distance, energy, and its number of pairs."""
    changes: list[Change] = [metric(gap, key).change for key, _ in GAP_METRICS]
    return (
        with_range(gap.success_rate.difference, 1.0, 1, "+"),
        *(with_range(change.difference, 1.0, 1, "+") for change in changes),
        f"{changes[0].difference.n:,}",
    )


GAP_COLUMNS = (
    Column("success", "points"),
    Column("flight time", "%"),
    Column("distance", "%"),
    Column("energy", "%"),
    Column("pairs"),
)
"""Heads of `gap_cells`."""

GAP_NOTE = (
    "Differences on the same seeds, 95 % intervals in brackets; time, distance and energy over the "
    "common successes, whose number is that of the pairs."
)


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


def runs_of(flown: Mapping[str, Flown]) -> tuple[tuple[str, str], ...]:
    """Return title and folder of every cell."""
    return tuple((each.cell.title, each.held.folder) for each in flown.values())


def made_of(flown: Mapping[str, Flown]) -> list[tuple[str, str]]:
    """Return machine and versions of the first cell."""
    return provenance(next(iter(flown.values())).run.info)


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


def fan_gallery(prefix: str, title: str, fans: Sequence[tuple[str, Flown]]) -> Gallery:
    """Draw fans side by side on the same axes."""
    panels = []
    for name, flown in fans:
        success = quality_of(flown).success_rate
        length = path_lengths(flown)
        told = "" if length.value is None else f", mean path {length.value:.1f} m"
        panels.append(
            Panel(
                title=name,
                detail=f"{100.0 * (success.value or 0.0):.0f} % of {success.n} reached it{told}",
                episodes=flown.run.episodes,
                paths=flown.run.trajectories,
                arena=first_arena(flown.run),
            )
        )
    return Gallery(
        title,
        tuple(fan_pictures(prefix, panels)),
        "The same arena, start and goal in every flight, all panels on the same axes; obstacles "
        "that move are drawn where they begin.",
        (f"{prefix}.png", fan_sheet(panels)),
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
            with_range(path_lengths(flown), 1.0, 2),
            with_range(quality_of(flown).flight_time_s, 1.0, 2),
            with_range(widest_aside(flown), 1.0, 2),
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
