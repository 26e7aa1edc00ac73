"""What added latency costs: a policy at latencies that grow, on the same seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from pydantic import Field, model_validator

from airl_mav.cli.cells import Cell
from airl_mav.errors import UsageError
from airl_mav.flight.gap import HardwareGap, hardware_gap, relative_gap
from airl_mav.flight.paper import DEGRADATION, PaperFigures
from airl_mav.flight.statistics import Estimate
from airl_mav.policy.registry import find_policy
from airl_mav.report.curves import Series, curves_picture
from airl_mav.report.tables import US_PER_MS, Column, TableView
from airl_mav.studies.parts import (
    AGGREGATE,
    GAP,
    GAP_COLUMNS,
    GAP_METRICS,
    GAP_NOTE,
    facts_of,
    fan_data,
    fan_gallery,
    fan_table,
    gap_cells,
    made_of,
    metric,
    path_lengths,
    quality_of,
    rate,
    runs_of,
    signed,
    slug,
    t2_ms,
    t2_of,
    with_range,
)
from airl_mav.studies.sheet import Gallery, Section, Sheet
from airl_mav.studies.study import FanConfig, Flown, Study, StudyConfig

BASE = "base"
"""No latency added: 1 ms, as of a desktop computer."""

FEWEST = 10
"""Pairs from which on a step says something."""


class DegradationConfig(StudyConfig):
    """Latencies that are added to policies."""

    policies: tuple[str, ...] = Field(min_length=1, description="names, or paths to folders")
    also_if_there: tuple[str, ...] = Field(
        default=(), description="policies that are passed over where there are none"
    )
    arena: str = Field(default="static-obstacles", description="arena profile")
    latencies: tuple[str, ...] = Field(
        default=(BASE, "150ms", "300ms", "400ms", "950ms"),
        min_length=2,
        description="t2, growing, as --latency takes it; base: none added; first: the reference",
    )
    fan: FanConfig = Field(description="flights to one goal")

    @model_validator(mode="after")
    def _different(self) -> DegradationConfig:
        if len(set(self.latencies)) < len(self.latencies):
            raise ValueError("latencies: one twice; accepted: each once")
        return self

    def flown_policies(self) -> list[str]:
        """Return the policies, without those that are not there."""
        return [*self.policies, *(name for name in self.also_if_there if _there(name))]


@dataclass(frozen=True)
class Stair:
    """A policy at all latencies."""

    policy: str
    flown: tuple[Flown, ...]
    """In the order of the latencies, the reference first."""
    gaps: tuple[HardwareGap, ...]
    """Of every latency but the first against the first."""
    steps: tuple[HardwareGap, ...]
    """Of every latency but the first against the one before it."""


def cells(config: DegradationConfig, _root: Path) -> list[Cell]:
    """Return every policy at every latency, and its flights to one goal."""
    planned = []
    for policy in config.flown_policies():
        for latency in config.latencies:
            given = None if latency == BASE else latency
            planned += [
                Cell(
                    _key(policy, latency),
                    f"{Path(policy).name} at {latency}",
                    config.command(policy, config.arena, latency=given),
                ),
                Cell(
                    _fan_key(policy, latency),
                    f"{Path(policy).name} at {latency}, one goal",
                    config.command(
                        policy,
                        config.arena,
                        latency=given,
                        episodes=config.fan.flights,
                        arena_seed=config.fan.arena_seed,
                    ),
                ),
            ]
    return planned


def _there(policy: str) -> bool:
    try:
        find_policy(policy)
    except UsageError:
        return False
    return True


def _key(policy: str, latency: str) -> str:
    return slug(f"{Path(policy).name}-{latency}")


def _fan_key(policy: str, latency: str) -> str:
    return f"{_key(policy, latency)}-one-goal"


def sheet(config: DegradationConfig, flown: Mapping[str, Flown]) -> Sheet:
    """Say what latency costs."""
    stairs = [_stair(config, policy, flown) for policy in config.flown_policies()]
    fans = {
        Path(policy).name: [
            (_latency_name(latency), flown[_fan_key(policy, latency)])
            for latency in config.latencies
        ]
        for policy in config.flown_policies()
    }
    sections = [_curves_section(stairs)]
    for stair in stairs:
        sections.append(
            Section(
                stair.policy,
                (
                    _own_table(config, stair),
                    _gap_table(config, stair),
                    _step_table(config, stair),
                    fan_table(f"{stair.policy}: flights to one goal", fans[stair.policy]),
                ),
                (
                    fan_gallery(
                        f"fan-{slug(stair.policy)}",
                        f"{stair.policy}: {config.fan.flights} flights to one goal",
                        fans[stair.policy],
                    ),
                ),
            )
        )
    return Sheet(
        key="degradation",
        title="Degradation by latency",
        question="How much worse does a policy fly as its decisions come later?",
        answers=tuple(
            line
            for stair in stairs
            for line in (
                *_in_words(config, stair),
                _fan_in_words(stair.policy, fans[stair.policy]),
            )
        ),
        sections=tuple(sections),
        facts=(*facts_of(config, flown), ("arena", config.arena)),
        runs=runs_of(flown),
        data={
            "arena": config.arena,
            "latencies": list(config.latencies),
            "policies": [_data(config, stair) for stair in stairs],
            "one_goal": {name: fan_data(each) for name, each in fans.items()},
        },
        provenance=made_of(flown),
    )


def _stair(config: DegradationConfig, policy: str, flown: Mapping[str, Flown]) -> Stair:
    held = tuple(flown[_key(policy, latency)] for latency in config.latencies)
    first = held[0].run.episodes
    return Stair(
        Path(policy).name,
        held,
        tuple(hardware_gap(first, each.run.episodes) for each in held[1:]),
        tuple(hardware_gap(a.run.episodes, b.run.episodes) for a, b in pairwise(held)),
    )


def _latency_name(latency: str) -> str:
    return latency if latency == BASE else latency.replace("ms", " ms")


def _own_table(config: DegradationConfig, stair: Stair) -> TableView:
    """Return every latency by itself."""
    columns = (
        Column("latency", number=False),
        Column("t2", "ms"),
        Column("success", "%"),
        Column("flight time", "s"),
        Column("distance", "m"),
        Column("energy", "kJ"),
    )
    rows = []
    for latency, each in zip(config.latencies, stair.flown, strict=True):
        q = quality_of(each)
        rows.append(
            (
                _latency_name(latency),
                t2_ms(each),
                rate(q.success_rate),
                with_range(q.flight_time_s, 1.0, 2),
                with_range(q.distance_m, 1.0, 2),
                with_range(q.energy_j, 1e-3, 2),
            )
        )
    notes = (
        "Means over the flights that reached the goal at that latency, 95 % intervals in brackets.",
    )
    title = f"{stair.policy} by latency"
    return TableView(slug(title), title, columns, tuple(rows), notes)


def _gap_table(config: DegradationConfig, stair: Stair) -> TableView:
    """Return every latency against the first."""
    base = config.latencies[0]
    columns = (Column(f"against {base}", number=False), *GAP_COLUMNS)
    rows = tuple(
        (_latency_name(latency), *gap_cells(gap))
        for latency, gap in zip(config.latencies[1:], stair.gaps, strict=True)
    )
    title = f"{stair.policy}: against {base}"
    return TableView(slug(title), title, columns, rows, (GAP_NOTE,))


def _paper_table() -> TableView:
    """Return the paper's table, with its gaps worked out as ours."""
    columns = (
        Column("the paper", number=False),
        Column("flight time", "s"),
        Column("distance", "m"),
        Column("energy", "kJ"),
        Column("time", "%"),
        Column("distance", "%"),
        Column("energy", "%"),
    )
    rows = tuple(
        (
            f"{each.latency_ms:g} ms",
            f"{each.flight_time_s:.2f}",
            f"{each.distance_m:.2f}",
            f"{each.energy_kj:.2f}",
            *(signed(_paper_point(each, number)) for number in range(len(GAP_METRICS))),
        )
        for each in DEGRADATION
    )
    notes = (
        "Section VI.C: its Static Obstacles policy on a Core i9 slowed by sleep; percent: against "
        "its base of 11 ms, worked out from its figures. It gives no success rates.",
    )
    return TableView("the-paper", "The paper's degradation table", columns, rows, notes)


def _step_table(config: DegradationConfig, stair: Stair) -> TableView:
    """Return every latency against the one before it."""
    columns = (Column("step", number=False), *GAP_COLUMNS)
    rows = tuple(
        (f"{_latency_name(a)} → {_latency_name(b)}", *gap_cells(gap))
        for (a, b), gap in zip(pairwise(config.latencies), stair.steps, strict=True)
    )
    title = f"{stair.policy}: step by step"
    return TableView(slug(title), title, columns, rows, (GAP_NOTE,))


def _in_words(config: DegradationConfig, stair: Stair) -> list[str]:
    """Return whether every step costs more, and how much all of them."""
    lines = []
    for key, title in GAP_METRICS:
        lines.append(f"{stair.policy}, {title}: {_monotone(config, stair, key)}")
    rates = [100.0 * (quality_of(each).success_rate.value or 0.0) for each in stair.flown]
    told = ", ".join(f"{value:.1f}" for value in rates)
    lines.append(f"{stair.policy}, success {_rises(config, stair)}: {told} %.")
    return lines


def _rises(config: DegradationConfig, stair: Stair) -> str:
    """Return in words whether the success rate rises at any step."""
    steps = [
        (f"{a} → {b}", gap.success_rate.difference)
        for (a, b), gap in zip(pairwise(config.latencies), stair.steps, strict=True)
    ]
    sure = [name for name, d in steps if d.low is not None and d.low > 0.0]
    if sure:
        return f"not monotone, it rises at {', '.join(sure)}"
    rises = any(d.value is not None and d.value > 0.0 for _, d in steps)
    return "rises nowhere beyond chance" if rises else "never rises"


def _fan_in_words(policy: str, fans: Sequence[tuple[str, Flown]]) -> str:
    """Return the path lengths of the flights to one goal."""
    lengths = [(name, path_lengths(flown)) for name, flown in fans]
    told = ", ".join(
        f"{name} {'none reached it' if e.value is None else f'{e.value:.1f} m'}"
        for name, e in lengths
    )
    return f"{policy}, mean path to one goal: {told}."


def _monotone(config: DegradationConfig, stair: Stair, key: str) -> str:
    """Return in words whether a metric grows with every step."""
    steps = [
        (f"{a} → {b}", metric(gap, key).change.difference)
        for (a, b), gap in zip(pairwise(config.latencies), stair.steps, strict=True)
    ]
    known = [(name, d) for name, d in steps if d.value is not None and d.n >= FEWEST]
    short = [name for name, d in steps if d.value is None or d.n < FEWEST]
    told = ", ".join(f"{d.value:+.1f} % ({name})" for name, d in known)
    if not known:
        return f"fewer than {FEWEST} pairs at every step."
    down = [name for name, d in known if (d.value or 0.0) <= 0.0]
    sure = all(d.low is not None and d.low > 0.0 for _, d in known)
    if down:
        verdict = f"not monotone, it falls at {', '.join(down)}"
    else:
        verdict = "monotone, every step's interval above zero" if sure else "monotone"
    rest = f" Fewer than {FEWEST} pairs: {', '.join(short)}." if short else ""
    return f"{verdict}: {told}.{rest}"


def _curves_section(stairs: Sequence[Stair]) -> Section:
    """Return success and gaps over latency."""
    x_label = "mean t2 [ms]"
    pictures = [
        curves_picture(
            "degradation-success",
            "success rate",
            (x_label, "%"),
            [
                Series(
                    s.policy,
                    [(_x(e), _scaled(quality_of(e).success_rate, 100.0)) for e in s.flown],
                )
                for s in stairs
            ],
        )
    ]
    for number, (key, title) in enumerate(GAP_METRICS):
        series = [
            Series(
                s.policy,
                [
                    (_x(s.flown[0]), Estimate(0.0, None, None, 0)),
                    *(
                        (_x(e), metric(gap, key).change.difference)
                        for e, gap in zip(s.flown[1:], s.gaps, strict=True)
                    ),
                ],
            )
            for s in stairs
        ]
        paper = [(p.latency_ms, _paper_point(p, number)) for p in DEGRADATION]
        pictures.append(
            curves_picture(
                f"degradation-{slug(title)}",
                f"{title}, against the first",
                (x_label, "%"),
                series,
                paper,
            )
        )
    note = "On the common successes with the first latency, 95 % intervals."
    return Section(
        "Over latency", (_paper_table(),), (Gallery("Success and losses", tuple(pictures), note),)
    )


def _paper_point(paper: PaperFigures, number: int) -> float:
    """Return the paper's loss of time, distance or energy at a latency [%]."""
    base = DEGRADATION[0]
    pairs = (
        (base.flight_time_s, paper.flight_time_s),
        (base.distance_m, paper.distance_m),
        (base.energy_kj, paper.energy_kj),
    )
    return relative_gap(*pairs[number])


def _x(flown: Flown) -> float:
    return (t2_of(flown).mean or 0.0) / US_PER_MS


def _scaled(e: Estimate, factor: float) -> Estimate:
    def times(value: float | None) -> float | None:
        return None if value is None else factor * value

    return Estimate(times(e.value), times(e.low), times(e.high), e.n)


def _data(config: DegradationConfig, stair: Stair) -> dict[str, object]:
    return {
        "policy": stair.policy,
        "cells": [
            {
                "latency": latency,
                "folder": each.held.folder,
                "t2_mean_us": t2_of(each).mean,
                **AGGREGATE.dump_python(quality_of(each), mode="json"),
            }
            for latency, each in zip(config.latencies, stair.flown, strict=True)
        ],
        "against_first": [GAP.dump_python(gap, mode="json") for gap in stair.gaps],
        "steps": [GAP.dump_python(gap, mode="json") for gap in stair.steps],
    }


DEGRADATION_STUDY = Study(
    key="degradation",
    model=DegradationConfig,
    cells=cells,
    sheet=sheet,
    quick={"episodes": 40, "fan": {"flights": 12}},
)
