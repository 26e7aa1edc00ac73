"""What `airl gap` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from airl_mav.scenario.model import Ports

DEFAULT_MITIGATED = "static-obstacles-ras-pi-4"
"""The shipped policy that was trained as late as the paper's Raspberry Pi decides."""

DEFAULT_WORKLOAD = "template-5x32"
"""The paper's network for No Obstacles, and that of its mitigation: 396 ms on the Raspberry Pi."""

NOT_MITIGATED = "none"
"""What `--mitigated` takes to fly the gap alone."""


@dataclass(frozen=True)
class GapCommand:
    """Measure the hardware gap: what a policy loses on an onboard computer, and with mitigation.

    The policy on a workstation and on the onboard computer; a policy that was trained as late as
    that computer decides, there, in the conditions of its training, and on the workstation. Always
    the same seeds: gaps of success, flight time, distance and energy with 95 % intervals, against
    both references, beside those of the paper. The same --out goes on with what was interrupted.
    """

    policy: str = "static-obstacles"
    """Policy without mitigation: a name, or a path to a folder with policy.onnx and card.json."""

    mitigated: str = DEFAULT_MITIGATED
    """Policy that was trained as late as the computer decides: a name, or a path. none: fly the gap
    without mitigation only."""

    computer: str = "ras-pi-4"
    """Onboard computer: a shipped profile, or a path to a .toml."""

    workload: str | None = None
    """Workload of that computer whose latency t2 is injected; estimate: scaled to the policy. None:
    template-5x32, or what --latency says."""

    latency: str | None = None
    """Latency t2 of that computer, in place of --workload: 150ms, lognormal:396ms,20ms (mean,
    standard deviation), normal:396ms,20ms, COMPUTER/WORKLOAD, or a file of measured latencies, one
    a line in ms, which are replayed in their order."""

    reference: str = "workstation"
    """Computer that the gap is measured from: a shipped profile, or a path to a .toml."""

    reference_workload: str | None = None
    """Workload of the reference. None: the same as --workload if the reference has it; otherwise
    what was measured there for the very policy, or else 1 ms (gym, lockstep), or what this machine
    takes (sitl)."""

    arena: tuple[str, ...] = ("static-obstacles",)
    """Arena profiles: shipped names, or paths to .toml files; of several, each gets its tables."""

    episodes: int = 1000
    """Number of episodes of each policy on each computer in each arena, >= 1."""

    seed: int = 1
    """Seed; episode i uses seed + i, everywhere."""

    level: Literal["gym", "lockstep", "sitl"] = "gym"
    """gym: the batch twin, some hundred episodes a second. lockstep: as airl-sitl --lockstep flies.
    sitl: as airl-sitl flies, in real time times --speed."""

    vehicle: str = "quad"
    """Vehicle profile: a shipped name, or a path to a .toml."""

    workers: int | None = None
    """Level lockstep: processes, each with one flight at a time, 1 to 256. None: as many as there
    are usable cores."""

    speed: float | None = None
    """Simulated seconds per wall second: level sitl 0.5 to 10, level lockstep 0.01 to 1000. None:
    1, or in lockstep as fast as it goes."""

    ports: tyro.conf.OmitArgPrefixes[Ports] = field(default_factory=Ports)
    """Ports of level sitl."""

    out: Path | None = None
    """Folder of the gap: a run folder for each policy on each computer, gap.json, gap.md and
    gap.html. None: runs/<UTC time>-gap-<policy>-<computer>."""
