"""What a study found: tables, pictures and answers, for the terminal, as Markdown and as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from airl_mav.core.files import replace_file, write_json
from airl_mav.report.html import environment
from airl_mav.report.matrix import markdown_table
from airl_mav.report.tables import TableView
from airl_mav.report.terminal import print_table
from airl_mav.report.theme import Picture

SCHEMA = 1
"""Version of `study.json`; docs/studies.md describes it."""

DATA_FILE = "study.json"
TABLE_FILE = "study.md"
PAGE_FILE = "study.html"


@dataclass(frozen=True)
class Gallery:
    """Pictures that belong together."""

    title: str
    pictures: tuple[Picture, ...]
    note: str = ""
    sheet: tuple[str, bytes] | None = None
    """File name and PNG of all of them on one sheet; None: each gets a PNG of its own."""


@dataclass(frozen=True)
class Section:
    """Tables and pictures under one heading."""

    title: str
    tables: tuple[TableView, ...] = ()
    galleries: tuple[Gallery, ...] = ()


@dataclass(frozen=True)
class Sheet:
    """Everything that a study says."""

    key: str
    title: str
    question: str
    answers: tuple[str, ...]
    """What came out, in sentences that the figures make."""
    sections: tuple[Section, ...]
    facts: tuple[tuple[str, str], ...]
    """What was flown, as (term, text)."""
    runs: tuple[tuple[str, str], ...]
    """Title and run folder of every cell, inside the study's."""
    data: Mapping[str, Any] = field(default_factory=dict)
    """The figures, for `study.json`."""
    provenance: Sequence[tuple[str, str]] = ()

    @property
    def galleries(self) -> list[Gallery]:
        """All pictures."""
        return [gallery for section in self.sections for gallery in section.galleries]


def write_sheet(sheet: Sheet, folder: Path, command: str) -> Path:
    """Write `study.json`, `study.md`, `study.html` and the PNG files; return the page's path.

    Args:
        sheet: What is written.
        folder: Where to.
        command: How it was made.
    """
    for gallery in sheet.galleries:
        if gallery.sheet is not None:
            replace_file(folder / gallery.sheet[0], gallery.sheet[1])
            continue
        for picture in gallery.pictures:
            replace_file(folder / f"{picture.name}.png", picture.png)
    data = {"schema": SCHEMA, "study": sheet.key, "command": command, **sheet.data}
    write_json(folder / DATA_FILE, data)
    replace_file(folder / TABLE_FILE, _markdown(sheet, command).encode())
    page = environment().get_template("study.html.j2").render(sheet=sheet, command=command)
    path = folder / PAGE_FILE
    replace_file(path, page.encode())
    return path


def _markdown(sheet: Sheet, command: str) -> str:
    parts = [f"# {sheet.title}", sheet.question, f"`{command}`"]
    parts.append("\n".join(f"- {answer}" for answer in sheet.answers))
    parts += [markdown_table(view) for section in sheet.sections for view in section.tables]
    return "\n\n".join(part for part in parts if part) + "\n"


def print_sheet(sheet: Sheet, console: Console, page: Path) -> None:
    """Print tables and answers, and where the page lies."""
    for section in sheet.sections:
        for view in section.tables:
            console.print()
            print_table(view, console, wrap=True)
    console.print()
    console.print(Text(sheet.question, style="bold"))
    for answer in sheet.answers:
        console.print(Text(f"- {answer}"))
    console.print()
    console.print(Text.assemble(("study  ", "dim"), str(page)), soft_wrap=True)
