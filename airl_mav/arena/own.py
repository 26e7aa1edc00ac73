"""Arenas that a generator of the user's makes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.core import plugins
from airl_mav.core.errors import UsageError
from airl_mav.profiles.appearance import DEFAULT
from airl_mav.profiles.arena import ArenaSpec


def generate_own(
    spec: ArenaSpec, seed: int, *, name: str, vehicle_width_m: float, zone: int | None
) -> Arena:
    """Make the arena of a seed with the user's own generator; arguments as of `generate`.

    Raises:
        UsageError: There is no such generator, it raises, or what it makes cannot be flown in.
    """
    make = plugins.load_part(plugins.GENERATORS, spec.generator)
    told = f"generator {spec.generator!r}, seed {seed}"
    try:
        arena = make(spec, seed, name=name, vehicle_width_m=vehicle_width_m, zone=zone)
    except Exception as error:
        words = " ".join(f"{type(error).__name__}: {error}".split())
        raise UsageError(f"{told}: {words}") from error
    if not isinstance(arena, Arena):
        raise UsageError(f"{told}: makes {type(arena).__name__}; accepted: airl_mav's Arena")
    if (problem := _problem(arena)) is not None:
        raise UsageError(f"{told}: {problem}")
    if arena.appearance == DEFAULT:  # The generator says nothing of it: the profile does.
        return replace(arena, appearance=spec.appearance)
    return arena


def _problem(arena: Arena) -> str | None:
    """Return why nobody can fly in an arena; None: somebody can."""
    obstacles, b = arena.obstacles, arena.bounds
    n = len(obstacles)
    shapes = {"center": (n, 3), "half_size": (n, 3), "yaw": (n,)}
    for field, wanted in shapes.items():
        found = np.asarray(getattr(obstacles, field))
        if found.shape != wanted or not np.isfinite(found).all():
            return f"obstacles.{field} {found.shape}; accepted: {wanted} numbers"
    if len(arena.tours) > n:
        return f"{len(arena.tours)} tours; accepted: at most one an obstacle, {n}"
    for mesh in arena.meshes:
        if not 0 <= mesh.first < mesh.first + mesh.count <= arena.n_static or mesh.scale <= 0.0:
            return f"meshes: accepted: each with obstacles that stand, and a scale > 0; not {mesh}"
    if (ground := arena.ground) is not None:
        heights = np.asarray(ground.heights)
        if heights.ndim != 2 or min(heights.shape) < 2 or not (heights >= 0.0).all():
            return f"ground.heights {heights.shape}; accepted: two or more each way, none below 0"
        if not (np.isfinite(heights).all() and min(ground.step_north, ground.step_east) > 0.0):
            return "ground: accepted: finite heights, and steps > 0"
    for what, place in (("start", (0.0, 0.0)), ("goal", tuple(np.asarray(arena.goal)))):
        inside = len(place) == 2 and (
            b.north_min < place[0] < b.north_max and b.east_min < place[1] < b.east_max
        )
        if not inside:
            return f"the {what} {place} is not between the walls"
    return None
