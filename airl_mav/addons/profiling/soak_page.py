"""Page of a soak: latency, frequency, temperature, power over time. Needs the [sim] extra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from airl_mav.addons.profiling.soak import Soak
from airl_mav.core.provenance import package_versions
from airl_mav.latency.percentiles import summarize
from airl_mav.report import theme
from airl_mav.report.document import (
    DURATION_COLUMNS,
    Column,
    Document,
    Section,
    TableView,
    duration_cells,
    provenance_facts,
    write_document,
)

AXES = (
    ("frequency_mhz", "frequency", "MHz"),
    ("temperature_c", "temperature", "°C"),
    ("power_w", "power", "W"),
)
"""Columns of machine readings, drawn below the latency."""

LONG_TAIL = 5.0
"""Ratio of maximum latency to median above which the axis is logarithmic."""


def write_soak_page(
    soaked: Soak,
    folder: Path,
    name: str,
    title: str,
    facts: Sequence[tuple[str, str]],
    machine: Mapping[str, Any],
) -> Path:
    """Write the page of a soak with its Markdown and picture into a folder; return the page."""
    rows = tuple(
        (part, *duration_cells(summarize(samples)))
        for part, samples in (("first", soaked.first_us), ("last", soaked.last_us))
    )
    table = TableView(
        "soak",
        f"t2 in the first and the last {soaked.window_s:.0f} s",
        (Column("part", number=False), *DURATION_COLUMNS),
        rows,
        ("Milliseconds.",),
    )
    section = Section(
        "Over time",
        tables=(table,),
        draw=lambda: [soak_figure(soaked, name)],
        note="Latency t2 of each second's decisions: line, their median; shade, up to the longest.",
    )
    versions = package_versions()
    document = Document(
        name=name,
        title=title,
        kicker="Thermal soak",
        sections=(section,),
        answers=(soaked.sentence(),),
        facts=tuple(facts),
        facts_title="What decided",
        provenance=provenance_facts(machine, None, versions),
        footer=f"airl-mav {versions['airl-mav']} · the series beside this page in {name}.npz",
    )
    return write_document(document, folder)


def soak_figure(soaked: Soak, name: str) -> theme.FigureImage:
    """Draw the series, one below the other."""
    series = soaked.series
    told = [axis for axis in AXES if np.isfinite(series[axis[0]]).any()]
    figure = theme.new_figure(10.6, 2.6 + 1.4 * len(told))
    heights = [2.0, *(1.0 for _ in told)]
    axes = np.atleast_1d(
        figure.subplots(len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights})
    )
    minutes = series["time_s"] / 60.0
    axes[0].fill_between(minutes, series["p50_ms"], series["max_ms"], color=theme.SERIES_SOFT, lw=0)
    axes[0].plot(minutes, series["p50_ms"], color=theme.SERIES, lw=1.0)
    if series["max_ms"].max() > LONG_TAIL * np.median(series["p50_ms"]):
        theme.logarithmic(axes[0], "y")
    else:
        axes[0].set_ylim(bottom=0.0)
    theme.label_axes(axes[0], y="ms", title="latency t2")
    for ax, (column, title, unit) in zip(axes[1:], told, strict=True):
        ax.plot(minutes, series[column], color=theme.MARK, lw=1.0)
        theme.label_axes(ax, y=unit, title=title)
    for ax in axes:
        theme.plain_axes(ax)
    theme.label_axes(axes[-1], "min since the beginning of the soak")
    shown = ", ".join(["latency t2", *(title for _, title, _ in told)])
    return theme.render(figure, name, f"{shown} over the time of the soak")
