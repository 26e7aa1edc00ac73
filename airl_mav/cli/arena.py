"""`airl arena`: show what the environment generator makes of a specification and a seed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from airl_mav.arena.generate import free_area_fraction, generate
from airl_mav.arena.geometry import Arena, Shape, Tour
from airl_mav.arena.zones import zone_of
from airl_mav.cli.arena_command import ArenaCommand
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile


def run(command: ArenaCommand, console: Console | None = None) -> int:
    """Print the arena's table and write its picture.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status, 0.

    Raises:
        UsageError: The arena cannot be made, or the picture not be written there.
    """
    console = console or Console()
    _check(command)
    spec = load_profile("arenas", command.name, ArenaSpec)
    arena = generate(
        spec,
        spec.default_seed if command.seed is None else command.seed,
        name=Path(command.name).stem,
        vehicle_width_m=command.vehicle_width,
        zone=command.zone,
    )
    console.print(_table(arena, spec))
    if command.png is not None:
        # Here, because only a picture needs matplotlib, which is slow to import.
        from airl_mav.arena.draw import save_png

        try:
            save_png(
                arena,
                command.png,
                time_us=round(command.time * US_PER_S),
                goal_radius_m=command.goal_radius,
                zone_radii_m=spec.zones_m,
            )
        except OSError as error:
            raise UsageError(f"--png {command.png}: cannot write: {error.strerror}") from None
        console.print(f"picture: {command.png}", soft_wrap=True, highlight=False)
    return 0


def _check(command: ArenaCommand) -> None:
    """Refuse flags that make no sense, before any work."""
    if command.png is not None and command.png.suffix.lower() != ".png":
        raise UsageError(f"--png {command.png}: accepted: a file name that ends in .png")
    if not (math.isfinite(command.time) and command.time >= 0.0):
        raise UsageError(f"--time {command.time:g}: accepted: value >= 0 s")
    for flag in ("vehicle_width", "goal_radius"):
        value = getattr(command, flag)
        if not (math.isfinite(value) and value > 0.0):
            raise UsageError(f"--{flag.replace('_', '-')} {value:g}: accepted: value > 0 m")


def _table(arena: Arena, spec: ArenaSpec) -> Table:
    """Return what is in the arena."""
    b = arena.bounds
    table = Table(title=f"{arena.name}, seed {arena.seed}", caption=spec.description)
    table.add_column("what")
    table.add_column("value", justify="right")
    size = f"{b.north_max - b.north_min:g} x {b.east_max - b.east_min:g} x {b.height:g} m"
    table.add_row("floor north x east, walls", size)
    table.add_row("start from the south-west corner", f"{-b.north_min:g} N {-b.east_min:g} E m")
    table.add_row("static obstacles", _shapes(arena, moving=False))
    table.add_row("moving obstacles", _shapes(arena, moving=True))
    if arena.tours:
        speeds = ", ".join(f"{_speed_m_s(tour):.2f}" for tour in arena.tours)
        periods = ", ".join(f"{tour.times_s[-1]:.0f}" for tour in arena.tours)
        table.add_row("  speeds", f"{speeds} m/s")
        table.add_row("  tours repeat after", f"{periods} s")
    north, east = (float(value) for value in arena.goal)
    zone = zone_of(spec, arena.goal)
    where = "beyond the zones" if zone is None else f"zone {zone}"
    table.add_row("goal from the start", f"{north:.2f} N {east:.2f} E m")
    table.add_row("  distance", f"{math.hypot(north, east):.2f} m, {where}")
    table.add_row("floor free of static obstacles", f"{free_area_fraction(arena):.1%}")
    return table


def _shapes(arena: Arena, *, moving: bool) -> str:
    """Return how many obstacles of each shape there are: "7 (4 box, 3 sphere)"."""
    n = arena.n_static
    shapes = arena.obstacles.shape[n:] if moving else arena.obstacles.shape[:n]
    kinds = [f"{k} {shape.name.lower()}" for shape in Shape if (k := int((shapes == shape).sum()))]
    return f"{len(shapes)} ({', '.join(kinds)})" if kinds else "0"


def _speed_m_s(tour: Tour) -> float:
    """Return the speed on the legs of a tour [m/s], stops left out; it was drawn once."""
    length = np.hypot(*np.diff(tour.points, axis=0).T)
    moves = length > 0.0
    return float(length[moves].sum() / np.diff(tour.times_s)[moves].sum())
