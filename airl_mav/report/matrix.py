"""The table of several policies in several arenas: who flies well where it was not trained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from airl_mav.core.files import replace_file, write_json
from airl_mav.flight.statistics import Aggregate, Estimate
from airl_mav.report.tables import NONE, Column, TableView

SCHEMA = 1
"""Version of `matrix.json`; docs/run-folder.md describes it."""

MATRIX_FILE = "matrix.json"
MATRIX_TABLE_FILE = "matrix.md"

_AGGREGATE = TypeAdapter(Aggregate)


@dataclass(frozen=True)
class Cell:
    """One policy in one arena."""

    policy: str
    arena: str
    folder: str
    """Its run folder, inside that of the matrix."""
    trained_in: str | None
    """Arena that the policy was trained in, if it was."""
    rules: str
    """Goal radius, hold and height in words."""
    quality: Aggregate


@dataclass(frozen=True)
class _Measure:
    """A figure that gets a table."""

    key: str
    title: str
    unit: str
    scale: float
    digits: int


MEASURES = (
    _Measure("success_rate", "Success rate", "%", 100.0, 1),
    _Measure("flight_time_s", "Flight time", "s", 1.0, 2),
    _Measure("distance_m", "Distance", "m", 1.0, 2),
    _Measure("energy_j", "Energy, vehicle", "kJ", 1e-3, 2),
)


def matrix_tables(cells: Sequence[Cell]) -> list[TableView]:
    """Return one table a measure: policies down, arenas across."""
    policies = list(dict.fromkeys(cell.policy for cell in cells))
    arenas = list(dict.fromkeys(cell.arena for cell in cells))
    at = {(cell.policy, cell.arena): cell for cell in cells}
    views = []
    for measure in MEASURES:
        columns = (
            Column("policy", number=False),
            *(Column(arena, measure.unit) for arena in arenas),
        )
        rows = tuple(
            (policy, *(_text(at.get((policy, arena)), measure) for arena in arenas))
            for policy in policies
        )
        views.append(TableView(measure.key, measure.title, columns, rows, _notes(cells, measure)))
    return views


def _text(cell: Cell | None, measure: _Measure) -> str:
    """Return a figure with its interval; a star where the policy was trained."""
    if cell is None:
        return NONE
    estimate: Estimate = getattr(cell.quality, measure.key)
    if estimate.value is None:
        return NONE
    digits, scale = measure.digits, measure.scale
    text = f"{scale * estimate.value:.{digits}f}"
    if estimate.low is not None and estimate.high is not None:
        text += f" [{scale * estimate.low:.{digits}f}, {scale * estimate.high:.{digits}f}]"
    return f"{text} *" if cell.arena == cell.trained_in else text


def _notes(cells: Sequence[Cell], measure: _Measure) -> tuple[str, ...]:
    """Return what the figures mean."""
    if measure.key != "success_rate":
        return ("Means over the flights that reached the goal, 95 % bootstrap intervals.",)
    notes = ["Of all flights; 95 % intervals after Wilson. The same seeds in every cell."]
    if any(cell.arena == cell.trained_in for cell in cells):
        notes.append("* the arena that the policy was trained in")
    rules = list(dict.fromkeys(cell.rules for cell in cells))
    if len(rules) > 1:
        notes.append(f"Not all by the same rules: {'; '.join(rules)}.")
    else:
        notes.append(f"Rules: {', '.join(rules)}.")
    return tuple(notes)


def write_matrix(folder: Path, facts: Mapping[str, Any], cells: Sequence[Cell]) -> None:
    """Write `matrix.json` and `matrix.md`, each one whole or not at all.

    Args:
        folder: Where to.
        facts: What all cells share: level, seed, episodes, vehicle, computer.
        cells: What has been flown so far.
    """
    rows = [
        {
            "policy": cell.policy,
            "arena": cell.arena,
            "trained_in": cell.trained_in,
            "rules": cell.rules,
            "folder": cell.folder,
            **_AGGREGATE.dump_python(cell.quality, mode="json"),
        }
        for cell in cells
    ]
    data = {"schema": SCHEMA, **facts, "cells": rows}
    write_json(folder / MATRIX_FILE, data)
    told = ", ".join(f"{key} {value}" for key, value in facts.items() if value is not None)
    parts = [told, *(markdown_table(view) for view in matrix_tables(cells))]
    replace_file(folder / MATRIX_TABLE_FILE, ("\n\n".join(parts) + "\n").encode())


def markdown_table(view: TableView) -> str:
    """Return a table with its title and notes as Markdown."""
    titles = [f"{c.title} [{c.unit}]" if c.unit else c.title for c in view.columns]
    rule = ["---:" if column.number else "---" for column in view.columns]
    lines = [" | ".join(row) for row in (titles, rule, *map(_escaped, view.rows))]
    table = "\n".join(f"| {line} |" for line in lines)
    return "\n\n".join([f"## {view.title}", table, *map(escape_markdown, view.notes)])


def _escaped(row: Sequence[str]) -> list[str]:
    return [escape_markdown(cell) for cell in row]


def escape_markdown(text: str) -> str:
    """Return text in which nothing is taken for Markdown."""
    return "".join(f"\\{c}" if c in "\\|*_`[]<>" else c for c in text)
