"""Tables of text cells, and their output in the terminal and in Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from airl_mav.core.constants import US_PER_MS
from airl_mav.core.files import read_typed, write_json
from airl_mav.flight.judge import Outcome
from airl_mav.latency.stages import MIN_SAMPLES, Summary

NONE = "–"
"""Cell text for a missing value."""
TOO_FEW_CELL = "too few"
TOO_FEW_NOTE = (
    f"{TOO_FEW_CELL}: a p90 needs {MIN_SAMPLES[90.0]} samples, a p99 {MIN_SAMPLES[99.0]}."
)

OUTCOME_LABELS = {
    Outcome.SUCCESS: "goal reached",
    Outcome.COLLISION: "collision",
    Outcome.TIMEOUT: "time limit",
    Outcome.BATTERY: "battery empty",
    Outcome.ABORTED: "aborted",
}

STYLES = {
    OUTCOME_LABELS[Outcome.SUCCESS]: "green",
    OUTCOME_LABELS[Outcome.COLLISION]: "red",
    OUTCOME_LABELS[Outcome.TIMEOUT]: "yellow",
    OUTCOME_LABELS[Outcome.BATTERY]: "magenta",
    OUTCOME_LABELS[Outcome.ABORTED]: "dim",
    TOO_FEW_CELL: "dim",
    NONE: "dim",
}
"""Style of a cell in the terminal by its text."""

_INTERVAL = re.compile(r" (\[[^\[\]]*\])")


@dataclass(frozen=True)
class Column:
    """Column of a table."""

    title: str
    unit: str = ""
    number: bool = True
    """True to align right with tabular digits."""
    page_only: bool = False
    """True to omit the column in the narrow terminal."""


@dataclass(frozen=True)
class TableView:
    """Table of text cells."""

    key: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()
    stacked: bool = False
    """True to print intervals in brackets below their values on a page, to save width."""
    in_terminal: Literal["whole", "stacked", "without intervals", "not"] = "whole"
    links: Sequence[tuple[int, float | None]] = ()
    """Flight and time of each row for links; time [s] from the start of navigation or None."""


def ms(value_us: float | None, digits: int = 2) -> str:
    """Return a duration [µs] as milliseconds."""
    return NONE if value_us is None else f"{value_us / US_PER_MS:,.{digits}f}"


def percentile_cell(value_us: float | None, n: int) -> str:
    """Return a percentile [µs] as milliseconds, or "too few" samples."""
    return TOO_FEW_CELL if value_us is None and n else ms(value_us)


def columns_of(header: str) -> tuple[Column, ...]:
    """Parse columns from "title [unit] | ..."; prefix "<" marks text, "*" marks `page_only`."""
    columns = []
    for title in header.split(" | "):
        name, _, unit = title.lstrip("*<").removesuffix("]").partition(" [")
        columns.append(Column(name, unit, "<" not in title[:2], title.startswith("*")))
    return tuple(columns)


DURATION_COLUMNS = columns_of("n | mean | p50 | p90 | p99 | max")


def duration_cells(s: Summary) -> tuple[str, ...]:
    """Return the cells of durations [µs]: number, mean, percentiles and maximum [ms]."""
    tail = (percentile_cell(s.p90, s.n), percentile_cell(s.p99, s.n))
    return (f"{s.n:,}", ms(s.mean), ms(s.p50), *tail, ms(s.max))


def stacked(cell: str) -> str:
    """Return a cell with its interval on a separate line."""
    return _INTERVAL.sub(r"\n\1", cell)


def escape_markdown(text: str) -> str:
    """Return text with Markdown's special characters escaped."""
    return "".join(f"\\{c}" if c in "\\|*_`[]<>" else c for c in text)


def markdown_table(view: TableView) -> str:
    """Return a table with its title and notes as Markdown."""
    titles = [f"{c.title} [{c.unit}]" if c.unit else c.title for c in view.columns]
    rule = ["---:" if column.number else "---" for column in view.columns]
    cells = [[escape_markdown(cell.replace("\n", ", ")) for cell in row] for row in view.rows]
    lines = [f"| {' | '.join(row)} |" for row in (titles, rule, *cells)]
    return "\n\n".join([f"## {view.title}", "\n".join(lines), *map(escape_markdown, view.notes)])


def print_table(view: TableView, console: Console, *, wrap: bool = False) -> None:
    """Print a table and its notes; with `wrap`, long cells are wrapped instead of cut."""
    if view.in_terminal == "not":
        return
    console.print(rich_table(view, wrap=wrap))
    for note in view.notes:
        console.print(Text(note, style="dim"))


def rich_table(view: TableView, *, wrap: bool = False) -> Table:
    """Return a table for the terminal, without `page_only` columns."""
    table = Table(
        title=view.title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    shown = [i for i, column in enumerate(view.columns) if not column.page_only]
    for i in shown:
        column = view.columns[i]
        title = f"{column.title} [{column.unit}]" if column.unit else column.title
        side: Literal["left", "right"] = "right" if column.number else "left"
        # Folding also breaks words longer than the column, so no text is lost.
        overflow: Literal["fold", "ellipsis"] = "fold" if wrap else "ellipsis"
        table.add_column(Text(title), justify=side, no_wrap=not wrap, overflow=overflow)
    for row in view.rows:
        cells = [row[i] for i in shown]
        if view.in_terminal == "stacked":
            cells = [stacked(cell) for cell in cells]
        elif view.in_terminal == "without intervals":
            cells = [_INTERVAL.sub("", cell) for cell in cells]
        table.add_row(*(Text(cell, style=STYLES.get(cell, "")) for cell in cells))
    return table


def print_facts(rows: Iterable[tuple[str, str]], console: Console, *, style: str = "dim") -> None:
    """Print terms and their texts."""
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style=style, no_wrap=True)
    facts.add_column(overflow="fold")
    for term, text in rows:
        facts.add_row(term, Text(text))
    console.print()
    console.print(facts)


def count_outcomes(outcomes: Sequence[Outcome]) -> str:
    """Return the number of flights by outcome on one line."""
    return ", ".join(
        f"{outcomes.count(outcome):,} {label}"
        for outcome, label in OUTCOME_LABELS.items()
        if outcome in outcomes
    )


SCHEMA = 1

TABLE_FILE = "table.json"


@dataclass(frozen=True)
class SavedTable:
    """Contents of `TABLE_FILE`."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]
    policies: tuple[str, ...]
    made: Mapping[str, Any]
    """Provenance of the table (`core.provenance.provenance`)."""


_SAVED = TypeAdapter(SavedTable)


def write_table(
    view: TableView, folder: Path, made: Mapping[str, Any], policies: Sequence[str] = ()
) -> Path:
    """Write a table to a folder atomically; return the file's path."""
    columns = tuple(f"{c.title}, {c.unit}" if c.unit else c.title for c in view.columns)
    saved = SavedTable(view.title, columns, view.rows, view.notes, tuple(policies), made)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / TABLE_FILE
    write_json(path, {"schema": SCHEMA, **asdict(saved)})
    return path


def read_table(folder: Path) -> SavedTable:
    """Read the table of a folder. Raises UsageError if it is missing or damaged."""
    return read_typed(folder / TABLE_FILE, _SAVED, SCHEMA, "table")
