"""A table as data, with what it was made with: what a script leaves that compares no runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from airl_mav.core.files import read_typed, write_json
from airl_mav.report.table import TableView

SCHEMA = 1

TABLE_FILE = "table.json"


@dataclass(frozen=True)
class SavedTable:
    """What the file holds."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]
    policies: tuple[str, ...]
    made: Mapping[str, Any]
    """With what (`core.provenance.provenance`)."""


_SAVED = TypeAdapter(SavedTable)


def write_table(
    view: TableView, folder: Path, made: Mapping[str, Any], policies: Sequence[str] = ()
) -> Path:
    """Write a table into a folder, whole or not at all; return its path."""
    columns = tuple(f"{c.title}, {c.unit}" if c.unit else c.title for c in view.columns)
    saved = SavedTable(view.title, columns, view.rows, view.notes, tuple(policies), made)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / TABLE_FILE
    write_json(path, {"schema": SCHEMA, **asdict(saved)})
    return path


def read_table(folder: Path) -> SavedTable:
    """Read the table of a folder. Raises UsageError: it is missing or damaged."""
    return read_typed(folder / TABLE_FILE, _SAVED, SCHEMA, "table")
