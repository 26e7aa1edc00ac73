"""What `airl parameters` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro


@dataclass(frozen=True)
class ParametersCommand:
    """Write what real firmware must be set to, to fly a vehicle: for firmware that you start.

    For PX4 a file that QGroundControl loads, for ArduPilot one for its --defaults. Firmware that
    airl-sitl starts is set by itself.
    """

    firmware: tyro.conf.Positional[Literal["px4", "px4-hitl", "ardupilot"]]
    """Whose parameters."""

    vehicle: str = "quad"
    """Vehicle profile: a shipped name, or a path to a .toml."""

    out: Path | None = None
    """File to write. None: printed."""
