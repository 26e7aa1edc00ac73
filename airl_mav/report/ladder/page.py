"""A ladder as one HTML file that opens offline, and its figure as a PNG file."""

from __future__ import annotations

import json
from pathlib import Path

from airl_mav.core.files import replace_file
from airl_mav.flight.paired import Change
from airl_mav.report.differences import Against, draw_differences, draw_sheet
from airl_mav.report.html import REPORT_FILE, Headline, environment, provenance
from airl_mav.report.ladder.build import LADDER_FILE, Ladder
from airl_mav.report.ladder.tables import (
    MEASURES,
    Measure,
    change_of,
    comparison_tables,
    decisions_table,
    fact_rows,
    levels_table,
    split_table,
    start_table,
)
from airl_mav.report.ladder.words import differences_in_words
from airl_mav.report.tables import NONE, OUTCOME_WORDS, TableView
from airl_mav.report.theme import Picture

PAGE_FILE = "ladder.html"
FIGURE_FILE = "ladder.png"


def build_page(ladder: Ladder) -> Path:
    """Write `ladder.html` and `ladder.png`, each whole or not at all; return the page's path."""
    replace_file(ladder.path / FIGURE_FILE, differences_sheet(ladder))
    page = (
        environment()
        .get_template("ladder.html.j2")
        .render(
            ladder=ladder,
            title=f"{ladder.facts.get('policy')} in {ladder.facts.get('arena')}",
            links=[
                (level.name, f"{folder}/{REPORT_FILE}", folder)
                for level in ladder.levels
                for folder in level.folders
                if (ladder.path / folder / REPORT_FILE).exists()
            ],
            against=list(
                zip(
                    ladder.levels[1:],
                    _all_headlines(ladder),
                    comparison_tables(ladder),
                    strict=True,
                )
            ),
            pictures=[differences_figure(ladder, measure) for measure in MEASURES],
            facts=fact_rows(ladder),
            words=differences_in_words(ladder),
            levels=levels_table(ladder),
            decisions=decisions_table(ladder),
            start=start_table(ladder),
            split=_unless_empty(split_table(ladder)),
            outcome_keys={words: outcome.value for outcome, words in OUTCOME_WORDS.items()},
            provenance=provenance(ladder.made),
            configuration=json.dumps(ladder.made.config, indent=2, ensure_ascii=False),
            data_file=LADDER_FILE,
        )
    )
    path = ladder.path / PAGE_FILE
    replace_file(path, page.encode())
    return path


def _unless_empty(view: TableView) -> TableView | None:
    return view if view.rows else None


def _all_headlines(ladder: Ladder) -> list[list[Headline]]:
    """Return the differences of each level but the reference as headlines."""
    return [
        [_headline(measure, change_of(comparison, measure)) for measure in MEASURES]
        for comparison in ladder.comparisons
    ]


def _headline(measure: Measure, change: Change) -> Headline:
    d = change.difference
    if d.value is None:
        return Headline(measure.title, NONE, "", f"n = {d.n}")
    detail = f"n = {d.n:,}"
    if d.low is not None and d.high is not None:
        detail = f"{d.low:+.2f} … {d.high:+.2f}, n = {d.n:,}"
    return Headline(measure.title, f"{d.value:+.2f}", measure.difference_unit, detail)


def differences_figure(ladder: Ladder, measure: Measure) -> Picture:
    """Draw the differences of one measure: a dot with its interval for each level."""
    return draw_differences("ladder", ladder.reference.name, _against(ladder), measure)


def differences_sheet(ladder: Ladder) -> bytes:
    """Draw all measures on one sheet; return the PNG."""
    return draw_sheet(ladder.reference.name, _against(ladder))


def _against(ladder: Ladder) -> list[Against]:
    """Return what is drawn against the reference."""
    return [
        (level.name, comparison)
        for level, comparison in zip(ladder.levels[1:], ladder.comparisons, strict=True)
    ]
