"""A hardware gap as one HTML file that opens offline, and its figures as PNG files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from airl_mav.core.files import replace_file
from airl_mav.report.fan import fan_pictures, fan_sheet
from airl_mav.report.gap.build import WITH, WITH_TRAINED, WITHOUT, ArenaGap, Gap, GapStudy
from airl_mav.report.gap.figures import (
    flight_panels,
    gap_picture,
    gap_sheet,
    worst_pictures,
    worst_sheet,
)
from airl_mav.report.gap.file import GAP_FILE
from airl_mav.report.gap.markdown import TABLES_FILE
from airl_mav.report.gap.tables import (
    change_of,
    columns_table,
    detail_table,
    energy_note,
    fact_rows,
    gaps_table,
    legend_rows,
    paper_gap,
)
from airl_mav.report.html import REPORT_FILE, Headline, environment, provenance
from airl_mav.report.ladder.tables import MEASURES, Measure
from airl_mav.report.tables import NONE, OUTCOME_WORDS, TableView
from airl_mav.report.theme import Picture

PAGE_FILE = "gap.html"

HEADLINED = (WITHOUT, WITH, WITH_TRAINED)
"""Gaps whose figures head an arena."""


@dataclass(frozen=True)
class ArenaView:
    """An arena as the page shows it."""

    name: str
    headlines: list[tuple[str, list[Headline]]]
    """By gap, in words."""
    legend: tuple[tuple[str, str], ...]
    """What the letters stand for."""
    flown: TableView
    gaps: TableView
    details: list[TableView]
    energy: str
    differences: list[Picture]
    has_paper: bool
    flights: list[Picture]
    worst: list[Picture]
    worst_key: str
    """What the letters of the pictures stand for."""
    folders: list[tuple[str, str, str | None]]
    """Each column: its words, its run folder, and the address of its own report if it has one."""


def build_page(study: GapStudy, sentences: Sequence[str]) -> Path:
    """Write `gap.html` and the PNG files, each whole or not at all; return the page's path.

    Raises:
        UsageError: An arena of the flights cannot be made any more.
    """
    page = (
        environment()
        .get_template("gap.html.j2")
        .render(
            title=_title(study),
            sentences=sentences,
            made=study.made,
            arenas=[_view(study, arena) for arena in study.arenas],
            facts=fact_rows(study),
            remarks=study.facts.get("remarks", []),
            outcome_keys={words: outcome.value for outcome, words in OUTCOME_WORDS.items()},
            provenance=provenance(study.made),
            configuration=json.dumps(study.made.config, indent=2, ensure_ascii=False),
            data_file=GAP_FILE,
            tables_file=TABLES_FILE,
        )
    )
    path = study.path / PAGE_FILE
    replace_file(path, page.encode())
    return path


def _title(study: GapStudy) -> str:
    facts = study.facts
    where = facts.get("latency") or facts.get("computer")
    return f"{facts.get('policy')} on {Path(str(where)).name}"


def _view(study: GapStudy, arena: ArenaGap) -> ArenaView:
    """Draw an arena and work out its tables."""
    name = Path(arena.arena).stem
    panels = flight_panels(arena)
    if arena.gaps:
        replace_file(study.path / f"gap-{name}.png", gap_sheet(arena))
    if panels:
        replace_file(study.path / f"flights-{name}.png", fan_sheet(panels))
    if arena.worst:
        replace_file(study.path / f"worst-{name}.png", worst_sheet(arena))
    drawn = [c for c in arena.columns if c.held.role in ("reference", "target", "mitigated")]
    return ArenaView(
        name=name,
        headlines=[
            (f"{gap.letters}: {gap.title}", [_headline(gap, measure) for measure in MEASURES])
            for key in HEADLINED
            if (gap := arena.gap(key)) is not None
        ],
        legend=legend_rows(arena),
        flown=columns_table(arena, intervals="below"),
        gaps=gaps_table(arena),
        details=[detail_table(arena, gap) for gap in arena.gaps],
        energy=energy_note(arena),
        differences=[gap_picture(arena, measure) for measure in MEASURES] if arena.gaps else [],
        has_paper=any(gap.paper is not None for gap in arena.gaps),
        flights=fan_pictures(f"flights-{name}", panels) if panels else [],
        worst=worst_pictures(arena),
        worst_key="; ".join(f"{c.letter}: {c.held.title}" for c in drawn),
        folders=[
            (column.name, column.held.folder, _own_report(study.path, column.held.folder))
            for column in arena.columns
        ],
    )


def _own_report(root: Path, folder: str) -> str | None:
    return f"{folder}/{REPORT_FILE}" if (root / folder / REPORT_FILE).exists() else None


def _headline(gap: Gap, measure: Measure) -> Headline:
    d = change_of(gap.gap, measure).difference
    if d.value is None:
        return Headline(measure.title, NONE, "", f"n = {d.n}")
    parts = []
    if d.low is not None and d.high is not None:
        parts.append(f"{d.low:+.1f} … {d.high:+.1f}")
    parts.append(f"n = {d.n:,}")
    if (paper := paper_gap(gap.paper, measure)) is not None:
        parts.append(f"the paper {paper:+.1f}")
    return Headline(measure.title, f"{d.value:+.1f}", measure.difference_unit, ", ".join(parts))
