"""Colour images per second on one core, and their cost relative to depth images.

Run as `python benchmarks/bench_colour.py`. Arenas and poses are from `bench_depth`; every obstacle
has a texture, the sun casts shadows. Depth and colour are measured in turns, so that their ratio
holds on a busy machine, too. Both kernels are called from a compiled loop, as in training.
"""

from __future__ import annotations

import time

import numpy as np
from bench_depth import FOV, POSES, RANGE_M, make_arena, make_poses, render_all
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from airl_mav.addons.colour.picture import ColourArrays, Work, render_colour
from airl_mav.addons.colour.textures import atlas
from airl_mav.arena.geometry import Arena
from airl_mav.camera.bvh import Meshes
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import LensConstants, Scene, lens_of
from airl_mav.camera.render import scene_of
from airl_mav.core.kernels import kernel

SIZES = ((32, 24), (64, 48), (128, 96))
OBSTACLES = (0, 10, 50)
ROUNDS = 15


@kernel
def colour_all(
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    seen: NDArray[np.int32],
    work: Work,
    position: NDArray[np.float64],
    attitude: NDArray[np.float64],
    lens: LensConstants,
    scene: Scene,
    meshes: Meshes | None,
    look: ColourArrays,
    patterns: NDArray[np.float32],
) -> None:
    for i in range(len(position)):
        p, q = position[i], attitude[i]
        pose = (p[0], p[1], p[2]), (q[0], q[1], q[2], q[3])
        render_colour(rgb, depth, seen, work, pose[0], pose[1], lens, scene, meshes, look, patterns)


def rates(arena: Arena, k: Intrinsics, poses: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    """Return depth and colour images a second: of each the best of rounds taken in turns."""
    look, shape = ColourArrays.of(arena.look)._replace(gloss=None), (k.height, k.width)
    depth, seen = np.empty(shape, np.float32), np.empty(shape, np.int32)
    rgb, work = np.empty((*shape, 3), np.uint8), Work.of(k)
    bodies = (*poses, lens_of(k, RANGE_M), scene_of(arena, arena.obstacles.center), None)
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(ROUNDS):
        start = time.perf_counter()
        render_all(depth, *bodies)
        middle = time.perf_counter()
        colour_all(rgb, depth, seen, work, *bodies, look, atlas())
        times[0].append(middle - start)
        times[1].append(time.perf_counter() - middle)
    return POSES / min(times[0]), POSES / min(times[1])


def main() -> None:
    rng = np.random.default_rng(0)
    poses = make_poses(rng)
    table = Table(title=f"Images a second, one core; depth to {RANGE_M:g} m, colour without limit")
    for heading in ("image", "obstacles", "depth", "colour", "depth / colour"):
        table.add_column(heading, justify="right")
    for n in OBSTACLES:
        arena = make_arena(n, rng)
        for width, height in SIZES:
            depth, colour = rates(arena, Intrinsics.from_fov(width, height, FOV), poses)
            table.add_row(
                f"{width}x{height}",
                str(n),
                f"{depth:,.0f}",
                f"{colour:,.0f}",
                f"{depth / colour:.1f}",
            )
    Console().print(table)


if __name__ == "__main__":
    main()
