"""Grouped bars with intervals, and what the paper has as marks on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from airl_mav.flight.statistics import Estimate
from airl_mav.report import theme


@dataclass(frozen=True)
class Bar:
    """One bar: a rate, and the paper's figure for it."""

    rate: Estimate
    """Fraction, 0 to 1; of no value: nothing is drawn."""
    paper_percent: float | None = None


@dataclass(frozen=True)
class Group:
    """Bars that stand together, one for each series, in their order."""

    name: str
    bars: Sequence[Bar]


def bars_picture(
    name: str, title: str, series: Sequence[str], groups: Sequence[Group], unit: str = "success [%]"
) -> theme.Picture:
    """Draw rates in percent.

    Args:
        name: File name without suffix.
        title: What is drawn.
        series: Names of the bars of a group, in their order.
        groups: One or more, from left to right.
        unit: What the bars measure.
    """
    figure = theme.new_figure(1.4 + 1.5 * len(groups), 3.4)
    ax: Axes = figure.subplots()
    width = 0.8 / len(series)
    marked = False
    for g, group in enumerate(groups):
        for i, bar in enumerate(group.bars):
            at = g + (i - 0.5 * (len(series) - 1)) * width
            if bar.rate.value is not None:
                _draw_bar(ax, at, width, bar.rate, theme.line_style(i).colour)
            if bar.paper_percent is not None:
                marked = True
                ax.plot(
                    at, bar.paper_percent, marker="D", ms=6, color=theme.MARK, mfc="none", mew=1.5
                )
    ax.set_xticks(np.arange(len(groups)), [group.name for group in groups])
    ax.set_ylim(0, 108)
    ax.set_yticks([0, 25, 50, 75, 100])
    theme.label_axes(ax, "", unit, title)
    theme.plain_axes(ax)
    ax.grid(False, axis="x")
    ax.tick_params(axis="x", labelsize=8.5, labelcolor=theme.INK)
    handles: list[Patch | Line2D] = [
        Patch(color=theme.line_style(i).colour, label=text) for i, text in enumerate(series)
    ]
    if marked:
        handles.append(
            Line2D([], [], ls="none", marker="D", color=theme.MARK, mfc="none", label="the paper")
        )
    theme.legend_below(figure, 3, handles=handles)
    told = ", ".join(group.name for group in groups)
    return theme.render(figure, name, f"{title}: {', '.join(series)} in {told}")


def _draw_bar(ax: Axes, at: float, width: float, rate: Estimate, colour: str) -> None:
    """Draw one bar with its interval and its figure."""
    value = 100.0 * (rate.value or 0.0)
    ax.bar(at, value, width=0.9 * width, color=colour)
    if rate.low is not None and rate.high is not None:
        ax.plot([at, at], [100.0 * rate.low, 100.0 * rate.high], color=theme.INK, lw=1.2)
    ax.annotate(
        f"{value:.0f}",
        (at, 100.0 * (rate.high if rate.high is not None else rate.value or 0.0)),
        xytext=(0, 2),
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=7.5,
        color=theme.INK,
    )
