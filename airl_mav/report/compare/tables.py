"""The tables of a comparison as text cells: the terminal and the page show the same ones."""

from __future__ import annotations

from collections.abc import Sequence

from airl_mav.flight.statistics import Estimate
from airl_mav.latency.percentiles import MIN_SAMPLES
from airl_mav.latency.stages import SETPOINT_TO_MOTOR, SHOWN_STAGES, Stage
from airl_mav.report.compare.build import Compared, Pairing, Side
from airl_mav.report.ladder.tables import MEASURES, Measure, comparison_table, with_interval
from airl_mav.report.tables import (
    FEW_FLIGHTS,
    NONE,
    TOO_FEW_CELL,
    Column,
    TableView,
    ms,
    percentile_cell,
)

SIDE_BY_SIDE = 4
"""Up to so many runs stand beside each other, more of them below each other."""

COMPUTER_ENERGY = Measure("computer_energy_j", "energy, computer", "kJ", 1e-3, 2, "%")
OWN_MEASURES = (*MEASURES, COMPUTER_ENERGY)

COMPARED_STAGES = (*SHOWN_STAGES[:-1], SETPOINT_TO_MOTOR, SHOWN_STAGES[-1])
"""Stages of a decision, in the order of the table."""


def flown_table(compared: Compared) -> TableView:
    """Return what differs in what was flown, and nothing else; many runs in rows."""
    terms, sides = compared.different, compared.sides
    note = f"Only what differs. The reference: {compared.reference.name}."
    if len(sides) > SIDE_BY_SIDE:
        columns = (Column("run", number=False), *(Column(term, number=False) for term in terms))
        rows = tuple((s.name, *(s.facts.get(term, NONE) for term in terms)) for s in sides)
    else:
        columns = (Column("", number=False), *(Column(s.name, number=False) for s in sides))
        rows = tuple((term, *(s.facts.get(term, NONE) for s in sides)) for term in terms)
    return TableView("flown", "What differs", columns, rows, (note,))


def quality_table(compared: Compared) -> TableView:
    """Return every run by itself."""
    columns = (
        Column("run", number=False),
        Column("flights"),
        *(Column(measure.title, measure.unit) for measure in OWN_MEASURES),
    )
    rows = tuple(
        (
            side.name,
            f"{side.summary.quality.success_rate.n:,}",
            *(with_interval(getattr(side.summary.quality, m.key), m) for m in OWN_MEASURES),
        )
        for side in compared.sides
    )
    notes = [
        "Each run by itself, 95 % intervals in brackets (Wilson, bootstrap); time, distance and "
        "energy: means over the flights that reached the goal."
    ]
    fewest = min(_successes(side).n for side in compared.sides)
    if fewest < FEW_FLIGHTS:
        notes.append(f"Bootstrap intervals of fewer than {FEW_FLIGHTS} flights are too narrow.")
    return TableView("quality", "Quality of flight", columns, rows, tuple(notes))


def _successes(side: Side) -> Estimate:
    return side.summary.quality.flight_time_s


def pairing_tables(compared: Compared) -> list[TableView]:
    """Return a table for every run that shares episodes with the reference."""
    return [
        comparison_table(compared.reference.name, pairing.name, pairing.comparison)
        for pairing in paired(compared)
    ]


def paired(compared: Compared) -> list[Pairing]:
    """Return the runs that share episodes with the reference."""
    return [pairing for pairing in compared.pairings if pairing.pairs]


def pairs_in_words(compared: Compared) -> list[str]:
    """Return how many pairs there are of every run with the reference, and why no more."""
    return [_pairs(compared.reference.name, pairing) for pairing in compared.pairings]


def _pairs(reference: str, pairing: Pairing) -> str:
    strangers = ""
    if pairing.strangers:
        strangers = (
            f" {pairing.strangers:,} flights have a seed of {reference}, but another arena "
            "or goal: no pairs."
        )
    if not pairing.pairs:
        return (
            f"{pairing.name} and {reference} share no episode: their differences are those of "
            f"the table above, unpaired.{strangers}"
        )
    return f"{pairing.name} and {reference}: {pairing.pairs:,} pairs.{strangers}"


def latency_table(compared: Compared) -> TableView:
    """Return the latencies of all runs, stage by stage."""
    columns = (
        Column("stage", number=False),
        Column("run", number=False),
        Column("n"),
        *(Column(title) for title in ("mean", "p50", "p90", "p99", "max")),
    )
    rows: list[tuple[str, ...]] = []
    mixed = any(side.summary.modelled for side in compared.sides)
    for stage in COMPARED_STAGES:
        having = [side for side in compared.sides if _shown(side, stage, mixed)]
        rows += [
            (stage.title if i == 0 else "", side.name, *_latency_cells(side, stage.key))
            for i, side in enumerate(having)
        ]
    notes = ["Milliseconds of simulated time."]
    if modelled := [side.name for side in compared.sides if side.summary.modelled]:
        notes.append(
            f"Level gym measures no time: transport and link are constants of its model, t2 is "
            f"drawn ({_listed(modelled)})."
        )
    if any(TOO_FEW_CELL in row for row in rows):
        notes.append(
            f"{TOO_FEW_CELL}: a p90 needs {MIN_SAMPLES[90.0]} samples, a p99 {MIN_SAMPLES[99.0]}."
        )
    return TableView("latency", "Decision latency", columns, tuple(rows), tuple(notes))


def _shown(side: Side, stage: Stage, mixed: bool) -> bool:
    """Return whether a run has a line for a stage.

    Where one has link and control in one, that sum is shown of all.
    """
    known = stage in side.summary.shown_stages or (mixed and stage == SETPOINT_TO_MOTOR)
    return known and side.summary.stages[stage.key].n > 0


def _latency_cells(side: Side, key: str) -> tuple[str, ...]:
    s = side.summary.stages[key]
    tail = (percentile_cell(s.p90, s.n), percentile_cell(s.p99, s.n))
    return (f"{s.n:,}", ms(s.mean), ms(s.p50), *tail, ms(s.max))


def _listed(names: Sequence[str]) -> str:
    return "all runs" if len(names) > 3 else "; ".join(names)
