"""What `airl arena` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from airl_mav.flight.judge import GOAL_RADIUS_M


@dataclass(frozen=True)
class ArenaCommand:
    """Generate an arena, say what is in it, draw it from above."""

    name: tyro.conf.Positional[str] = "static-obstacles"
    """Arena profile: a shipped name, or a path to a .toml."""

    seed: int | None = None
    """Seed of the arena, a whole number from 0. None: the profile's default_seed."""

    zone: int | None = None
    """Curriculum zone that bounds the goal, 0 is the nearest. None: the largest."""

    png: Path | None = None
    """Write a picture to this .png file. None: no picture."""

    time: float = 0.0
    """When the picture shows the moving obstacles, s after the start."""

    vehicle_width: float = 0.55
    """Width of the vehicle, m: the way from start to goal is at least this wide."""

    goal_radius: float = GOAL_RADIUS_M
    """Radius of the disc around the goal in the picture, m."""
