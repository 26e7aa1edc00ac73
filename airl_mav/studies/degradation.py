"""What added latency costs: a policy at latencies that grow, on the same seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from pydantic import Field, model_validator

from airl_mav.cli.cells import Cell
from airl_mav.core.errors import UsageError
from airl_mav.flight.gap import hardware_gap, relative_gap
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
from airl_mav.studies.stair import BASE, Stair, fan_in_words, in_words, latency_name
from airl_mav.studies.study import FanConfig, Flown, Study, StudyConfig


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
            (latency_name(latency), flown[_fan_key(policy, latency)])
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
                *in_words(stair),
                fan_in_words(stair.policy, fans[stair.policy]),
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
        config.latencies,
        held,
        tuple(hardware_gap(first, each.run.episodes) for each in held[1:]),
        tuple(hardware_gap(a.run.episodes, b.run.episodes) for a, b in pairwise(held)),
    )


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
                latency_name(latency),
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
        (latency_name(latency), *gap_cells(gap))
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
        (f"{latency_name(a)} → {latency_name(b)}", *gap_cells(gap))
        for (a, b), gap in zip(pairwise(config.latencies), stair.steps, strict=True)
    )
    title = f"{stair.policy}: step by step"
    return TableView(slug(title), title, columns, rows, (GAP_NOTE,))


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
