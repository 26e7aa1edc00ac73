"""What `airl conformance` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ConformanceCommand:
    """Fly any flight controller through checks and step responses: airl-firmware, PX4, ArduPilot.

    SITL or a board. It takes off. Once through it needs 60 m to the north, 20 m to the east and
    15 m above the take-off altitude; Ctrl-C lands.
    """

    connect: str = "udpin://127.0.0.1:14540"
    """MAVSDK connection to the flight controller: udpin://HOST:PORT or serial://DEVICE:BAUD."""

    reference: str = "auto"
    """Stored step responses to compare with: auto (by the autopilot that is heard), px4,
    ardupilot, or a path to a .toml."""

    speed: float = 1.0
    """Simulated seconds per wall second of the vehicle; 1 for a real one."""

    altitude: float = 10.0
    """Take-off altitude, 8 to 100 m, with --steps-only from 2 m: PX4 comes down while it waits for
    setpoints."""

    repeat: int = 1
    """How often the steps are flown, 1 to 20: the table has the median. Every other time they are
    mirrored, so that the vehicle comes back."""

    steps: tuple[str, ...] | None = None
    """Names of the steps to fly, as north-2 yaw-90 (docs/conformance.md). None: all."""

    skip_steps: bool = False
    """Fly no step responses."""

    steps_only: bool = False
    """Check neither refusals nor frames, offboard loss or hold: fly the steps."""

    connect_timeout: float = 30.0
    """How long a flight controller is waited for, 1 to 3600 s of wall time."""

    out: Path | None = None
    """Write everything to this .json. None: nothing."""
