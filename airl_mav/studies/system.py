"""The same policy on a workstation and on an onboard computer, in several arenas."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import Field, model_validator

from airl_mav.cli.cells import Cell
from airl_mav.core.fields import ProfileModel
from airl_mav.flight.paired import PairedComparison, compare_pairs, percent_change
from airl_mav.profiles.published import PublishedRun, PublishedTable, load_published, published_gap
from airl_mav.report.comparison.tables import signed
from airl_mav.report.document import Section
from airl_mav.report.measures import with_interval
from airl_mav.report.table import NONE, Column, TableView
from airl_mav.studies.findings import Findings
from airl_mav.studies.parts import (
    AGGREGATE,
    GAP,
    GAP_METRICS,
    change,
    fan_data,
    fan_gallery,
    fan_table,
    findings_of,
    metric,
    percent,
    quality_of,
    rate,
    slug,
    t2_of,
)
from airl_mav.studies.study import FanConfig, Flown, Study, StudyConfig


class ArenaConfig(ProfileModel):
    """A policy in an arena, and the network whose latency it flies with."""

    arena: str = Field(description="arena profile")
    policy: str = Field(description="a name, or a path to a folder")
    workload: str = Field(description="workload of both computers")
    fan: FanConfig = Field(description="flights to one goal")

    @property
    def name(self) -> str:
        """Name of the arena without its path."""
        return Path(self.arena).stem


class SystemConfig(StudyConfig):
    """Two computers, several arenas."""

    reference: str = Field(default="workstation", description="computer that is the reference")
    target: str = Field(default="ras-pi-4", description="onboard computer")
    arenas: tuple[ArenaConfig, ...] = Field(min_length=1, description="what flies where")

    @model_validator(mode="after")
    def _different(self) -> SystemConfig:
        if len({each.name for each in self.arenas}) < len(self.arenas):
            raise ValueError("arenas: one twice; accepted: each once")
        if self.reference == self.target:
            raise ValueError(f"target = {self.target!r}: accepted: another than the reference")
        return self

    @property
    def computers(self) -> tuple[str, str]:
        """Reference and target."""
        return self.reference, self.target


def cells(config: SystemConfig, _root: Path) -> list[Cell]:
    """Return every arena on both computers, and its flights to one goal."""
    planned = []
    for each in config.arenas:
        for computer in config.computers:
            name = Path(computer).stem
            options = {"computer": computer, "workload": each.workload}
            planned += [
                Cell(
                    _key(each, computer),
                    f"{Path(each.policy).name} in {each.name} on {name}",
                    config.command(each.policy, each.arena, **options),
                ),
                Cell(
                    _fan_key(each, computer),
                    f"{Path(each.policy).name} in {each.name} on {name}, one goal",
                    config.command(
                        each.policy,
                        each.arena,
                        episodes=each.fan.flights,
                        arena_seed=each.fan.arena_seed,
                        **options,
                    ),
                ),
            ]
    return planned


def _key(each: ArenaConfig, computer: str) -> str:
    return slug(f"{each.name}-{Path(computer).stem}")


def _fan_key(each: ArenaConfig, computer: str) -> str:
    return f"{_key(each, computer)}-one-goal"


def findings(config: SystemConfig, flown: Mapping[str, Flown]) -> Findings:
    """Say what the onboard computer costs in each arena."""
    sections, answers, data = [], [], []
    for each in config.arenas:
        first, second = (flown[_key(each, computer)] for computer in config.computers)
        gap = compare_pairs(first.run.episodes, second.run.episodes)
        paper = _published(each.name)
        fans = [(Path(c).stem, flown[_fan_key(each, c)]) for c in config.computers]
        tables = [_table(config, each, first, second, gap)]
        if paper is not None:
            tables.append(_paper_table(paper))
        title = f"{each.name}: {each.fan.flights} flights to one goal"
        sections += [
            Section(
                each.name,
                tables=(*tables, fan_table(f"{each.name}: flights to one goal", fans)),
            ),
            fan_gallery(f"fan-{slug(each.name)}", title, fans),
        ]
        answers.append(_answer(each, first, second, gap, paper))
        data.append(
            {
                "arena": each.arena,
                "policy": each.policy,
                "workload": each.workload,
                "reference": AGGREGATE.dump_python(quality_of(first), mode="json"),
                "target": AGGREGATE.dump_python(quality_of(second), mode="json"),
                "t2_mean_us": [t2_of(first).mean, t2_of(second).mean],
                "gap": GAP.dump_python(gap, mode="json"),
                "one_goal": fan_data(fans),
            }
        )
    return findings_of(
        "system",
        config,
        flown,
        title="System evaluation",
        question="What does each arena's policy lose on the onboard computer?",
        answers=answers,
        sections=sections,
        facts=(("computers", f"{config.reference} (the reference), {config.target}"),),
        data={"reference": config.reference, "target": config.target, "arenas": data},
    )


def _published(arena: str) -> PublishedTable | None:
    """Return the published system evaluation in an arena, if there is one."""
    tables = load_published().tables
    return next((t for t in tables if t.arena == arena and t.title.startswith("system")), None)


def _columns(paper: PublishedTable) -> tuple[PublishedRun, PublishedRun]:
    """Return the columns of reference and target."""
    return paper.columns["reference"], paper.columns["target"]


def _table(
    config: SystemConfig, each: ArenaConfig, first: Flown, second: Flown, gap: PairedComparison
) -> TableView:
    """Return both computers side by side, each by itself, and the gap on the same seeds."""
    reference, target = (Path(computer).stem for computer in config.computers)
    columns = (
        Column("measure", number=False),
        Column(reference),
        Column(target),
        Column("gap on the same seeds"),
        Column("pairs"),
    )
    a, b = quality_of(first), quality_of(second)
    t2 = t2_of(first).mean, t2_of(second).mean
    slower = NONE if not t2[0] or t2[1] is None else f"{percent_change(t2[0], t2[1]):+,.0f} %"
    success = gap.success_rate.difference
    rows = [
        ("mean t2 [ms]", *(NONE if x is None else f"{x / 1e3:.1f}" for x in t2), slower, NONE),
        (
            "success [%]",
            rate(a.success_rate),
            rate(b.success_rate),
            change(success, "points"),
            f"{success.n:,}",
        ),
    ]
    for key, title, unit, scale in (
        ("flight_time_s", "flight time", "s", 1.0),
        ("distance_m", "distance", "m", 1.0),
        ("energy_j", "energy, vehicle", "kJ", 1e-3),
        ("computer_energy_j", "energy, computer", "kJ", 1e-3),
        ("total_energy_j", "energy, both", "kJ", 1e-3),
    ):
        both = metric(gap, key)
        own = (
            (with_interval(getattr(q, key).scaled(scale), 2) for q in (a, b))
            if hasattr(a, key)
            else (
                percent(None if m is None else scale * m, 2) for m in (both.reference, both.other)
            )
        )
        difference = both.difference
        rows.append(
            (
                f"{title} [{unit}]",
                *own,
                change(difference, "%"),
                f"{difference.n:,}",
            )
        )
    notes = (
        "Columns of the computers: means over the flights that reached the goal there; energy of "
        "both: over the common successes. The gap: on the same seeds, time, distance and energy "
        "over the common successes. 95 % intervals in brackets.",
    )
    title = f"{each.name}: {Path(each.policy).name}, {each.workload}"
    return TableView(slug(title), title, columns, tuple(rows), notes)


def _paper_table(paper: PublishedTable) -> TableView:
    """Return the paper's table, its gaps by our definition and as it prints them."""
    columns = (
        Column("the paper", number=False),
        *(Column(column.label) for column in _columns(paper)),
        Column("gap"),
        Column("as printed"),
    )
    gaps = published_gap(*_columns(paper))

    def row(title: str, field: str, digits: int, gap: float, printed: float) -> tuple[str, ...]:
        values = (_of(figures, field) for figures in _columns(paper))
        unit = "points" if field == "success_percent" else "%"
        return (
            title,
            *(percent(value, digits) for value in values),
            f"{signed(gap)} {unit}",
            f"{printed:g} {unit}",
        )

    printed = paper.printed["target"]
    rows = (
        row(
            "latency [ms]",
            "latency_ms",
            1,
            gaps.latency_percent or 0.0,
            printed.latency_percent or 0.0,
        ),
        row("success [%]", "success_percent", 0, gaps.success, printed.success),
        row(
            "flight time [s]",
            "flight_time_s",
            2,
            gaps.flight_time_percent,
            printed.flight_time_percent,
        ),
        row("distance [m]", "distance_m", 2, gaps.distance_percent, printed.distance_percent),
        row("energy, vehicle [kJ]", "energy_kj", 2, gaps.energy_percent, printed.energy_percent),
    )
    notes = (f"The paper's {paper.title}; its best policy there: {paper.policy}.",)
    return TableView(slug(paper.title), f"The paper: {paper.title}", columns, rows, notes)


def _of(figures: PublishedRun, field: str) -> float | None:
    value: float | None = getattr(figures, field)
    return value


def _answer(
    each: ArenaConfig,
    first: Flown,
    second: Flown,
    gap: PairedComparison,
    paper: PublishedTable | None,
) -> str:
    told = ", ".join(
        f"{title} {change(metric(gap, key).difference, '%')}" for key, title in GAP_METRICS
    )
    a, b = (quality_of(side).success_rate for side in (first, second))
    pairs = metric(gap, "flight_time_s").difference.n
    sentence = (
        f"{each.name}: success {rate(a)} to {rate(b)} %; on the {pairs:,} common successes {told}."
    )
    if paper is None:
        return sentence
    gaps = published_gap(*_columns(paper))
    success = (f"{column.success_percent:g}" for column in _columns(paper))
    return (
        f"{sentence} The paper: success {' to '.join(success)} %, "
        f"{signed(gaps.flight_time_percent)}, "
        f"{signed(gaps.distance_percent)}, {signed(gaps.energy_percent)} %."
    )


SYSTEM_STUDY = Study(
    key="system",
    model=SystemConfig,
    cells=cells,
    findings=findings,
    quick={"episodes": 40},
)
