"""What `airl sweep` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

DeviceName = Literal["cpu", "cuda"]


@dataclass(frozen=True)
class SweepCommand:
    """Search for the network that flies best: train many, judge all, draw heat maps.

    Air Learning's search over its template: layers x filters, several training seeds a cell. The
    same --out goes on with what was interrupted, whoever was killed.
    """

    sweep: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SWEEP")] = "quick"
    """quick (two cores, an hour), full (the paper's grid), paper (the same on the paper's image,
    for GPUs), tiny (seconds, shows nothing), or a path to a .toml."""

    out: Path | None = None
    """Folder of the sweep. None: runs/sweep-<name>."""

    seeds: int | None = None
    """Training seeds of each cell, 1 to N, 1 to 1000. None: the sweep's."""

    steps: int | None = None
    """Decisions of each training. None: the sweep's."""

    episodes: int | None = None
    """Flights that judge each trained network. None: the sweep's."""

    seed: int | None = None
    """Seed of the first of these flights; flight i has seed + i, in every cell. None: the
    sweep's."""

    computer: str | None = None
    """Computer profile: a shipped name, or a path to a .toml. Each cell then shows its decision
    latency t2 there, estimated from multiply-accumulates. May change when a sweep goes on."""

    workers: int | None = None
    """Trials at a time, 1 to 256, each on one core. None: as many as there are usable cores; with
    --ray auto or HOST:PORT as many as the cluster has room for."""

    ray: str | None = None
    """Let Ray carry out the trials: local starts one here, auto takes the one that runs here, else
    HOST:PORT of a cluster whose machines all see --out. None: processes of this command."""

    device: DeviceName = "cpu"
    """What trains: cpu, one core a trial, or cuda."""

    ray_gpus: float | None = None
    """Share of a GPU that Ray keeps for each trial, 0 to 8. None: 1 with --device cuda, else 0."""

    dry_run: bool = False
    """Say what would be done: trials, parameters, multiply-accumulates, decisions. Nothing is
    trained or written."""
