"""`airl arena`: show the arena that a profile and a seed generate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.arena.describe import arena_table
from airl_mav.arena.generate import generate
from airl_mav.cli.options import POSITIONAL
from airl_mav.core.console import new_console
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.flight.judge import GOAL_RADIUS_M
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.scenario.model import DEFAULT_ARENA, GREATEST_SEED, ArenaName


class ArenaOptions(ProfileModel):
    """Generate an arena, list its contents, draw a top view.

    Examples:
        airl arena dynamic-obstacles --seed 7 --png arena.png
        airl arena my-arena.toml --zone 0
    """

    name: Annotated[ArenaName, POSITIONAL] = DEFAULT_ARENA
    seed: int | None = quantity(
        "seed of the arena; by default the profile's", "1", ge=0, le=GREATEST_SEED, default=None
    )
    zone: int | None = quantity(
        "curriculum zone that bounds the goal, 0 is the nearest; by default the largest",
        "1",
        ge=0,
        le=1000,
        default=None,
    )
    png: Path | None = Field(default=None, description="write a picture to this .png file")
    time_s: float = quantity(
        "when the picture shows the moving obstacles, after the start",
        "s",
        ge=0,
        le=1e6,
        default=0.0,
    )
    vehicle_width_m: float = quantity(
        "width of the vehicle: the way from start to goal is at least this wide",
        "m",
        gt=0,
        le=100,
        default=0.55,
    )
    goal_radius_m: float = quantity(
        "radius of the disc around the goal in the picture",
        "m",
        gt=0,
        le=100,
        default=GOAL_RADIUS_M,
    )


OPTIONS = ArenaOptions


def run(options: ArenaOptions, console: Console | None = None) -> int:
    """Print the arena's table and write its picture; return 0."""
    console = console or new_console()
    if options.png is not None and options.png.suffix.lower() != ".png":
        raise FieldError("png", f"{options.png}", "a file name that ends in .png")
    spec = load_profile("arenas", options.name, ArenaSpec)
    arena = generate(
        spec,
        spec.default_seed if options.seed is None else options.seed,
        name=Path(options.name).stem,
        vehicle_width_m=options.vehicle_width_m,
        zone=options.zone,
    )
    console.print(arena_table(arena, spec))
    if options.png is not None:
        # Imported here: only pictures need matplotlib, which is slow to import.
        from airl_mav.arena.draw import save_png

        try:
            save_png(
                arena,
                options.png,
                time_us=round(options.time_s * US_PER_S),
                goal_radius_m=options.goal_radius_m,
                zone_radii_m=spec.zones_m,
            )
        except OSError as error:
            problem = f"cannot write: {error.strerror}"
            raise FieldError("png", f"{options.png}", problem=problem) from None
        console.print(f"picture: {options.png}", soft_wrap=True, highlight=False)
    return 0
