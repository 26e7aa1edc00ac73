"""Decision latency of a run: each stage of every decision in flown order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_MS
from airl_mav.latency.stages import (
    Samples,
    Stage,
    decision_series,
)
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report import document, run_tables, theme
from airl_mav.report.run_figures import latency_figure, long_tail

if TYPE_CHECKING:
    from airl_mav.report.run_report import ReportInput

COLUMNS = 320
"""Maximum number of columns per row; longer runs have several decisions per column."""

BANDS = 40
"""Maximum number of bands that separate flights; longer runs have several flights per band."""

NAMED = 16
"""Maximum number of flights with a label above the rows."""


def latency_section(page: ReportInput) -> tuple[document.Section, ...]:
    """Return the latency by stage, and every decision."""
    run, summary, decisions = page.run, page.summary, timeline_of(page.run)
    measured = [stage for stage in summary.shown_stages if summary.stages[stage.key].n]
    # Constant stages need no figure: the table already shows their value.
    drawn = [stage for stage in measured if np.ptp(summary.samples[stage.key])]
    timeline = document.Section(
        "Every decision, in the order flown",
        level=3,
        draw=lambda: [timeline_figure(decisions, drawn)],
        columns=1,
    )
    return (
        *document.tables_section(
            run_tables.latency_table(summary),
            run_tables.ages_table(run_tables.run_ages(run), summary.stages["end_to_end"]),
            draw=lambda: [
                latency_figure(s, summary.samples[s.key], summary.stages[s.key]) for s in drawn
            ],
            sheet="latency.png",
            columns=document.SHEET_COLUMNS,
            template="latency.html.j2",
        ),
        *((timeline,) if drawn and len(decisions) else ()),
    )


@dataclass(frozen=True)
class Timeline:
    """Decisions of a run in flown order."""

    flights: tuple[int, ...]
    """Numbers of the flights with decisions."""
    starts: NDArray[np.int64]
    """First decision of each flight, then the total number n of decisions (k + 1,)."""
    stages: dict[str, Samples]
    """Duration of each stage (n,) [µs] by stage key; `NO_STAMP` if missing."""

    def __len__(self) -> int:
        """Return the number of decisions."""
        return int(self.starts[-1])


def timeline_of(run: LoadedRun) -> Timeline:
    """Return the decisions of a run in the order of its flights."""
    indices = sorted(episode.index for episode in run.episodes)
    flights = [i for i in indices if len(run.latency.get(i, {}).get("sent_us", ())) > 0]
    series = [decision_series(run.latency[i]) for i in flights]
    keys = decision_series({}).keys()
    nothing: Samples = np.zeros(0, np.int64)
    sizes = [len(run.latency[i]["sent_us"]) for i in flights]
    return Timeline(
        flights=tuple(flights),
        starts=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        stages={key: np.concatenate([nothing, *(part[key] for part in series)]) for key in keys},
    )


def timeline_figure(timeline: Timeline, stages: Sequence[Stage]) -> theme.FigureImage:
    """Draw the stages (at least one) of all decisions in flown order."""
    margins = theme.Margins(left=0.62, right=0.12, bottom=0.42, top=0.22, between=0.26)
    figure, rows = theme.stacked_axes(len(stages), 10.6, 0.62 + 1.0 * len(stages), margins)
    band = _draw_bands(rows, timeline)
    for ax, stage in zip(rows, stages, strict=True):
        _draw_stage(ax, stage, timeline.stages[stage.key])
    per = -(-len(timeline) // COLUMNS)
    label = "decision, in the order flown; bands: " + (
        "flights" if band == 1 else f"{band} flights each"
    )
    if per > 1:
        label += f"; line: median of {per} decisions, shade: least to greatest"
    theme.label_axes(rows[-1], label)
    rows[-1].set_xlim(-0.5, len(timeline) - 0.5)
    rows[-1].xaxis.set_major_locator(MaxNLocator(10, integer=True))
    for ax in rows[:-1]:
        ax.xaxis.set_visible(False)
    alt = "Duration of each stage of every decision in the order flown: " + (
        ", ".join(stage.title for stage in stages)
    )
    return theme.render(figure, "latency-timeline", alt)


def _draw_bands(rows: NDArray[np.object_], timeline: Timeline) -> int:
    """Shade every other flight or group of flights; return the number of flights per band."""
    count, per = len(timeline.flights), 1
    while count > BANDS * per:
        # 1, 2, 5, 10, 20, 50, ...
        per = per * 5 // 2 if f"{per}"[0] == "2" else 2 * per
    edges = timeline.starts[::per]
    if edges[-1] != len(timeline):
        edges = np.append(edges, len(timeline))
    for k in range(0, len(edges) - 1, 2):
        for ax in rows:
            ax.axvspan(
                edges[k] - 0.5, edges[k + 1] - 0.5, color=theme.RULE, alpha=0.4, lw=0, zorder=0
            )
    if count <= NAMED:
        for number, start, end in zip(
            timeline.flights, timeline.starts[:-1], timeline.starts[1:], strict=True
        ):
            rows[0].annotate(
                f"{'flight ' if count <= 8 else ''}{number}",
                (0.5 * (start + end - 1), 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(0, -2),
                textcoords="offset points",
                ha="center",
                va="top",
                fontsize=7.5,
                color=theme.MUTED,
                zorder=5,
                bbox={"facecolor": theme.PAPER, "edgecolor": "none", "pad": 0.8, "alpha": 0.75},
            )
    return per


def _draw_stage(ax: Axes, stage: Stage, durations: Samples) -> None:
    there = np.flatnonzero(durations != NO_STAMP)
    found = durations[there]
    edges = np.linspace(0, len(durations), min(len(durations), COLUMNS) + 1).astype(int)
    # Limits of each column among the decisions with this stage.
    cuts = np.searchsorted(there, edges)
    middle = np.full((3, len(edges) - 1), np.nan)
    for k, (start, end) in enumerate(pairwise(cuts)):
        if end > start:
            part = found[start:end]
            middle[:, k] = part.min(), np.median(part), part.max()
    middle /= US_PER_MS
    x = 0.5 * (edges[:-1] + edges[1:] - 1)
    if len(durations) > COLUMNS:
        ax.fill_between(x, middle[0], middle[2], color=theme.SERIES_SOFT, lw=0, zorder=2)
    ax.plot(x, middle[1], color=theme.SERIES, lw=0.9, zorder=2.5)
    ax.set_title(stage.title, loc="left", y=1.0, fontsize=9, color=theme.INK, pad=3)
    ax.set_ylabel("ms", fontsize=8, color=theme.MUTED)
    ax.yaxis.set_major_locator(MaxNLocator(3))
    if long_tail(np.sort(found) / US_PER_MS):
        theme.logarithmic(ax, "y")
    elif np.ptp(found) == 0:
        value = found[0] / US_PER_MS
        ax.set_ylim(0.0, 2.0 * value if value > 0.0 else 1.0)
    theme.plain_axes(ax)
    ax.grid(False, axis="x")
