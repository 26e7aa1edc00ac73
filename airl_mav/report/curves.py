"""Figures over latency: a line with intervals for each series, the paper's points beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes

from airl_mav.flight.statistics import Estimate
from airl_mav.report import theme


@dataclass(frozen=True)
class Series:
    """One line."""

    name: str
    points: Sequence[tuple[float, Estimate]]
    """Where along the axis, and what was found there; those of no value are left out."""


def curves_picture(
    name: str,
    title: str,
    labels: tuple[str, str],
    series: Sequence[Series],
    paper: Sequence[tuple[float, float]] = (),
) -> theme.Picture:
    """Draw series over a common axis.

    Args:
        name: File name without suffix.
        title: What is drawn.
        labels: Of both axes, with their units.
        series: The lines; intervals are drawn where they are known.
        paper: Points that the paper has.
    """
    figure = theme.new_figure(4.2, 3.0 + 0.2 * (len(series) + bool(paper)))
    ax: Axes = figure.subplots()
    for index, line in enumerate(series):
        colour, dashes = theme.line_style(index)
        known = [(x, e) for x, e in line.points if e.value is not None]
        x = [at for at, _ in known]
        y = [e.value or 0.0 for _, e in known]
        low = [y[i] - (y[i] if e.low is None else e.low) for i, (_, e) in enumerate(known)]
        high = [(y[i] if e.high is None else e.high) - y[i] for i, (_, e) in enumerate(known)]
        ax.errorbar(
            x,
            y,
            yerr=[low, high],
            color=colour,
            ls=dashes,
            marker="o",
            ms=4,
            lw=1.6,
            capsize=2.5,
            label=line.name,
        )
    if paper:
        at, values = zip(*paper, strict=True)
        ax.plot(
            at, values, ls="none", marker="D", ms=5, color=theme.MARK, mfc="none", label="the paper"
        )
    theme.label_axes(ax, *labels, title)
    ax.set_xlim(left=0.0)
    theme.plain_axes(ax)
    theme.legend_below(figure, 1)
    told = ", ".join(line.name for line in series)
    return theme.render(figure, name, f"{title} over {labels[0]}: {told}")
