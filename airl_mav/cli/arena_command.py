"""`airl arena`: show the arena that a profile and a seed generate."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.table import Table

from airl_mav.arena.generate import free_area_fraction, generate
from airl_mav.arena.geometry import STEEPEST, Arena, Shape, Tour
from airl_mav.arena.placement import Floats, zone_of
from airl_mav.arena.walls import openings_of
from airl_mav.cli.options import POSITIONAL
from airl_mav.core import constants, errors, fields, progress
from airl_mav.flight.judge import GOAL_RADIUS_M
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.scenario.model import DEFAULT_ARENA, GREATEST_SEED, ArenaName


def arena_table(arena: Arena, spec: ArenaSpec) -> Table:
    """Return the contents of the arena as a table."""
    b = arena.bounds
    table = Table(title=f"{arena.name}, seed {arena.seed}", caption=spec.description)
    table.add_column("what")
    table.add_column("value", justify="right")
    size = f"{b.north_max - b.north_min:g} x {b.east_max - b.east_min:g} x {b.height:g} m"
    table.add_row("floor north x east, walls", size)
    if b.ceiling:
        table.add_row("ceiling", f"{b.height:g} m high")
    if (building := arena.building) is not None:
        table.add_row("rooms", f"{building.rooms}, {building.doors} doors")
    if (ground := arena.ground) is not None:
        table.add_row("hills", f"up to {ground.top_m:.2f} m high")
        steepest = math.degrees(math.atan(float(ground.relief.grid[STEEPEST])))
        table.add_row("  steepest", f"{steepest:.0f} deg")
        points = f"{' x '.join(str(n) for n in ground.heights.shape)}"
        table.add_row("  grid", f"{points} points, {ground.step_north:.2f} m apart")
        at = ground.height_at(float(arena.goal[0]), float(arena.goal[1]))
        table.add_row("  at the goal", f"{at:.2f} m")
    table.add_row("start from the south-west corner", f"{-b.north_min:g} N {-b.east_min:g} E m")
    table.add_row("static obstacles", _shapes(arena, moving=False))
    table.add_row("moving obstacles", _shapes(arena, moving=True))
    if arena.clear is not None:
        table.add_row("obstacles of glass", str(int(arena.clear.sum())))
    if arena.tours:
        speeds = ", ".join(f"{_speed_m_s(tour):.2f}" for tour in arena.tours)
        periods = ", ".join(f"{tour.times_s[-1]:.0f}" for tour in arena.tours)
        table.add_row("  speeds", f"{speeds} m/s")
        table.add_row("  tours repeat after", f"{periods} s")
    for k, (place, half) in enumerate(zip(*_openings(arena), strict=True)):
        where = f"{place[0]:.2f} N {place[1]:.2f} E, {-place[2]:.2f} m high"
        table.add_row(f"  opening of gate {k}", where)
        table.add_row("    wide, high", f"{2.0 * half[1]:.2f} x {2.0 * half[2]:.2f} m")
    north, east = (float(value) for value in arena.goal)
    zone = zone_of(spec, arena.goal)
    where = "beyond the zones" if zone is None else f"zone {zone}"
    table.add_row("goal from the start", f"{north:.2f} N {east:.2f} E m")
    if arena.goal_height_m is not None:
        table.add_row("  height above the start", f"{arena.goal_height_m:.2f} m")
    table.add_row("  distance", f"{math.hypot(north, east):.2f} m, {where}")
    table.add_row("floor free of static obstacles", f"{free_area_fraction(arena):.1%}")
    return table


def _openings(arena: Arena) -> tuple[Floats, Floats]:
    """Return the centres (k, 3) NED and half sizes (k, 3) [m] of the gates' openings."""
    openings = openings_of(arena)
    return openings.center, openings.half_size


def _shapes(arena: Arena, *, moving: bool) -> str:
    """Return the number of obstacles by kind: "7 (4 box, 3 sphere)"."""
    n, statics = arena.n_static, arena.statics
    if statics is not None and not moving:
        counts = sorted(Counter(statics.names).items())
        each = ", ".join(f"{count} {name}" for name, count in counts)
        return f"{len(statics.names)} ({each})" if each else "0"
    shapes = arena.obstacles.shape[n:] if moving else arena.obstacles.shape[:n]
    kinds = [f"{k} {shape.name.lower()}" for shape in Shape if (k := int((shapes == shape).sum()))]
    return f"{len(shapes)} ({', '.join(kinds)})" if kinds else "0"


def _speed_m_s(tour: Tour) -> float:
    """Return the constant speed of a moving obstacle between stops [m/s]."""
    length = np.hypot(*np.diff(tour.points, axis=0).T)
    moves = length > 0.0
    return float(length[moves].sum() / np.diff(tour.times_s)[moves].sum())


class ArenaOptions(fields.ProfileModel):
    """Generate an arena, list its contents, draw a top view.

    Examples:
        airl arena dynamic-obstacles --seed 7 --png arena.png
        airl arena my-arena.toml --zone 0
    """

    name: Annotated[ArenaName, POSITIONAL] = DEFAULT_ARENA
    seed: int | None = fields.quantity(
        "seed of the arena; by default the profile's", "1", ge=0, le=GREATEST_SEED, default=None
    )
    zone: int | None = fields.quantity(
        "curriculum zone that bounds the goal, 0 is the nearest; by default the largest",
        "1",
        ge=0,
        le=1000,
        default=None,
    )
    png: Path | None = Field(default=None, description="write a picture to this .png file")
    time_s: float = fields.quantity(
        "when the picture shows the moving obstacles, after the start",
        "s",
        ge=0,
        le=1e6,
        default=0.0,
    )
    vehicle_width_m: float = fields.quantity(
        "width of the vehicle: the way from start to goal is at least this wide",
        "m",
        gt=0,
        le=100,
        default=0.55,
    )
    goal_radius_m: float = fields.quantity(
        "radius of the disc around the goal in the picture",
        "m",
        gt=0,
        le=100,
        default=GOAL_RADIUS_M,
    )


OPTIONS = ArenaOptions


def run(options: ArenaOptions, console: Console | None = None) -> int:
    """Print the arena's table and write its picture; return 0."""
    console = console or progress.new_console()
    if options.png is not None and options.png.suffix.lower() != ".png":
        raise errors.FieldError("png", f"{options.png}", "a file name that ends in .png")
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

        with errors.usage_errors(f"--png {options.png}: cannot write"):
            save_png(
                arena,
                options.png,
                time_us=round(options.time_s * constants.US_PER_S),
                goal_radius_m=options.goal_radius_m,
                zone_radii_m=spec.zones_m,
            )
        console.print(f"picture: {options.png}", soft_wrap=True, highlight=False)
    return 0
