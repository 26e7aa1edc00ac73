"""`airl computers`: contents of computer profiles, with their sources."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.table import Table

from airl_mav.cli.options import POSITIONAL
from airl_mav.core import fields, progress
from airl_mav.profiles import computer, loading

SAYS = (
    "measured: samples of that machine, replayed in their order. published: mean and spread that"
    " its source gives. Any other network is estimated by its multiply-accumulates: --workload"
    " estimate."
)


class ComputersOptions(fields.ProfileModel):
    """List computer profiles with the latency, origin and source of their workloads.

    Examples:
        airl computers
        airl computers computers/my-pi.toml shared/jetson.toml
    """

    profiles: Annotated[tuple[str, ...], POSITIONAL] = Field(
        default=(),
        description="shipped names, or paths to .toml files; by default all shipped ones",
    )


OPTIONS = ComputersOptions


def run(options: ComputersOptions, console: Console | None = None) -> int:
    """Print the table. Returns exit status 0; raises UsageError for an invalid profile."""
    console = console or progress.new_console()
    names = options.profiles or tuple(loading.list_profiles("computers"))
    console.print(_table(names))
    console.print(SAYS, highlight=False)
    return 0


def _table(names: Sequence[str]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for title in ("computer", "workload", "origin"):
        table.add_column(title, overflow="fold")
    table.add_column("t2, mean ms", justify="right")
    table.add_column("source", overflow="fold")
    for name in names:
        profile = computer.load_computer(name)
        table.add_row(name, "", "", "", f"{profile.cpu}; {profile.watts:g} W", style="dim")
        for key, work in profile.workloads.items():
            mean_ms = f"{_mean_ms(work.latency):.3g}"
            table.add_row("", key, work.origin, mean_ms, _source(work))
    return table


def _mean_ms(latency: computer.LatencyDistribution) -> float:
    if latency.samples_ms is not None:
        return float(np.mean(latency.samples_ms))
    return latency.mean_ms or 0.0


def _source(work: computer.Workload) -> str:
    how = work.measured
    if how is None:
        return work.source
    return f"{work.source}; {how.machine}; samples {how.samples_sha256[:12]}"
