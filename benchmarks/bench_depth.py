"""Depth images a second on one core: this project's ray caster beside pybullet's TinyRenderer.

Run as `python benchmarks/bench_depth.py`. Both draw the same arena from the same poses: a room of
50 x 50 m with 5 m walls, the vehicle among boxes, pillars and spheres. The camera has 90 degrees
and 20 m range. The kernel is called from a compiled loop, as in training, and through `render`, as
in the plant. TinyRenderer always shades a colour image as well.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import pybullet
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.camera.bvh import Meshes
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import LensConstants, Scene, lens_of
from airl_mav.camera.raycast import render_depth
from airl_mav.camera.render import render, scene_of
from airl_mav.core.frames import (
    ned_to_enu,
    quat_from_euler,
    quat_ned_frd_to_enu_flu,
    quat_to_matrix,
    quat_wxyz_to_xyzw,
)
from airl_mav.core.kernels import kernel

SIZES = ((32, 24), (64, 48), (128, 96))
OBSTACLES = (0, 10, 50)
POSES = 500
RANGE_M = 20.0
FOV = math.pi / 2
SECONDS = 0.6  # of each measurement


def make_arena(n: int, rng: np.random.Generator) -> Arena:
    half = rng.uniform(0.5, 1.5, (n, 3))
    shape = (np.arange(n) % 3).astype(np.int8)
    half[shape == Shape.CYLINDER, 1] = half[shape == Shape.CYLINDER, 0]
    half[shape == Shape.SPHERE] = half[shape == Shape.SPHERE, :1]
    center = np.column_stack([rng.uniform(-23, 23, (n, 2)), -half[:, 2]])
    obstacles = Obstacles(shape, center, half, rng.uniform(-np.pi, np.pi, n))
    bounds = Bounds(-25.0, 25.0, -25.0, 25.0, 5.0)
    return Arena("bench", 0, bounds, (200, 200, 200), obstacles, (), np.zeros(2))


def make_poses(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Poses in flight: 1 to 3 m high, tilted by some 8 degrees, any heading."""
    position = rng.uniform([-22, -22, -3], [22, 22, -1], (POSES, 3))
    tilt = rng.normal(0.0, 0.15, (POSES, 2))
    attitude = [quat_from_euler(r, p, rng.uniform(-np.pi, np.pi)) for r, p in tilt]
    return position, np.array(attitude)


@kernel
def render_all(
    out: NDArray[np.float32],
    position: NDArray[np.float64],
    attitude: NDArray[np.float64],
    lens: LensConstants,
    scene: Scene,
    meshes: Meshes | None,
) -> None:
    for i in range(len(position)):
        p, q = position[i], attitude[i]
        render_depth(out, (p[0], p[1], p[2]), (q[0], q[1], q[2], q[3]), lens, scene, meshes)


def rate(work: Callable[[], int]) -> float:
    """Return frames a second of the fastest of repeated calls; `work` returns its frames."""
    work()
    best, end = 0.0, time.perf_counter() + SECONDS
    while time.perf_counter() < end:
        start = time.perf_counter()
        frames = work()
        best = max(best, frames / (time.perf_counter() - start))
    return best


def in_compiled_loop(arena: Arena, k: Intrinsics, poses: tuple[np.ndarray, np.ndarray]) -> float:
    out = np.empty((k.height, k.width), np.float32)

    lens, scene = lens_of(k, RANGE_M), scene_of(arena, arena.obstacles.center)

    def work() -> int:
        render_all(out, *poses, lens, scene, None)
        return POSES

    return rate(work)


def from_python(arena: Arena, k: Intrinsics, poses: tuple[np.ndarray, np.ndarray]) -> float:
    def work() -> int:
        for position, attitude in zip(*poses, strict=True):
            render(arena, arena.obstacles.center, k, RANGE_M, position, attitude)
        return POSES

    return rate(work)


def build_in_pybullet(arena: Arena) -> None:
    def add(visual: int, center: np.ndarray, yaw: float = 0.0) -> None:
        attitude = quat_wxyz_to_xyzw(quat_ned_frd_to_enu_flu(quat_from_euler(0.0, 0.0, yaw)))
        pybullet.createMultiBody(0, -1, visual, ned_to_enu(center).tolist(), attitude)

    def box(*half: float) -> int:
        return int(pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=half))

    add(box(25, 25, 0.1), np.array([0, 0, 0.1]))
    for side in (-1.0, 1.0):
        add(box(0.1, 25, 2.5), np.array([side * 25.1, 0, -2.5]))
        add(box(25, 0.1, 2.5), np.array([0, side * 25.1, -2.5]))
    o = arena.obstacles
    for shape, center, half, yaw in zip(o.shape, o.center, o.half_size, o.yaw, strict=True):
        radius, height = float(half[0]), float(2 * half[2])
        if shape == Shape.BOX:
            add(box(*half), center, yaw)
        elif shape == Shape.CYLINDER:
            kind = pybullet.GEOM_CYLINDER
            add(pybullet.createVisualShape(kind, radius=radius, length=height), center)
        else:
            add(pybullet.createVisualShape(pybullet.GEOM_SPHERE, radius=radius), center)


def in_tiny_renderer(arena: Arena, k: Intrinsics, poses: tuple[np.ndarray, np.ndarray]) -> float:
    client = pybullet.connect(pybullet.DIRECT)
    build_in_pybullet(arena)
    vertical = math.degrees(2.0 * math.atan(0.5 * k.height / k.focal))
    projection = pybullet.computeProjectionMatrixFOV(vertical, k.width / k.height, 0.1, RANGE_M)
    views = []
    for position, attitude in zip(*poses, strict=True):
        forward, _, down = quat_to_matrix(attitude).T
        eye, target = ned_to_enu(position), ned_to_enu(position + forward)
        views.append(
            pybullet.computeViewMatrix(eye.tolist(), target.tolist(), ned_to_enu(-down).tolist())
        )

    def work() -> int:
        for view in views[:20]:
            pybullet.getCameraImage(
                k.width,
                k.height,
                view,
                projection,
                shadow=0,
                flags=pybullet.ER_NO_SEGMENTATION_MASK,
                renderer=pybullet.ER_TINY_RENDERER,
            )
        return 20

    result = rate(work)
    pybullet.disconnect(client)
    return result


def main() -> None:
    rng = np.random.default_rng(0)
    poses = make_poses(rng)
    table = Table(title="Depth images a second, one core")
    for heading in ("image", "obstacles", "kernel", "from Python", "TinyRenderer", "ratio"):
        table.add_column(heading, justify="right")
    for n in OBSTACLES:
        arena = make_arena(n, rng)
        for width, height in SIZES:
            k = Intrinsics.from_fov(width, height, FOV)
            compiled = in_compiled_loop(arena, k, poses)
            python = from_python(arena, k, poses)
            tiny = in_tiny_renderer(arena, k, poses)
            table.add_row(
                f"{width}x{height}",
                str(n),
                f"{compiled:,.0f}",
                f"{python:,.0f}",
                f"{tiny:,.0f}",
                f"{compiled / tiny:,.0f} x",
            )
    Console().print(table)


if __name__ == "__main__":
    main()
