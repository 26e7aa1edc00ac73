"""What `airl ladder` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from airl_mav.scenario.model import Ports

LevelName = Literal["gym", "lockstep", "sitl"]

SITL_EPISODES = 10
"""Episodes at level sitl unless asked for: they take real time."""


@dataclass(frozen=True)
class LadderCommand:
    """Fly the same policy and seeds at several levels of fidelity, and say what differs.

    Success, flight time, distance and energy side by side, with the differences from the first
    level on the same seeds and their 95 % intervals. The same --out goes on with what was
    interrupted.
    """

    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
    """A name, or a path to a folder with policy.onnx and card.json."""

    arena: str | None = None
    """Arena profile: a shipped name, or a path to a .toml. None: that which the policy was trained
    in, or static-obstacles."""

    episodes: int = 100
    """Number of episodes at each level, >= 1."""

    seed: int = 1
    """Seed; episode i uses seed + i, at every level."""

    arena_seed: int | None = None
    """Every episode in the arena, and with the goal, of this one seed. None: of its own."""

    levels: tuple[LevelName, ...] = ("gym", "lockstep", "sitl")
    """Levels that fly, two or more; the first is the reference of the others."""

    sitl_episodes: int | None = None
    """Number of episodes at level sitl, which flies in real time times --speed; the first ones of
    the seeds. None: 10, or --episodes if that is fewer."""

    workers: int | None = None
    """Level lockstep: processes, each with one flight at a time, 1 to 256. None: as many as there
    are usable cores."""

    speed: float = 1.0
    """Level sitl: simulated seconds per wall second, 0.5 to 10."""

    vehicle: str = "quad"
    """Vehicle profile: a shipped name, or a path to a .toml."""

    computer: str = "workstation"
    """Computer profile to fly as: a shipped name, or a path to a .toml."""

    workload: str | None = None
    """Workload of the computer profile whose latency t2 is injected; estimate: scaled to the
    policy. None: what was measured for this very policy, or else 1 ms (gym, lockstep), or what
    this machine takes (sitl)."""

    latency: str | None = None
    """Latency t2 to inject, in place of --workload: 150ms, lognormal:396ms,20ms (mean, standard
    deviation), normal:396ms,20ms, COMPUTER/WORKLOAD, or a file of measured latencies, one a line in
    ms, which are replayed in their order. None: as --computer and --workload say."""

    latency_seed: int = 0
    """Other draws of the same latency on the same episodes; 0: those of the episodes' own seeds."""

    ports: tyro.conf.OmitArgPrefixes[Ports] = field(default_factory=Ports)
    """Ports of level sitl."""

    out: Path | None = None
    """Folder of the ladder: a run folder for each level, ladder.json and ladder.html. None:
    runs/<UTC time>-ladder-<policy>-<arena>."""

    def episodes_at(self, level: str) -> int:
        """Return the number of episodes at a level."""
        if level != "sitl":
            return self.episodes
        fewer = SITL_EPISODES if self.sitl_episodes is None else self.sitl_episodes
        return min(fewer, self.episodes)
