"""What `airl profile` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from airl_mav.policy.runtime import RuntimeName
from airl_mav.scenario.model import Ports

ProfileLevel = Literal["bare", "sitl", "hil"]


@dataclass(frozen=True)
class ProfileCommand:
    """Measure how long this computer takes for a policy's decisions: a computer profile.

    Phase 1 of the method: the samples that it writes are what --computer and --workload replay at
    every level of fidelity.
    """

    policy: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[POLICY]")] = None
    """Policy to measure: a name, or a path to a folder with policy.onnx and card.json. None: the
    default policy, or with --network a random one."""

    network: str | None = None
    """LAYERSxFILTERS of a randomly initialised network of the paper's template to measure instead
    of a policy, as 5x32; needs the [profile] extra. Latency depends on the weights' shapes, not on
    their values."""

    image: str = "256x154"
    """With --network: width x height of the image that the network sees, px."""

    level: ProfileLevel = "bare"
    """bare: inference alone, here. sitl: in flight, through airl-sitl's processes: all stages.
    hil: here, against an airl-firmware that runs elsewhere."""

    decisions: int = 1000
    """Decisions to measure, 10 to 100000, after the warm-up."""

    warm_up: int = 50
    """Decisions before those that count, >= 1; their latency is told apart."""

    runtime: RuntimeName = "onnx"
    """What runs the network; torch needs the policy's policy.pt2."""

    threads: int = 1
    """Threads of one inference."""

    hold: float | None = None
    """Levels sitl and hil, t3: how long an action is held before the next observation, s. Short,
    and flown at walking pace: timing is measured, not flying well. None: 0.05."""

    on: str | None = None
    """Name of the computer: its profile is <out>/<name>.toml. None: after its processor."""

    workload: str | None = None
    """Name of the workload in the profile. None: after policy, level, runtime and threads. One of
    the same name is replaced."""

    watts: float | None = None
    """Power that the computer draws, W: nothing here measures it. None: that of an existing
    profile, or 0."""

    price: float | None = None
    """Price of the computer, USD. None: that of an existing profile, or none."""

    seed: int = 1
    """Seed of the random network, of the observations at level bare, and of the flights."""

    vehicle: str | None = None
    """Vehicle profile whose camera is seen through: a shipped name, or a path to a .toml. None: the
    first shipped one whose camera fits."""

    ports: tyro.conf.OmitArgPrefixes[Ports] = field(default_factory=Ports)
    """Ports of level sitl."""

    connect: str = "udpin://127.0.0.1:14540"
    """Level hil: MAVSDK connection to the flight controller: udpin://HOST:PORT or
    serial://DEVICE:BAUD."""

    camera: str = "tcp://127.0.0.1:5600"
    """Level hil: ZeroMQ address of the depth camera."""

    out: Path = Path("computers")
    """Folder of the profile and its samples."""
