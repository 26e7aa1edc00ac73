"""Draw the ground of an arena: hills above the floor, level around the start.

Random numbers on a coarse lattice are joined by a uniform cubic B-spline (de Boor, A practical
guide to splines, 1978), which has no steps in its slope nor in its curvature. What lies above the
middle of them rises as its square, so that hills begin without an edge. There are only sums and
products of the numbers drawn: a seed gives the same bits on any machine.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.appearance import Statics
from airl_mav.arena.footprints import Boxes
from airl_mav.arena.geometry import Bounds, Obstacles, PlacedMesh, Shape
from airl_mav.arena.ground import Floats, Ground
from airl_mav.profiles.terrain import Terrain

TRIES = 20
"""Hills are drawn anew, so often at most, while the highest ones are where the ground is level."""


def draw_ground(rng: np.random.Generator, terrain: Terrain, bounds: Bounds) -> Ground:
    """Draw the ground of an arena; arguments as of `check_terrain`, which has passed them.

    Args:
        rng: Source of the draws.
        terrain: Such that there are hills.
        bounds: Of the floor.
    """
    least, greatest = terrain.relief_m
    relief_m = least + (greatest - least) * float(rng.random())
    length, width = bounds.north_max - bounds.north_min, bounds.east_max - bounds.east_min
    pitch = terrain.pitch_m(length, width)
    rows, columns = max(2, math.floor(length / pitch)), max(2, math.floor(width / pitch))
    step_n, step_e = length / rows, width / columns
    north: Floats = step_n * np.arange(rows + 1, dtype=np.float64)
    east: Floats = step_e * np.arange(columns + 1, dtype=np.float64)
    away = np.sqrt(
        (bounds.north_min + north[:, None]) ** 2 + (bounds.east_min + east[None, :]) ** 2
    )
    # A triangle that rises reaches as far as its cell: none does where the ground is level.
    level = terrain.flat_m + math.sqrt(step_n * step_n + step_e * step_e)
    share = _smooth((away - level) / terrain.scale_m)
    hills = np.zeros_like(away)
    for _ in range(TRIES):
        noise = np.maximum(_noise(rng, north, east, 0.5 * terrain.scale_m), 0.0)
        hills = share * noise * noise
        if hills.max() > 0.25 * float((noise * noise).max()):
            break
    top = float(hills.max())
    heights = hills * (relief_m / top) if top > 0.0 else hills
    heights.setflags(write=False)
    return Ground(heights, bounds.north_min, bounds.east_min, step_n, step_e)


def stand_on(
    ground: Ground,
    static: Obstacles,
    standing: Boxes,
    statics: Statics | None,
    meshes: tuple[PlacedMesh, ...],
) -> tuple[Obstacles, tuple[PlacedMesh, ...]]:
    """Return what stands on the floor, and its meshes, where it stands on the ground.

    Each thing stands on the lowest ground around its place, out to the corners of its bounding box,
    so that nothing floats. Spheres stay at their height, which is that above the start.

    Args:
        ground: Hills.
        static: All primitives.
        standing: The bounding boxes of the things.
        statics: What the primitives are parts of; None: each is a thing of its own.
        meshes: What cameras see of things.
    """
    if statics is None:
        kinds = tuple(Shape(int(shape)).name.lower() for shape in static.shape)
        owner = np.arange(len(kinds))
    else:
        kinds, owner = statics.names, statics.of
    lifts = np.zeros(len(kinds))
    for k, kind in enumerate(kinds):
        if kind == "sphere":
            continue
        (north, east), half = standing.center[k].tolist(), standing.half[k].tolist()
        radius = half[0] if kind == "cylinder" else math.hypot(*half)
        lifts[k] = ground.lowest_within(north, east, radius)
    center = static.center.copy()
    center[:, 2] -= lifts[owner]
    seen = tuple(replace(mesh, base_m=float(lifts[owner[mesh.first]])) for mesh in meshes)
    return replace(static, center=center), seen


def _smooth(x: Floats) -> Floats:
    """Return 0 below 0, 1 above 1, and a smooth step between."""
    x = np.clip(x, 0.0, 1.0)
    stepped: Floats = x * x * (3.0 - 2.0 * x)
    return stepped


def _noise(rng: np.random.Generator, north: Floats, east: Floats, lattice_m: float) -> Floats:
    """Draw smooth noise at places north (r,) by east (c,) [m], both from 0 on, about 0."""
    n_index, n_weights = _spline(north / lattice_m + float(rng.random()))
    e_index, e_weights = _spline(east / lattice_m + float(rng.random()))
    values = rng.random((int(n_index[-1]) + 4, int(e_index[-1]) + 4)) - 0.5
    rows = np.zeros((len(north), values.shape[1]))
    for k in range(4):
        rows += n_weights[k][:, None] * values[n_index + k]
    noise = np.zeros((len(north), len(east)))
    for k in range(4):
        noise += e_weights[k] * rows[:, e_index + k]
    return noise


def _spline(at: Floats) -> tuple[NDArray[np.int64], tuple[Floats, Floats, Floats, Floats]]:
    """Return the first of the four knots (n,) of each place, and the weights (n,) of the four."""
    index = np.floor(at).astype(np.int64)
    t = at - index
    s = 1.0 - t
    weights = (
        s * s * s / 6.0,
        (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
        (3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0,
        t * t * t / 6.0,
    )
    return index, weights
