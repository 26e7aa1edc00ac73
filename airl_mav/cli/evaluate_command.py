"""What `airl evaluate` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from airl_mav.scenario.model import Ports


@dataclass(frozen=True)
class EvaluateCommand:
    """Fly policies through seeded episodes: success, time, distance and energy with intervals.

    Several policies or arenas give a table of policies x arenas. The same --out goes on with what
    was interrupted; a finished evaluation shows its tables again.
    """

    policies: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="POLICY ...")]
    """Names, or paths to folders with policy.onnx and card.json."""

    arena: tuple[str, ...] = ()
    """Arena profiles: shipped names, or paths to .toml files. None given: those that the policies
    were trained in, or static-obstacles."""

    episodes: int = 100
    """Number of episodes in each arena, >= 1."""

    seed: int = 1
    """Seed; episode i uses seed + i, with every policy and arena."""

    arena_seed: int | None = None
    """Every episode in the arena, and with the goal, of this one seed. None: of its own."""

    level: Literal["gym", "lockstep", "sitl"] = "gym"
    """gym: the batch twin, some hundred episodes a second. lockstep: as airl-sitl --lockstep flies,
    the same every time, bit by bit, on all cores. sitl: as airl-sitl flies, in real time times
    --speed."""

    ablate: Literal["depth", "velocity", "goal"] | None = None
    """Input of the network that is made zero, not at level sitl. None: none."""

    vehicle: str = "quad"
    """Vehicle profile: a shipped name, or a path to a .toml."""

    computer: str = "workstation"
    """Computer profile to fly as: a shipped name, or a path to a .toml."""

    workload: str | None = None
    """Workload of the computer profile whose latency t2 is injected; estimate: scaled to the
    policy. None: what was measured for this very policy, or else 1 ms (gym, lockstep), or what this
    machine takes (sitl)."""

    latency: str | None = None
    """Latency t2 to inject, in place of --workload: 150ms, lognormal:396ms,20ms (mean, standard
    deviation), normal:396ms,20ms, COMPUTER/WORKLOAD, or a file of measured latencies, one a line in
    ms, which are replayed in their order. None: as --computer and --workload say."""

    latency_seed: int = 0
    """Other draws of the same latency on the same episodes; 0: those of the episodes' own seeds."""

    goal_radius: float | None = None
    """The goal is reached closer than this, seen from above, m. None: that of the policy's card,
    or 3."""

    time_limit: float | None = None
    """Longest flight from the start of navigation, s. None: 120."""

    hold: float | None = None
    """t3: how long an action is held before the next observation, s. None: that of the policy's
    card, or 0.5."""

    hover_after: float | None = None
    """Zero the velocity so long after the hold when no new action has come, s. None: as the
    policy's card says, or never."""

    altitude: float | None = None
    """Height above the start that is flown, m. None: that of the policy's card, or 2.5."""

    slots: int = 128
    """Flights at a time at level gym, >= 1. Decides the pace, not the results."""

    workers: int | None = None
    """Level lockstep: processes, each with one flight at a time, 1 to 256. Decides the pace, not
    the results. None: as many as there are usable cores."""

    tlogs: bool = False
    """Level lockstep: write the MAVLink log of every flight. Level sitl always does."""

    speed: float | None = None
    """Simulated seconds per wall second: level sitl 0.5 to 10, level lockstep 0.01 to 1000. None:
    1, or in lockstep as fast as it goes."""

    ports: tyro.conf.OmitArgPrefixes[Ports] = field(default_factory=Ports)
    """Ports of level sitl."""

    on_card: bool = False
    """Write the results onto the policies' cards, in place of earlier ones of the same arena,
    level and latency."""

    out: Path | None = None
    """Run folder, or with several policies or arenas the folder of their run folders. None:
    runs/<UTC time>-evaluate-..."""
