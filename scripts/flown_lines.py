"""Resumable CSV file of flights, one per line, for long comparisons."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path

from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file


class FlownLines:
    """Rows of a file, with an append function."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        """Read the existing rows; drop a line truncated by a kill.

        Raises:
            UsageError: The file has other columns.
        """
        self.rows: list[dict[str, str]] = []
        """Rows of all flights, by column."""
        self._path, self._columns = path, tuple(columns)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            replace_file(path, self._line(columns).encode())
            return
        text = path.read_text(encoding="utf-8")
        whole = text[: text.rfind("\n") + 1]
        head, *lines = csv.reader(StringIO(whole)) if whole else [()]
        if tuple(head) != self._columns:
            raise UsageError(f"{path}: columns {','.join(head)}; accepted: {','.join(columns)}")
        self.rows += [dict(zip(columns, line, strict=True)) for line in lines]
        if whole != text:
            replace_file(path, whole.encode())

    def add(self, row: Mapping[str, object]) -> None:
        """Append a row immediately."""
        told = {column: str(row[column]) for column in self._columns}
        with self._path.open("a", encoding="utf-8", newline="") as file:
            file.write(self._line(tuple(told.values())))
        self.rows.append(told)

    @staticmethod
    def _line(cells: Sequence[str]) -> str:
        made = StringIO()
        csv.writer(made, lineterminator="\n").writerow(cells)
        return made.getvalue()
