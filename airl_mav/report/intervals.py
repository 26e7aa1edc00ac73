"""Rows of estimates with their intervals on one axis, around the line of zero."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes

from airl_mav.flight.statistics import Estimate
from airl_mav.report.figures import quiet
from airl_mav.report.theme import INK, MUTED, PAPER, RULE, SERIES


def draw_estimate(ax: Axes, row: int, estimate: Estimate, told: str, colour: str) -> list[float]:
    """Draw a row: the estimate, its interval, and what is told of it at the right end.

    Args:
        ax: Where to.
        row: Its number, from the top.
        estimate: Without a value only the words are drawn.
        told: The words.
        colour: Of the words.

    Returns:
        The numbers that the axis must hold.
    """
    ax.annotate(
        told,
        (1.0, row - 0.15),
        xycoords=("axes fraction", "data"),
        ha="right",
        va="bottom",
        fontsize=8,
        color=colour,
    )
    if estimate.value is None:
        return []
    ends = [estimate.value]
    if estimate.low is not None and estimate.high is not None:
        low_high = [estimate.low, estimate.high]
        ax.plot(low_high, [row, row], color=SERIES, lw=2.2, solid_capstyle="butt")
        ends += low_high
    ax.plot(estimate.value, row, "o", ms=6, color=SERIES, mec=PAPER, mew=1.0, zorder=4)
    return ends


def finish_rows(
    ax: Axes, names: Sequence[str], ends: Sequence[float], title: str, unit: str
) -> None:
    """Set up the axis of rows: names from top to bottom, zero as a line.

    Args:
        ax: Where to.
        names: One a row.
        ends: All that was drawn; zero always stays inside.
        title: Of the axis.
        unit: What lies along it.
    """
    ax.axvline(0.0, color=MUTED, lw=1.0, zorder=1)
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.65)
    held = [0.0, *ends]
    # A row without any difference still has an axis.
    room = 0.08 * (max(held) - min(held)) or 1.0
    ax.set_xlim(min(held) - room, max(held) + room)
    ax.set_title(title, loc="left", fontsize=10.5, color=INK, pad=6)
    ax.set_xlabel(unit, fontsize=8.5, color=MUTED)
    quiet(ax)
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", labelsize=8.5, labelcolor=INK)
    ax.spines["bottom"].set_color(RULE)
