"""The tables of a ladder as text cells: the terminal and the page show the same ones."""

from __future__ import annotations

from dataclasses import dataclass

from airl_mav.flight.paired import Change, Comparison
from airl_mav.flight.statistics import Estimate
from airl_mav.report.ladder.build import Ladder, Level
from airl_mav.report.tables import FEW_FLIGHTS, NONE, OUTCOME_WORDS, Column, TableView, ms

MAX_SPLIT = 50
"""Seeds in the table of flights that did not end alike."""

SHOWN_STAGES = (
    ("t1", "t1"),
    ("wait", "wait"),
    ("t2", "t2"),
    ("setpoint_to_motor", "setpoint → motor"),
    ("end_to_end", "end to end"),
    ("period", "period"),
)
"""Columns of the table of decisions: stage key, title."""


@dataclass(frozen=True)
class Measure:
    """A figure that levels are compared in."""

    key: str
    """Its field in a `Comparison`, and in an `Aggregate`."""
    title: str
    unit: str
    scale: float
    digits: int
    difference_unit: str


MEASURES = (
    Measure("success_rate", "success rate", "%", 100.0, 1, "points"),
    Measure("flight_time_s", "flight time", "s", 1.0, 2, "%"),
    Measure("distance_m", "distance", "m", 1.0, 2, "%"),
    Measure("energy_j", "energy, vehicle", "kJ", 1e-3, 2, "%"),
)


def change_of(comparison: Comparison, measure: Measure) -> Change:
    """Return the change of a measure."""
    change: Change = getattr(comparison, measure.key)
    return change


def fact_rows(ladder: Ladder) -> tuple[tuple[str, str], ...]:
    """Return what all levels share, as (term, text)."""
    rows = [(key, f"{value}") for key, value in ladder.facts.items() if value is not None]
    flown = ", ".join(
        f"{len(level.episodes):,} at {level.name}"
        if len(level.episodes) == level.planned
        else f"{len(level.episodes):,} of {level.planned:,} at {level.name}"
        for level in ladder.levels
    )
    hashes = [(f"sha256 at {level.name}", level.sha256) for level in ladder.levels if level.sha256]
    return (*rows, ("flights", flown), *hashes)


def levels_table(ladder: Ladder) -> TableView:
    """Return every level by itself."""
    columns = (
        Column("level", number=False),
        Column("flights"),
        *(Column(measure.title, measure.unit) for measure in MEASURES),
    )
    rows = tuple(
        (
            level.name,
            f"{level.quality.success_rate.n:,}",
            *(with_interval(getattr(level.quality, m.key), m) for m in MEASURES),
        )
        for level in ladder.levels
    )
    notes = [
        "Each level by itself, 95 % intervals in brackets; time, distance and energy: means over "
        "the flights that reached the goal."
    ]
    if len({level.quality.success_rate.n for level in ladder.levels}) > 1:
        notes.append("Not the same number of flights at all levels: compare on the same seeds.")
    return TableView("levels", "Levels", columns, rows, tuple(notes))


def with_interval(estimate: Estimate, measure: Measure) -> str:
    """Return a figure with its 95 % interval in brackets."""
    if estimate.value is None:
        return NONE
    text = f"{measure.scale * estimate.value:.{measure.digits}f}"
    if estimate.low is not None and estimate.high is not None:
        low, high = measure.scale * estimate.low, measure.scale * estimate.high
        text += f" [{low:.{measure.digits}f}, {high:.{measure.digits}f}]"
    return text


def comparison_tables(ladder: Ladder) -> list[TableView]:
    """Return one table for each level but the reference, which it is compared with."""
    return [
        comparison_table(ladder.reference.name, level.name, comparison)
        for level, comparison in zip(ladder.levels[1:], ladder.comparisons, strict=True)
    ]


def comparison_table(reference: str, level: str, comparison: Comparison) -> TableView:
    """Return how one thing that flew differs from another, its reference, on the same seeds."""
    columns = (
        Column("same seeds", number=False),
        Column(reference),
        Column(level),
        Column("difference"),
        Column("95 % interval"),
        Column("pairs"),
    )
    rows = tuple(_change_row(change_of(comparison, measure), measure) for measure in MEASURES)
    a = comparison.agreement
    notes = [
        f"Of {a.n:,} seeds both reached the goal in {a.both:,}, only {reference} in "
        f"{a.only_reference:,}, only {level} in {a.only_other:,}, neither in {a.neither:,}."
    ]
    n = comparison.flight_time_s.difference.n
    notes.append(
        f"Time, distance and energy: means over {successes_in_words(n)}. Intervals: Tango's "
        "score interval for the success rate, bootstrap over pairs for the means."
    )
    if 1 < n < FEW_FLIGHTS:
        notes.append(f"Bootstrap intervals of fewer than {FEW_FLIGHTS} pairs are too narrow.")
    title = f"{level} against {reference}"
    return TableView(f"{level}-against-{reference}", title, columns, rows, tuple(notes))


def _change_row(change: Change, measure: Measure) -> tuple[str, ...]:
    def own(value: float | None) -> str:
        if value is None:
            return NONE
        return f"{measure.scale * value:,.{measure.digits}f} {measure.unit}"

    d = change.difference
    value = NONE if d.value is None else f"{d.value:+.2f} {measure.difference_unit}"
    interval = NONE
    if d.low is not None and d.high is not None:
        interval = f"{d.low:+.2f} … {d.high:+.2f}"
    return measure.title, own(change.reference), own(change.other), value, interval, f"{d.n:,}"


def decisions_table(ladder: Ladder) -> TableView:
    """Return how long decisions take at each level."""
    columns = (
        Column("level", number=False),
        Column("decisions"),
        *(Column(title) for _, title in SHOWN_STAGES),
    )
    rows = tuple(
        (
            level.name,
            f"{level.stages['t2'].n:,}",
            *(ms(level.stages[key].mean, 1) for key, _ in SHOWN_STAGES),
        )
        for level in ladder.levels
    )
    notes = ["Means, milliseconds of simulated time; end to end: frame exposed → motors."]
    labels = {level.name: level.t2 for level in ladder.levels}
    if len(set(labels.values())) == 1:
        notes.append(f"t2: {ladder.reference.t2}.")
    else:
        notes += [f"t2 at {name}: {label}." for name, label in labels.items()]
    return TableView("decisions", "What a decision takes", columns, rows, tuple(notes))


def start_table(ladder: Ladder) -> TableView:
    """Return where navigation begins at each level, and how well the place is known."""
    columns = (
        Column("level", number=False),
        Column("flights"),
        Column("take-off", "s"),
        Column("its energy", "kJ"),
        Column("aside", "m"),
        Column("height", "m"),
        Column("speed", "m/s"),
        Column("position error", "m"),
    )
    rows = tuple(_start_row(level) for level in ladder.levels)
    notes = (
        "Means. Take-off: before navigation, in none of the figures above. Aside, height, speed: "
        "of the vehicle as navigation begins. Position error: of the estimate that the companion "
        "is told, during navigation, seen from above.",
    )
    return TableView("start", "Where navigation begins", columns, rows, notes)


def _start_row(level: Level) -> tuple[str, ...]:
    start, error = level.start, level.position_error_m
    told = NONE if error is None else f"{error:.2f}"
    if start is None:
        return (level.name, "0", *(NONE,) * 5, told)
    takeoff = (f"{start.takeoff_s:.2f}", f"{start.takeoff_energy_j / 1e3:.2f}")
    if not start.takeoff_s:
        takeoff = ("none", NONE)
    place = (f"{start.aside_m:.2f}", f"{start.height_m:.2f}", f"{start.speed_m_s:.2f}")
    return (level.name, f"{start.n:,}", *takeoff, *place, told)


def split_table(ladder: Ladder) -> TableView:
    """Return the flights that did not end alike, seed by seed."""
    columns = (
        Column("seed"),
        *(Column(level.name, number=False) for level in ladder.levels),
    )
    split = ladder.split()
    rows = tuple(
        (
            f"{seed}",
            *(
                OUTCOME_WORDS[flights[level.name].outcome] if level.name in flights else NONE
                for level in ladder.levels
            ),
        )
        for seed, flights in split[:MAX_SPLIT]
    )
    notes = ["Seeds of which one flight reached the goal and another did not."]
    if len(rows) < len(split):
        notes.append(f"{len(rows)} of {len(split):,}; all: ladder.json.")
    return TableView("split", "Flights that did not end alike", columns, rows, tuple(notes))


def successes_in_words(n: int) -> str:
    """Return the number of common successes in words."""
    return f"{n:,} common success" if n == 1 else f"{n:,} common successes"
