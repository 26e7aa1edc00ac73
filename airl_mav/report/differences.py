"""Paired differences as figures: a dot with its interval for everything that is compared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure, SubFigure

from airl_mav.flight.paired import Comparison
from airl_mav.report.intervals import draw_estimate, finish_rows
from airl_mav.report.ladder.tables import MEASURES, Measure, change_of
from airl_mav.report.theme import (
    MARK,
    PAPER,
    Picture,
    new_figure,
    render,
    render_png,
)

Against = tuple[str, Comparison]
"""What is compared with the reference: its name, and the comparison."""

_ROW_IN = 0.42
"""Height of one of them in a figure."""


def draw_differences(
    prefix: str, reference: str, others: Sequence[Against], measure: Measure
) -> Picture:
    """Draw the differences of one measure.

    Args:
        prefix: What the picture's name begins with.
        reference: Name of what all others are compared with.
        others: Those others, one or more, from top to bottom.
        measure: What is drawn.
    """
    figure = new_figure(4.2, 1.05 + _ROW_IN * len(others))
    _draw(figure, reference, others, measure)
    told = ", ".join(name for name, _ in others)
    alt = f"Difference in {measure.title} from {reference}, with intervals: {told}"
    return render(figure, f"{prefix}-{measure.key.replace('_', '-')}", alt)


def draw_sheet(reference: str, others: Sequence[Against]) -> bytes:
    """Draw all measures on one sheet; return the PNG."""
    figure = new_figure(8.4, 2.0 * (1.05 + _ROW_IN * len(others)))
    parts = np.ravel(figure.subfigures(2, 2, squeeze=False))
    for part, measure in zip(parts, MEASURES, strict=True):
        part.set_facecolor(PAPER)
        _draw(part, reference, others, measure)
    return render_png(figure)


def _draw(
    figure: Figure | SubFigure, reference: str, others: Sequence[Against], measure: Measure
) -> None:
    """Draw one measure: rows from top to bottom, the reference as the line of zero."""
    ax = figure.subplots()
    ends: list[float] = []
    for row, (_, comparison) in enumerate(others):
        d = change_of(comparison, measure).difference
        told = f"n = {d.n:,}" if d.value is None else f"{d.value:+.2f}, n = {d.n:,}"
        ends += draw_estimate(ax, row, d, told, MARK)
    unit = "percentage points" if measure.difference_unit == "points" else "%"
    names = [name for name, _ in others]
    finish_rows(ax, names, ends, measure.title, f"difference from {reference} [{unit}]")
