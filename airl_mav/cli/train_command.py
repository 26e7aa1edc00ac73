"""What `airl train` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class TrainCommand:
    """Train a policy; the best weights are exported as policy.onnx with their card."""

    config: tyro.conf.Positional[str] = "static-obstacles"
    """Training configuration: a shipped name, or a path to a .toml."""

    out: Path | None = None
    """Folder of the run. None: runs/train-<config>."""

    seed: int | None = None
    """Seed of weights, exploration and episodes. None: the configuration's."""

    computer: str | None = None
    """Decide as late as this computer in training: a shipped profile, or a path to a .toml; takes
    --workload. None: the configuration's."""

    workload: str | None = None
    """Workload of that computer whose latency t2 is drawn in every decision; estimate is not
    accepted: the network is not there yet. None: the configuration's."""

    latency: tuple[str, ...] = ()
    """Sources of t2 in place of computer and workload, as airl evaluate takes them: 150ms,
    lognormal:396ms,20ms, COMPUTER/WORKLOAD, FILE. Of several, each episode draws one: latency
    randomisation over several computers. None given: the configuration's."""

    sensing_distance: float | None = None
    """Scale the actions to the safe velocity: the vehicle, deciding as late as its longest latency,
    stops within so many metres. None: the configuration's, or no scaling."""

    max_acceleration: float | None = None
    """Greatest deceleration for the safe velocity, m/s²; takes --sensing-distance. None: what the
    vehicle's tilt limit and thrust permit."""

    steps: int | None = None
    """Decisions of all vehicles together. None: the configuration's."""

    name: str | None = None
    """Name of the policy on its card. None: the configuration's."""

    resume: bool = False
    """Go on with the run in --out from its newest checkpoint; begin it when there is none."""
