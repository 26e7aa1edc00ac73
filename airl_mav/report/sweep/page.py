"""A sweep as one HTML file that opens offline, as Markdown, and its figures as a PNG file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from airl_mav.core.files import replace_file
from airl_mav.report.html import Headline, environment
from airl_mav.report.matrix import markdown_table
from airl_mav.report.sweep.figures import sheet, size_figure, success_figure, trade_figure
from airl_mav.report.sweep.tables import best_in_words, cells_table, fact_rows, percent
from airl_mav.report.tables import NONE, TableView
from airl_mav.report.theme import Picture
from airl_mav.sweep.store import SWEEP_FILE, as_data
from airl_mav.sweep.summary import Sweep, paper_best

PAGE_FILE = "sweep.html"
MARKDOWN_FILE = "sweep.md"
FIGURE_FILE = "sweep.png"


@dataclass(frozen=True)
class ArenaSection:
    """One arena as the page shows it."""

    name: str
    words: tuple[str, ...]
    pictures: tuple[Picture, ...]
    table: TableView


def build_page(sweep: Sweep) -> Path:
    """Write `sweep.html`, `sweep.md` and `sweep.png`, each whole or not at all.

    Args:
        sweep: At least one trial has ended.

    Returns:
        The path of the page.
    """
    folder = sweep.folder.path
    replace_file(folder / FIGURE_FILE, sheet(sweep))
    replace_file(folder / MARKDOWN_FILE, _markdown(sweep).encode())
    sections = [
        ArenaSection(
            arena,
            tuple(best_in_words(sweep, arena)),
            (success_figure(sweep, arena), size_figure(sweep, arena)),
            cells_table(sweep, arena),
        )
        for arena in sweep.arenas
    ]
    page = (
        environment()
        .get_template("sweep.html.j2")
        .render(
            sweep=sweep,
            headlines=[_headline(sweep, arena) for arena in sweep.arenas],
            sections=sections,
            trade=trade_figure(sweep),
            facts=fact_rows(sweep),
            provenance=_provenance(sweep.made),
            configuration=json.dumps(as_data(sweep.config), indent=2, ensure_ascii=False),
            data_file=SWEEP_FILE,
        )
    )
    path = folder / PAGE_FILE
    replace_file(path, page.encode())
    return path


def _headline(sweep: Sweep, arena: str) -> Headline:
    best, paper = sweep.best(arena), paper_best(arena)
    theirs = "" if paper is None else f"; the paper: {paper[0]}, {100.0 * paper[1]:.0f} %"
    if best is None or best.success_rate.value is None:
        return Headline(arena, NONE, "", f"no trial has ended{theirs}")
    rate = best.success_rate
    assert rate.value is not None and rate.low is not None and rate.high is not None  # noqa: S101
    detail = f"{percent(rate.value)} % ({percent(rate.low)} … {percent(rate.high)}){theirs}"
    return Headline(arena, best.network, "", detail)


def _provenance(made: dict[str, Any]) -> list[tuple[str, str]]:
    """Return how the sweep was begun, as (term, text)."""
    machine = dict(made["machine"])
    if memory := machine.pop("memory_bytes", None):
        machine["memory"] = f"{memory / 1e9:.1f} GB"
    rows = [("command", f"{made['command']}"), ("begun", f"{made['created_utc']}")]
    rows += [(name.replace("_", " "), f"{value}") for name, value in machine.items()]
    if made["git"] is not None:
        changed = " (with changes)" if made["git"].get("changed") else ""
        rows.append(("commit", f"{made['git'].get('commit')}{changed}"))
    return [*rows, *sorted(made["versions"].items())]


def _markdown(sweep: Sweep) -> str:
    """Return the sweep as Markdown."""
    facts = "\n".join(f"- {term}: {text}" for term, text in fact_rows(sweep))
    parts = [facts]
    for arena in sweep.arenas:
        parts += [markdown_table(cells_table(sweep, arena)), " ".join(best_in_words(sweep, arena))]
    return "\n\n".join(parts) + "\n"
