"""A hardware gap as Markdown, for documents."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from airl_mav.core.files import replace_file
from airl_mav.report.gap.build import GapStudy
from airl_mav.report.gap.tables import all_tables, energy_note, fact_rows, legend_rows
from airl_mav.report.matrix import escape_markdown, markdown_table

TABLES_FILE = "gap.md"


def write_markdown(study: GapStudy, sentences: Sequence[str]) -> None:
    """Write `gap.md`, whole or not at all."""
    parts = ["# Hardware gap", *map(escape_markdown, sentences)]
    parts.append("\n".join(f"- {term}: {escape_markdown(text)}" for term, text in fact_rows(study)))
    for arena in study.arenas:
        parts.append(f"# {escape_markdown(Path(arena.arena).stem)}")
        parts.append("\n".join(f"- **{k}** {escape_markdown(v)}" for k, v in legend_rows(arena)))
        parts += [markdown_table(view) for view in all_tables(arena)]
        parts.append(escape_markdown(energy_note(arena)))
    replace_file(study.path / TABLES_FILE, ("\n\n".join(parts) + "\n").encode())
