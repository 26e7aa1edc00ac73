"""Heat maps: grids of coloured fields with their values as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, ListedColormap, LogNorm, Normalize, to_rgb
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from airl_mav.report import theme

CELL_WIDTH_IN, CELL_HEIGHT_IN = 1.12, 0.62
MARGIN_IN = (1.15, 1.05)
"""Width beside and height above the fields [inch], including axes and colour bar."""

LEAST_IN = (4.4, 2.6)
"""Minimum size of a figure [inch], for the titles of small maps."""

DARK_INK, LIGHT_INK = "#010203", "#ffffff"
"""Text colours on bright and dark fields. Fields keep their colours on a dark page, so these must
not be colours of the theme."""

BRIGHT = 0.179
"""Relative luminance at which black and white text have equal contrast."""


@dataclass(frozen=True)
class Field:
    """Field of a heat map."""

    value: float
    text: str
    """Text in the field, at most two lines."""
    marked: bool = False
    """True to draw a frame as a highlight."""


@dataclass(frozen=True)
class HeatMap:
    """Heat map; rows from bottom to top, columns from left to right, missing fields are empty."""

    title: str
    rows: Sequence[int | str]
    row_title: str
    columns: Sequence[int | str]
    column_title: str
    fields: Mapping[Any, Field]
    """Fields by (row, column)."""
    unit: str
    limits: tuple[float, float]
    """Values of the first and the last colour."""
    logarithmic: bool = False
    note: str = field(default="")
    """Small text below the title."""

    @property
    def size_in(self) -> tuple[float, float]:
        """Width and height of the figure [inch]."""
        return (
            max(LEAST_IN[0], MARGIN_IN[0] + CELL_WIDTH_IN * len(self.columns)),
            max(LEAST_IN[1], MARGIN_IN[1] + CELL_HEIGHT_IN * len(self.rows)),
        )


def colours() -> Colormap:
    """Return a colour map from pale to dark, readable in grey and by colour-blind readers."""
    return ListedColormap(colormaps["YlGnBu"](np.linspace(0.06, 0.92, 256)), name="fields")


def heat_picture(name: str, alt: str, heat: HeatMap) -> theme.FigureImage:
    """Draw a heat map as a picture."""
    figure = theme.new_figure(*heat.size_in)
    draw_heat_map(figure, heat)
    return theme.render(figure, name, alt)


def draw_heat_map(figure: Figure | SubFigure, heat: HeatMap) -> Axes:
    """Draw a heat map with its colour bar; return the axes of the fields."""
    ax: Axes = figure.subplots()
    norm = (LogNorm if heat.logarithmic else Normalize)(*heat.limits, clip=True)
    shades = colours()
    for y, row in enumerate(heat.rows):
        for x, column in enumerate(heat.columns):
            _draw_field(ax, x, y, heat.fields.get((row, column)), shades, norm)
    ax.set_xlim(-0.5, len(heat.columns) - 0.5)
    ax.set_ylim(-0.5, len(heat.rows) - 0.5)
    names = [f"{column}" for column in heat.columns]
    tilted: Any = {"rotation": 25, "ha": "right"} if max(map(len, names)) > 12 else {}
    ax.set_xticks(range(len(names)), names, **tilted)
    ax.set_yticks(range(len(heat.rows)), [f"{row}" for row in heat.rows])
    theme.label_axes(ax, heat.column_title, heat.row_title)
    ax.set_title(heat.title, loc="left", fontsize=10.5, color=theme.INK, pad=16 if heat.note else 6)
    if heat.note:
        ax.text(
            0.0,
            1.0,
            heat.note,
            transform=ax.transAxes,
            va="bottom",
            fontsize=8.5,
            color=theme.MUTED,
        )
    theme.plain_axes(ax, grid=False)
    ax.tick_params(labelsize=9, labelcolor=theme.INK)
    bar = figure.colorbar(ScalarMappable(norm, shades), ax=ax, fraction=0.06, pad=0.02)
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=theme.MUTED, labelsize=8, length=0, which="both")
    if heat.logarithmic:
        bar.ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _plain(value)))
        bar.ax.yaxis.set_minor_formatter(NullFormatter())
    bar.set_label(heat.unit, fontsize=8.5, color=theme.MUTED)
    return ax


def _plain(value: float) -> str:
    """Return a number with an SI prefix, such as 200 M."""
    for unit, size in ((" G", 1e9), (" M", 1e6), (" k", 1e3)):
        if value >= size:
            return f"{value / size:g}{unit}"
    return f"{value:g}"


def _draw_field(
    ax: Axes, x: int, y: int, told: Field | None, shades: Colormap, norm: Normalize
) -> None:
    corner = (x - 0.48, y - 0.47)
    if told is None:
        ax.add_patch(
            Rectangle(
                corner, 0.96, 0.94, facecolor="none", edgecolor=theme.RULE, hatch="///", lw=0.6
            )
        )
        return
    colour = shades(norm(told.value))
    ax.add_patch(Rectangle(corner, 0.96, 0.94, facecolor=colour, edgecolor="none"))
    if told.marked:
        # Drawn inside, so that neighbours do not cover it.
        ax.add_patch(
            Rectangle(
                (x - 0.455, y - 0.435),
                0.91,
                0.87,
                facecolor="none",
                edgecolor=theme.MARK,
                lw=2.2,
                zorder=3,
            )
        )
    ax.text(
        x,
        y,
        told.text,
        ha="center",
        va="center",
        fontsize=9,
        linespacing=1.25,
        color=_ink_on(colour),
        zorder=4,
    )


def _ink_on(colour: tuple[float, ...]) -> str:
    """Return the text colour for a background (relative luminance by WCAG 2.1)."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(colour)]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return DARK_INK if luminance > BRIGHT else LIGHT_INK
