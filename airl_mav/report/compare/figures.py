"""The figures of a comparison: distributions of latency, energy of airframe and computer."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from airl_mav.latency.stages import ALL_STAGES, Samples
from airl_mav.report.compare.build import Compared, Side
from airl_mav.report.figures import LONG_TAIL, quiet
from airl_mav.report.palette import look
from airl_mav.report.tables import US_PER_MS
from airl_mav.report.theme import (
    INK,
    MUTED,
    PAPER,
    RULE,
    SERIES,
    SERIES_SOFT,
    Picture,
    new_figure,
    render,
    render_png,
)

CDF_STAGES = ("t2", "end_to_end")
"""Stages whose distributions are drawn over each other."""

CDF_POINTS = 400
"""A drawn distribution has at most this many steps: more are not seen, and weigh."""

NAME_COLUMNS = 26
"""A name beside an axis is broken into lines of so many letters."""


def cdf_pictures(compared: Compared) -> list[Picture]:
    """Draw the cumulated distributions of all runs, one picture a stage that has samples."""
    pictures = []
    for key in CDF_STAGES:
        if sides := _with_samples(compared, key):
            figure = new_figure(5.2, 3.2 + 0.2 * len(sides))
            _draw_cdf(figure, sides, key)
            told = ", ".join(side.name for _, side in sides)
            alt = f"Cumulated distributions of {_title(key)}: {told}"
            pictures.append(render(figure, f"compare-{key.replace('_', '-')}", alt))
    return pictures


def cdf_sheet(compared: Compared) -> bytes | None:
    """Draw the same on one sheet; return the PNG, None when there is nothing to draw."""
    keys = [key for key in CDF_STAGES if _with_samples(compared, key)]
    if not keys:
        return None
    figure = new_figure(5.2 * len(keys), 3.2 + 0.2 * len(compared.sides))
    for part, key in zip(
        np.ravel(figure.subfigures(1, len(keys), squeeze=False)), keys, strict=True
    ):
        part.set_facecolor(PAPER)
        _draw_cdf(part, _with_samples(compared, key), key)
    return render_png(figure)


def _with_samples(compared: Compared, key: str) -> list[tuple[int, Side]]:
    """Return the runs that timed a stage, with their numbers."""
    return [(i, side) for i, side in enumerate(compared.sides) if side.summary.stages[key].n]


def _title(key: str) -> str:
    return next(stage.title for stage in ALL_STAGES if stage.key == key)


def _draw_cdf(figure: Figure | SubFigure, sides: Sequence[tuple[int, Side]], key: str) -> None:
    """Draw the distributions of one stage."""
    ax: Axes = figure.subplots()
    medians, greatest, least = [], 0.0, np.inf
    for index, side in sides:
        at_ms, share = _steps(side.summary.samples[key])
        colour, dashes = look(index)
        n = side.summary.stages[key].n
        ax.step(
            at_ms,
            share,
            where="post",
            color=colour,
            ls=dashes,
            lw=1.7,
            label=f"{side.name} (n = {n:,})",
        )
        medians.append(float(np.median(at_ms)))
        greatest, least = max(greatest, at_ms[-1]), min(least, at_ms[0])
    if least > 0.0 and greatest > LONG_TAIL * min(medians):
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())
    else:
        ax.set_xlim(left=0.0)
    ax.set_ylim(0, 103)
    ax.set_yticks([0, 25, 50, 75, 100])
    ax.set_title(_title(key), loc="left", fontsize=10.5, color=INK, pad=6)
    ax.set_xlabel("ms", fontsize=8.5, color=MUTED)
    ax.set_ylabel("decisions that took no longer [%]", fontsize=8.5, color=MUTED)
    quiet(ax)
    figure.legend(
        loc="outside lower left", ncols=1, frameon=False, fontsize=8, labelcolor=INK, handlelength=3
    )


def _steps(samples: Samples) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return durations [ms] and the share of samples up to each [%], from 0 to 100."""
    values = np.sort(samples) / US_PER_MS
    count = min(len(values), CDF_POINTS)
    rank = np.unique(np.linspace(0, len(values) - 1, count).astype(int))
    share = 100.0 * (rank + 1) / len(values)
    at = values[rank]
    return np.concatenate([at[:1], at]), np.concatenate([[0.0], share])


def energy_figure(compared: Compared) -> Picture:
    """Draw the mean energy of a successful flight, split into airframe and computer."""
    sides = [side for side in compared.sides if side.summary.quality.energy_j.value is not None]
    figure = new_figure(6.4, 1.3 + 0.55 * len(sides))
    ax: Axes = figure.subplots()
    airframe = [1e-3 * (side.summary.quality.energy_j.value or 0.0) for side in sides]
    computer = [1e-3 * (side.summary.quality.computer_energy_j.value or 0.0) for side in sides]
    rows = np.arange(len(sides))
    ax.barh(rows, airframe, height=0.55, color=SERIES, label="airframe")
    ax.barh(rows, computer, left=airframe, height=0.55, color=SERIES_SOFT, label="computer")
    widest = max((a + c for a, c in zip(airframe, computer, strict=True)), default=1.0)
    for row, (a, c) in enumerate(zip(airframe, computer, strict=True)):
        share = 100.0 * c / (a + c) if a + c else 0.0
        ax.annotate(
            f"{a:.2f} + {c:.2f} kJ, computer {share:.1f} %",
            (a + c, row),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=INK,
        )
    names = ["\n".join(textwrap.wrap(side.name, NAME_COLUMNS)) for side in sides]
    ax.set_yticks(rows, names)
    ax.set_ylim(len(sides) - 0.5, -0.5)
    ax.set_xlim(0.0, 1.55 * widest)
    ax.set_xlabel("mean energy of a flight that reached the goal [kJ]", fontsize=8.5, color=MUTED)
    quiet(ax)
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", labelsize=8.5, labelcolor=INK)
    ax.spines["bottom"].set_color(RULE)
    figure.legend(loc="outside lower left", ncols=2, frameon=False, fontsize=8, labelcolor=INK)
    told = ", ".join(side.name for side in sides)
    return render(figure, "compare-energy", f"Energy of airframe and computer: {told}")
