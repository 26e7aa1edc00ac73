"""The tables of a hardware gap as text cells: terminal, page and Markdown show the same ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from airl_mav.flight.gap import HardwareGap, MetricGap
from airl_mav.flight.paired import Change
from airl_mav.flight.paper import PaperFigures, PrintedGaps
from airl_mav.flight.statistics import Estimate
from airl_mav.report.gap.build import ArenaGap, Flown, Gap, GapStudy
from airl_mav.report.ladder.tables import MEASURES, Measure, successes_in_words, with_interval
from airl_mav.report.tables import FEW_FLIGHTS, NONE, Column, TableView, ms

COMPUTER_ENERGY = Measure("computer_energy_j", "energy, computer", "kJ", 1e-3, 2, "%")
TOTAL_ENERGY = Measure("total_energy_j", "energy, both", "kJ", 1e-3, 2, "%")
ALL_MEASURES = (*MEASURES, COMPUTER_ENERGY, TOTAL_ENERGY)

THE_PAPER = "the paper"

_PAPER_FIELDS = {
    "success_rate": ("success_percent", "success"),
    "flight_time_s": ("flight_time_s", "flight_time_percent"),
    "distance_m": ("distance_m", "distance_percent"),
    "energy_j": ("energy_kj", "energy_percent"),
}
"""By our measure: the paper's figure (in the unit that is shown) and its gap."""


@dataclass(frozen=True)
class Cells:
    """One measure of a gap as cells."""

    value: str
    interval: str
    median: str
    n: int


def change_of(gap: HardwareGap, measure: Measure) -> Change:
    """Return the change of a measure."""
    found: Change | MetricGap = getattr(gap, measure.key)
    return found.change if isinstance(found, MetricGap) else found


def median_of_gap(gap: HardwareGap, measure: Measure) -> Estimate | None:
    """Return the median over the pairs; None for the success rate, which has none."""
    found: Change | MetricGap = getattr(gap, measure.key)
    return found.median if isinstance(found, MetricGap) else None


def paper_figure(figures: PaperFigures | None, measure: Measure) -> float | None:
    """Return the paper's figure of a measure, in the unit that is shown."""
    if figures is None or measure.key not in _PAPER_FIELDS:
        return None
    value: float | None = getattr(figures, _PAPER_FIELDS[measure.key][0])
    return value


def paper_gap(gaps: PrintedGaps | None, measure: Measure) -> float | None:
    """Return the paper's gap of a measure."""
    if gaps is None or measure.key not in _PAPER_FIELDS:
        return None
    value: float = getattr(gaps, _PAPER_FIELDS[measure.key][1])
    return value


def fact_rows(study: GapStudy) -> tuple[tuple[str, str], ...]:
    """Return what all arenas share, as (term, text)."""
    facts = study.facts
    rows = [
        (key.replace("_", " "), f"{value}")
        for key, value in facts.items()
        if value is not None and key != "remarks"
    ]
    columns = [column for arena in study.arenas for column in arena.columns]
    rules = dict.fromkeys(column.held.rules for column in columns)
    return (*rows, ("rules", "; ".join(rules)))


def legend_rows(arena: ArenaGap) -> tuple[tuple[str, str], ...]:
    """Return what the letters stand for, as (letter, text)."""
    return tuple(
        (
            column.letter,
            f"{column.held.title}; t2 {column.setup.injection.label}"
            + ("" if column.paper is None else f"; {THE_PAPER}: {column.paper.label}"),
        )
        for column in arena.columns
    )


def columns_table(arena: ArenaGap, *, intervals: Literal["none", "beside", "below"]) -> TableView:
    """Return everything that flew by itself, as the paper's tables have it, with its columns.

    Args:
        arena: What was flown.
        intervals: Where the 95 % intervals are: below their figures they need less width.
    """
    having = [column for column in arena.columns if column.paper is not None]
    below = "\n" if intervals == "none" else " "
    columns = (
        Column("", number=False),
        *(Column(column.letter) for column in arena.columns),
        *(Column(f"paper{below}{column.letter}") for column in having),
    )
    t2 = [(ms(c.t2.mean, 1), ms(c.t2.p50, 1)) for c in arena.columns]
    nothing = (NONE,) * len(having)

    def shown(estimate: Estimate, measure: Measure) -> str:
        if intervals == "none":
            return _plain(estimate, measure)
        text = with_interval(estimate, measure)
        return text if intervals == "beside" else text.replace(" [", "\n[")

    rows = [
        (
            "t2, mean [ms]",
            *(mean for mean, _ in t2),
            *(f"{c.paper.latency_ms:g}" for c in having if c.paper is not None),
        ),
        ("t2, median [ms]", *(median for _, median in t2), *nothing),
        ("flights", *(f"{c.quality.success_rate.n:,}" for c in arena.columns), *nothing),
    ]
    for measure in ALL_MEASURES:
        figures = [_estimate(column, measure) for column in arena.columns]
        told = [paper_figure(column.paper, measure) for column in having]
        rows.append(
            (
                f"{measure.title} [{measure.unit}]",
                *(shown(figure, measure) for figure in figures),
                *(NONE if figure is None else f"{figure:.4g}" for figure in told),
            )
        )
    notes = [
        "Each by itself; time, distance and energy: means over its own flights that reached the "
        "goal, not the same ones in every column: compare by the gaps. t2: of every decision."
    ]
    if intervals != "none":
        notes.append("In brackets: 95 % intervals, Wilson for the success rate, bootstrap (BCa).")
    return TableView(_key(arena, "flown"), "What flew", columns, tuple(rows), tuple(notes))


def _estimate(column: Flown, measure: Measure) -> Estimate:
    if measure is TOTAL_ENERGY:
        return column.total_energy_j
    estimate: Estimate = getattr(column.quality, measure.key)
    return estimate


def _plain(estimate: Estimate, measure: Measure) -> str:
    if estimate.value is None:
        return NONE
    return f"{measure.scale * estimate.value:,.{measure.digits}f}"


def gaps_table(arena: ArenaGap, *, narrow: bool = False) -> TableView:
    """Return all gaps of an arena with their intervals, the paper's below each.

    Args:
        arena: What was flown.
        narrow: Few words, and intervals in lines of their own.
    """
    columns = (
        Column("", number=False),
        *(Column(measure.title, measure.difference_unit) for measure in MEASURES),
        *(() if narrow else (Column("t2", "%"), Column("pairs"))),
    )
    rows: list[tuple[str, ...]] = []
    for gap in arena.gaps:
        told = [with_sign(change_of(gap.gap, measure).difference) for measure in MEASURES]
        more = (_percent(gap.t2_percent, 0), f"{_pairs(gap):,}")
        if narrow:
            texts = (text.replace(" [", "\n[") for text in told)
            rows.append((f"{gap.letters}\n{gap.short}", *texts))
        else:
            rows.append((f"{gap.letters}: {gap.title}", *told, *more))
        if gap.paper is not None:
            figures = (_percent(paper_gap(gap.paper, measure), 1) for measure in MEASURES)
            more = (_percent(gap.paper.latency_percent, 0), NONE)
            rows.append((f"  {THE_PAPER}", *figures, *(() if narrow else more)))
    notes = [f"{g.letters}: {g.title}, {_pairs(g):,} pairs." for g in arena.gaps] if narrow else []
    notes += _gap_notes(arena)
    return TableView(_key(arena, "gaps"), "Hardware gap", columns, tuple(rows), tuple(notes))


def _pairs(gap: Gap) -> int:
    """Return the number of common successes."""
    return gap.gap.flight_time_s.change.difference.n


def _percent(value: float | None, digits: int) -> str:
    # Rounded first, and 0.0 added: there is no -0.
    return NONE if value is None else f"{round(value, digits) + 0.0:+,.{digits}f}"


def with_sign(estimate: Estimate, digits: int = 1) -> str:
    """Return a difference with its 95 % interval in brackets."""
    if estimate.value is None:
        return NONE
    text = f"{estimate.value:+.{digits}f}"
    if estimate.low is not None and estimate.high is not None:
        text += f" [{estimate.low:+.{digits}f}, {estimate.high:+.{digits}f}]"
    return text


def _gap_notes(arena: ArenaGap) -> list[str]:
    notes = [
        "Gap: 100 (target - reference) / reference, in percent; success: percentage points. The "
        "same seeds; time, distance and energy over the pairs of which both reached the goal. In "
        "brackets: 95 % intervals, Tango's for the success, bootstrap over pairs (BCa) for the "
        "means."
    ]
    fewest = min((g.gap.flight_time_s.change.difference.n for g in arena.gaps), default=0)
    if fewest < FEW_FLIGHTS:
        notes.append(f"Bootstrap intervals of fewer than {FEW_FLIGHTS} pairs are too narrow.")
    by_rules: dict[str, list[str]] = {}
    for column in arena.columns:
        by_rules.setdefault(column.held.rules, []).append(column.letter)
    if len(by_rules) > 1:
        told = "; ".join(f"{', '.join(letters)}: {words}" for words, letters in by_rules.items())
        notes.append(f"Not all fly by the same rules, which makes differences too. {told}.")
    if arena.column("training") is not None:
        notes.append(
            "As trained: the sources of latency of the policy's own training. Its latencies are "
            "other draws than the target's: with the same ones the comparison would be of a policy "
            "with itself."
        )
    if arena.paper_table is not None:
        notes.append(
            f"{THE_PAPER}: Air Learning, {arena.paper_table}, its gaps worked out here from its "
            "columns by the definition above. Its own arena, vehicle, network and latencies."
        )
    if arena.paper_table is not None and arena.column("mitigated") is not None:
        notes.append(
            "The paper prints success gaps of 2.4 and 16.43 there: percent of the target's rate, "
            "(85 - 83) / 83 and (85 - 73) / 73; in its system evaluation it prints points. Its "
            "37.73, 16.03 and 15.49 % without mitigation are against the delay-trained policy."
        )
    return notes


def detail_table(arena: ArenaGap, gap: Gap) -> TableView:
    """Return one gap, measure by measure."""
    target, reference = gap.target, gap.reference
    columns: tuple[Column, ...] = (
        Column("same seeds", number=False),
        Column(reference.letter),
        Column(target.letter),
        Column("gap"),
        Column("95 % interval"),
        Column("median of pairs"),
        Column("pairs"),
    )
    if gap.paper is not None:
        columns += (
            Column(f"paper {reference.letter}"),
            Column(f"paper {target.letter}"),
            Column("paper gap"),
        )
    rows = tuple(_detail_row(gap, measure) for measure in ALL_MEASURES)
    a = gap.gap.agreement
    n = gap.gap.flight_time_s.change.difference.n
    notes = (
        f"{target.letter}: {target.held.title}; {reference.letter}: {reference.held.title}. Of "
        f"{a.n:,} seeds both reached the goal in {a.both:,}, only {reference.letter} in "
        f"{a.only_reference:,}, only {target.letter} in {a.only_other:,}, neither in "
        f"{a.neither:,}. Means over {successes_in_words(n)}; median of pairs: of what each seed "
        "loses, with an interval that assumes no distribution.",
    )
    title = f"{gap.letters}: {gap.title}"
    key = f"{gap.key}-{target.letter}-{reference.letter}"
    return TableView(_key(arena, key), title, columns, rows, notes)


def _detail_row(gap: Gap, measure: Measure) -> tuple[str, ...]:
    change, median = change_of(gap.gap, measure), median_of_gap(gap.gap, measure)
    d = change.difference

    def own(value: float | None) -> str:
        if value is None:
            return NONE
        return f"{measure.scale * value:,.{measure.digits}f} {measure.unit}"

    interval = NONE
    if d.low is not None and d.high is not None:
        interval = f"{d.low:+.2f} … {d.high:+.2f}"
    row = (
        measure.title,
        own(change.reference),
        own(change.other),
        NONE if d.value is None else f"{d.value:+.2f} {measure.difference_unit}",
        interval,
        NONE if median is None else with_sign(median),
        f"{d.n:,}",
    )
    if gap.paper is None:
        return row
    figures = (paper_figure(side.paper, measure) for side in (gap.reference, gap.target))
    told = paper_gap(gap.paper, measure)
    return (
        *row,
        *(NONE if figure is None else f"{figure:.4g} {measure.unit}" for figure in figures),
        NONE if told is None else f"{told:+.2f} {measure.difference_unit}",
    )


def energy_note(arena: ArenaGap) -> str:
    """Return what the computers draw: their watts decide what the energies of both can tell."""
    watts = {c.setup.computer.name: c.setup.computer_watts for c in arena.columns}
    told = ", ".join(f"{Path(name).stem} {value:g} W" for name, value in watts.items())
    return (
        f"Energy: of the vehicle; that of the computer apart ({told}, times the flight time), then "
        "both. A computer that could not fly along makes a gap of both that nobody saves."
    )


def all_tables(arena: ArenaGap) -> Sequence[TableView]:
    """Return all tables of an arena, as the page has them."""
    return [
        columns_table(arena, intervals="beside"),
        gaps_table(arena),
        *(detail_table(arena, gap) for gap in arena.gaps),
    ]


def _key(arena: ArenaGap, name: str) -> str:
    return f"{Path(arena.arena).stem}-{name}"
