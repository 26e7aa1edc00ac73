"""A table of figures as a coloured grid: rows down, columns across, the value in every cell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from airl_mav.report.figures import quiet
from airl_mav.report.heatmap import DARK_INK, LIGHT_INK, colours
from airl_mav.report.theme import INK, MUTED, RULE, Picture, new_figure, render

TURN = 0.55
"""Share of the scale from which on cells are dark."""


def grid_picture(
    name: str,
    title: str,
    rows: Sequence[str],
    columns: Sequence[str],
    values: NDArray[np.float64],
    texts: Sequence[Sequence[str]],
    scale: tuple[float, float],
) -> Picture:
    """Draw a grid.

    Args:
        name: File name without suffix.
        title: What is drawn.
        rows: Names of the rows.
        columns: Names of the columns.
        values: (rows, columns); NaN where there is none.
        texts: What is written into the cells.
        scale: Least and greatest value of the colours.
    """
    figure = new_figure(1.9 + 1.25 * len(columns), 1.0 + 0.45 * len(rows))
    ax: Axes = figure.subplots()
    low, high = scale
    ax.imshow(values, cmap=colours(), vmin=low, vmax=high, aspect="auto")
    for r, row in enumerate(texts):
        for c, text in enumerate(row):
            share = (values[r, c] - low) / (high - low)
            ink = MUTED if np.isnan(share) else LIGHT_INK if share > TURN else DARK_INK
            ax.text(c, r, text, ha="center", va="center", fontsize=8.5, color=ink)
    ax.set_xticks(np.arange(len(columns)), columns)
    ax.set_yticks(np.arange(len(rows)), rows)
    quiet(ax, grid=False)
    ax.set_xticks(np.arange(len(columns) + 1) - 0.5, minor=True)
    ax.set_yticks(np.arange(len(rows) + 1) - 0.5, minor=True)
    ax.grid(True, which="minor", color=RULE, lw=1.0)
    ax.tick_params(labelsize=8.5, labelcolor=INK)
    ax.set_title(title, loc="left", fontsize=10.5, color=INK, pad=8)
    return render(figure, name, f"{title}: {', '.join(rows)} by {', '.join(columns)}")
