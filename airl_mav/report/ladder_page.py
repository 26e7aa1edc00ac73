"""A ladder as one HTML file that opens offline, and its figure as a PNG file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure, SubFigure

from airl_mav.atomic import replace_file
from airl_mav.flight.paired import Change
from airl_mav.report.figures import quiet
from airl_mav.report.html import REPORT_FILE, Headline, environment, provenance
from airl_mav.report.ladder import LADDER_FILE, Ladder
from airl_mav.report.ladder_tables import (
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
from airl_mav.report.ladder_words import differences_in_words
from airl_mav.report.tables import NONE, OUTCOME_WORDS, TableView
from airl_mav.report.theme import (
    INK,
    MARK,
    MUTED,
    PAPER,
    RULE,
    SERIES,
    Picture,
    new_figure,
    render,
    render_png,
)

PAGE_FILE = "ladder.html"
FIGURE_FILE = "ladder.png"

_ROW_IN = 0.42
"""Height of a level in a figure."""


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
    figure = new_figure(4.2, 1.05 + _ROW_IN * len(ladder.comparisons))
    _draw_differences(figure, ladder, measure)
    told = ", ".join(level.name for level in ladder.levels[1:])
    alt = f"Difference in {measure.title} from {ladder.reference.name}, with intervals: {told}"
    return render(figure, f"ladder-{measure.key.replace('_', '-')}", alt)


def differences_sheet(ladder: Ladder) -> bytes:
    """Draw all measures on one sheet; return the PNG."""
    figure = new_figure(8.4, 2.0 * (1.05 + _ROW_IN * len(ladder.comparisons)))
    parts = np.ravel(figure.subfigures(2, 2, squeeze=False))
    for part, measure in zip(parts, MEASURES, strict=True):
        part.set_facecolor(PAPER)
        _draw_differences(part, ladder, measure)
    return render_png(figure)


def _draw_differences(figure: Figure | SubFigure, ladder: Ladder, measure: Measure) -> None:
    """Draw one measure: levels from top to bottom, the reference as the line of zero."""
    ax = figure.subplots()
    ax.axvline(0.0, color=MUTED, lw=1.0, zorder=1)
    names = [level.name for level in ladder.levels[1:]]
    ends = [0.0]
    for row, comparison in enumerate(ladder.comparisons):
        d = change_of(comparison, measure).difference
        told = f"n = {d.n:,}" if d.value is None else f"{d.value:+.2f}, n = {d.n:,}"
        ax.annotate(
            told,
            (1.0, row - 0.14),
            xycoords=("axes fraction", "data"),
            ha="right",
            va="bottom",
            fontsize=8,
            color=MARK,
        )
        if d.value is None:
            continue
        if d.low is not None and d.high is not None:
            ax.plot([d.low, d.high], [row, row], color=SERIES, lw=2.2, solid_capstyle="butt")
            ends += [d.low, d.high]
        ends.append(d.value)
        ax.plot(d.value, row, "o", ms=6, color=SERIES, mec=PAPER, mew=1.0, zorder=3)
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.65)
    # Zero stays inside, and a level without any difference still has an axis.
    room = 0.08 * (max(ends) - min(ends)) or 1.0
    ax.set_xlim(min(ends) - room, max(ends) + room)
    ax.set_title(measure.title, loc="left", fontsize=10.5, color=INK, pad=6)
    unit = "percentage points" if measure.difference_unit == "points" else "%"
    ax.set_xlabel(f"difference from {ladder.reference.name} [{unit}]", fontsize=8.5, color=MUTED)
    quiet(ax)
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", labelsize=9, labelcolor=INK)
    ax.spines["bottom"].set_color(RULE)
