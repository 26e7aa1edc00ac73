"""Decision latency of a run: each stage of every decision in flown order, with outliers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.latency.stages import (
    FENCE_RANGES,
    STAGES,
    Fence,
    Samples,
    Stage,
    decision_series,
    fence,
)
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report import document, run_tables, theme
from airl_mav.report.run_figures import latency_figure, long_tail

if TYPE_CHECKING:
    from airl_mav.report.run_report import ReportInput

COLUMNS = 320
"""Maximum number of columns per row; longer runs have several decisions per column."""

MARKED = 40
"""Maximum number of marked outliers per row, longest first."""

BANDS = 40
"""Maximum number of bands that separate flights; longer runs have several flights per band."""

NAMED = 16
"""Maximum number of flights with a label above the rows."""

SLOWEST = 8
"""Number of rows in the table of outlying decisions."""

SAW_DECISIONS = 16
"""Minimum number of decisions for detecting a sawtooth."""

SAW_STEADY = 0.25
"""Maximum interquartile range of the decision period for a sawtooth, as a fraction of the camera's
period."""

OUTLIER_NOTE = (
    f"Marked: above the third quartile by more than {FENCE_RANGES:g} times the interquartile range "
    "(Tukey's outer fence, Exploratory Data Analysis, 1977). A stage of which more than 5 % lie "
    "above it has two kinds of decisions, and no marks."
)


def latency_section(page: ReportInput) -> tuple[document.Section, ...]:
    """Return the latency by stage, every decision, and outliers."""
    run, summary, decisions = page.run, page.summary, timeline_of(page.run)
    measured = [stage for stage in summary.shown_stages if summary.stages[stage.key].n]
    # Constant stages need no figure: the table already shows their value.
    drawn = [stage for stage in measured if np.ptp(summary.samples[stage.key])]
    timeline = document.Section(
        "Every decision, in the order flown",
        level=3,
        draw=lambda: [timeline_figure(decisions, drawn)],
        columns=1,
        note="\n".join([*sawtooth_notes(decisions, page.vehicle), OUTLIER_NOTE]),
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
        *document.tables_section(slowest_table(decisions, measured), level=3),
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
    since_us: NDArray[np.int64]
    """Time of each decision's frame (n,) from the start of navigation [µs]."""

    def __len__(self) -> int:
        """Return the number of decisions."""
        return int(self.starts[-1])

    def flight_of(self, decision: int) -> int:
        """Return the number of a decision's flight."""
        return self.flights[int(np.searchsorted(self.starts, decision, side="right")) - 1]


def timeline_of(run: LoadedRun) -> Timeline:
    """Return the decisions of a run in the order of its flights."""
    began = {episode.index: episode.zero_us for episode in run.episodes}
    flights = [i for i in sorted(began) if len(run.latency.get(i, {}).get("sent_us", ())) > 0]
    series = [decision_series(run.latency[i]) for i in flights]
    keys = decision_series({}).keys()
    nothing: Samples = np.zeros(0, np.int64)
    sizes = [len(run.latency[i]["sent_us"]) for i in flights]
    since = [
        run.latency[i].get("capture_us", np.full(size, began[i])) - began[i]
        for i, size in zip(flights, sizes, strict=True)
    ]
    return Timeline(
        flights=tuple(flights),
        starts=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        stages={key: np.concatenate([nothing, *(part[key] for part in series)]) for key in keys},
        since_us=np.concatenate([nothing, *since]),
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
    alt = "Duration of each stage of every decision in the order flown, outliers marked: " + (
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
    limit = fence(found)
    _mark_outliers(ax, there, found, limit)
    ax.set_title(stage.title, loc="left", y=1.0, fontsize=9, color=theme.INK, pad=3)
    if limit is not None:
        text = _outlier_text(limit)
        ax.set_title(text, loc="right", y=1.0, fontsize=8, color=theme.MARK, pad=3)
    ax.set_ylabel("ms", fontsize=8, color=theme.MUTED)
    ax.yaxis.set_major_locator(MaxNLocator(3))
    if long_tail(np.sort(found) / US_PER_MS):
        theme.logarithmic(ax, "y")
    elif np.ptp(found) == 0:
        value = found[0] / US_PER_MS
        ax.set_ylim(0.0, 2.0 * value if value > 0.0 else 1.0)
    theme.plain_axes(ax)
    ax.grid(False, axis="x")


def _mark_outliers(ax: Axes, there: NDArray[np.int64], found: Samples, limit: Fence | None) -> None:
    if limit is None:
        return
    beyond = np.flatnonzero(limit.marks(found))
    longest = beyond[np.argsort(-found[beyond], kind="stable")[:MARKED]]
    ax.plot(
        there[longest], found[longest] / US_PER_MS, "o", ms=3.4, color=theme.MARK, mew=0, zorder=4
    )


def _outlier_text(limit: Fence) -> str:
    where = f"above {document.ms(limit.limit_us)} ms"
    if limit.second_kind:
        return f"{limit.beyond / limit.n:.0%} {where}: a second kind, not marked"
    if not limit.beyond:
        return "no outliers"
    shown = f", the {MARKED} longest marked" if limit.beyond > MARKED else ""
    return f"{limit.beyond:,} of {limit.n:,} {where}{shown}"


def sawtooth_notes(timeline: Timeline, vehicle: VehicleProfile | None) -> list[str]:
    """Return notes on a sawtooth in frame age, a beat of decision and camera periods."""
    periods = timeline.stages["period"]
    periods = periods[periods != NO_STAMP]
    if vehicle is None or len(periods) < SAW_DECISIONS:
        return []
    frame_us = vehicle.camera.period_us
    low, period, high = np.percentile(periods, (25.0, 50.0, 75.0))
    if high - low > SAW_STEADY * frame_us:
        return []
    notes = []
    for stage in (stage for stage in STAGES if stage.key in ("t1", "wait")):
        found = timeline.stages[stage.key]
        found = found[found != NO_STAMP]
        if len(found) < SAW_DECISIONS or np.ptp(np.percentile(found, (2.0, 98.0))) < 0.5 * frame_us:
            continue
        frames = period / frame_us
        drift_us = float((frames - round(frames)) * frame_us)
        way = "older" if drift_us > 0.0 else "younger"
        notes.append(
            f"The saw in {stage.title} is no fault: the camera takes a frame every "
            f"{document.ms(frame_us, 1)} ms and a decision comes every "
            f"{document.ms(period, 1)} ms, which is {frames:.2f} frames. Each decision finds its "
            f"frame {document.ms(abs(drift_us), 1)} ms {way} "
            "than the one before did, until the next frame takes its place."
        )
    return notes


def slowest_table(timeline: Timeline, stages: Sequence[Stage]) -> document.TableView | None:
    """Return the table of outliers from frame to motors; None without outliers."""
    whole = timeline.stages["end_to_end"]
    there = np.flatnonzero(whole != NO_STAMP)
    limit = fence(whole[there])
    if limit is None or not limit.marks(whole[there]).any():
        return None
    median = float(np.median(whole[there]))
    beyond = there[limit.marks(whole[there])]
    beyond = beyond[np.argsort(-whole[beyond], kind="stable")[:SLOWEST]]
    parts = [s for s in STAGES if s in stages and s.key not in ("end_to_end", "t3")]
    rows = tuple(_slow_row(timeline, int(k), median, parts) for k in beyond)
    columns = document.columns_of(
        "flight | at [s] | end to end [ms] | times the median | <longest part | of it [ms]"
    )
    notes = (
        f"{limit.beyond:,} of {limit.n:,} decisions above {document.ms(limit.limit_us)} ms; "
        f"the {len(rows)} longest. Times from the start of navigation.",
    )
    links = [(timeline.flight_of(int(k)), float(timeline.since_us[k]) / US_PER_S) for k in beyond]
    return document.TableView(
        "slowest", "Decisions that stand out", columns, rows, notes, links=links
    )


def _slow_row(
    timeline: Timeline, decision: int, median_us: float, parts: Sequence[Stage]
) -> tuple[str, ...]:
    whole = int(timeline.stages["end_to_end"][decision])
    spent: Mapping[str, int] = {
        stage.title: int(timeline.stages[stage.key][decision]) for stage in parts
    }
    title = max(spent, key=spent.__getitem__, default="")
    return (
        f"{timeline.flight_of(decision)}",
        f"{timeline.since_us[decision] / US_PER_S:.2f}",
        document.ms(whole),
        f"{whole / median_us:.1f}",
        title,
        document.ms(spent.get(title)),
    )
