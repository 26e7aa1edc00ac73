"""Meshes in camera images: images per second on one core, and depth against trimesh's rays.

Run as `python benchmarks/bench_meshes.py`. Arenas and poses are from `bench_depth`, with ten
objects: boxes, pillars and spheres, or meshes in their places: bent rings on the floor. Depth and
colour of all scenes are measured in turns, in one process, so that their ratios hold on a busy
machine, too. The kernels are called from a compiled loop, as in training.

Both are measured with a pinhole and a fisheye camera. Then 1,000 views of the meshes are compared
with trimesh's rays: by Embree if `embreex` is installed, else by trimesh's caster, which needs
`rtree` and takes hours; use `--views` for fewer. The comparison covers all pixels, including edges,
and prints how many differ. Embree uses 32-bit rays: within their rounding of an edge, Embree may
hit another triangle.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from bench_colour import colour_all
from bench_depth import FOV, POSES, RANGE_M, make_arena, make_poses, render_all
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from airl_mav.addons.colour.picture import ColourArrays, Work
from airl_mav.addons.colour.textures import atlas
from airl_mav.arena.geometry import Arena, PlacedMesh
from airl_mav.arena.triangles import Triangles, encoded, triangles_of
from airl_mav.camera.bvh import meshes_of
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import lens_of
from airl_mav.camera.render import render, scene_of
from airl_mav.core.frames import quat_to_matrix
from airl_mav.profiles.assets import MeshFile

THINGS = 10
ROUNDS = 15
FISHEYE_FOV = math.radians(170.0)
DISTORTION = (-0.05, 0.008, -0.0045, 0.0004)
"""Distortion coefficients of the fisheye camera for the same scenes."""

RINGS = {2_000: (50, 20), 20_000: (200, 50)}
"""Sections around and across a ring, by its number of triangles."""


def ring(triangles: int, folder: Path) -> MeshFile:
    """Write a bent ring 2 m across, and return its file."""
    around, across = RINGS[triangles]
    made = trimesh.creation.torus(0.75, 0.25, major_sections=around, minor_sections=across)
    forward, right, up = made.vertices.T
    # It stands, and leans to and fro.
    places = np.stack([up + 0.15 * np.sin(5.0 * right), right, -forward], axis=1)
    places[:, 2] -= places[:, 2].max()
    data = encoded(Triangles(places.astype(np.float32), made.faces.astype(np.int32)))
    path = folder / f"ring-{triangles}.npz"
    path.write_bytes(data)
    return MeshFile(file=str(path), sha256=hashlib.sha256(data).hexdigest())


def with_meshes(arena: Arena, file: MeshFile) -> Arena:
    """Return an arena with meshes in the places of its obstacles."""
    o = arena.obstacles
    placed = tuple(
        PlacedMesh(file, (north, east), yaw, size, i, 1)
        for i, ((north, east, _), (size, _, _), yaw) in enumerate(
            zip(o.center.tolist(), o.half_size.tolist(), o.yaw.tolist(), strict=True)
        )
    )
    return replace(arena, meshes=placed)


def rates(
    arenas: list[Arena], k: Intrinsics, poses: tuple[np.ndarray, np.ndarray]
) -> list[tuple[float, float]]:
    """Return depth and colour images a second of each: the best of rounds taken in turns."""
    shape = (k.height, k.width)
    depth, seen = np.empty(shape, np.float32), np.empty(shape, np.int32)
    rgb, work = np.empty((*shape, 3), np.uint8), Work.of(k)
    calls = []
    for arena in arenas:
        o, look = arena.obstacles, ColourArrays.of(arena.look)._replace(gloss=None)
        meshes = meshes_of(arena.meshes, len(o))
        bodies = (*poses, lens_of(k, RANGE_M), scene_of(arena, o.center), meshes)
        calls.append((bodies, (look, atlas())))
    best = np.full((len(arenas), 2), math.inf)
    for _ in range(ROUNDS + 1):  # the first one compiles
        for each, (bodies, surfaces) in enumerate(calls):
            start = time.perf_counter()
            render_all(depth, *bodies)
            middle = time.perf_counter()
            colour_all(rgb, depth, seen, work, *bodies, *surfaces)
            took = middle - start, time.perf_counter() - middle
            best[each] = np.minimum(best[each], took)
    return [(POSES / d, POSES / c) for d, c in best.tolist()]


def in_world(arena: Arena) -> trimesh.Trimesh:
    """Return the meshes of an arena, NED."""
    parts = []
    for each in arena.meshes:
        held = triangles_of(each.file)
        cos, sin = math.cos(each.yaw), math.sin(each.yaw)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        places = each.scale * held.vertices.astype(np.float64) @ turn.T + [*each.place, 0.0]
        parts.append(trimesh.Trimesh(places, held.faces, process=False))
    joined = trimesh.util.concatenate(parts)
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def traced(
    mesh: trimesh.Trimesh, k: Intrinsics, position: np.ndarray, attitude: np.ndarray
) -> NDArray[np.float64]:
    """Return the depth image of a mesh by trimesh's rays [m]; infinity: it is not hit."""
    rays = k.rays.reshape(3, -1).T @ quat_to_matrix(attitude).T
    sees = np.flatnonzero(rays.any(axis=1))
    places, which, _ = mesh.ray.intersects_location(
        np.broadcast_to(position, rays[sees].shape), rays[sees], multiple_hits=False
    )
    depth, hit = np.full(len(rays), math.inf), rays[sees[which]]
    along = ((places - position) * hit).sum(axis=1) / (hit * hit).sum(axis=1)
    np.minimum.at(depth, sees[which], along)
    return depth.reshape(k.height, k.width)


def compare(
    arena: Arena, k: Intrinsics, views: int, rng: np.random.Generator, console: Console
) -> None:
    """Print the differences between depth images of an arena's meshes and trimesh's rays."""
    mesh = in_world(arena)
    bare = replace(arena, meshes=(), obstacles=make_arena(0, rng).obstacles)
    apart: list[NDArray[np.float64]] = []
    position, attitude = make_poses(rng)
    for i in range(views):
        if i % POSES == 0 and i:
            position, attitude = make_poses(rng)
        pose = position[i % POSES], attitude[i % POSES]
        seen = render(arena, arena.obstacles.center, k, 100.0, *pose).astype(np.float64)
        room = render(bare, bare.obstacles.center, k, 100.0, *pose).astype(np.float64)
        hits = traced(mesh, k, *pose)
        nearest = np.minimum(np.where(room > 0.0, room, math.inf), hits)
        expected = np.where(np.isfinite(nearest), nearest, 0.0)
        shown = np.isfinite(hits) & (hits <= expected)
        apart.append(np.abs(seen - expected)[shown | (np.abs(seen - room) > 1e-4)])
    all_apart = np.concatenate(apart)
    edges = int(np.count_nonzero(all_apart > 1e-4))
    caster = "Embree" if trimesh.ray.has_embree else "trimesh's own caster"
    console.print(
        f"Depth of meshes, {k.projection}, beside {caster}: {views:,} views, {len(all_apart):,}"
        f" pixels that see a mesh; {edges} of them (on edges) are more than 0.1 mm apart, all"
        f" others at most {all_apart[all_apart <= 1e-4].max():.2g} m",
        highlight=False,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--views", type=int, default=1000, help="compared with trimesh; 0: none")
    options = parser.parse_args()
    rng, console = np.random.default_rng(0), Console()
    poses, plain = make_poses(rng), make_arena(THINGS, rng)
    with tempfile.TemporaryDirectory() as folder:
        fine = [ring(count, Path(folder)) for count in RINGS]
        scenes = {
            f"{THINGS} primitives": plain,
            f"{THINGS} meshes of 2,000 triangles": with_meshes(plain, fine[0]),
            "a mesh of 20,000 triangles": with_meshes(make_arena(1, rng), fine[1]),
            f"{THINGS} meshes of 20,000 triangles": with_meshes(plain, fine[1]),
        }
        cameras = (
            Intrinsics.from_fov(64, 48, FOV),
            Intrinsics.from_fov(64, 48, FISHEYE_FOV, "fisheye", distortion=DISTORTION),
        )
        for k in cameras:
            table = Table(title=f"Images of 64x48 a second, one core, {k.projection}")
            table.add_column("scene")
            for heading in ("depth", "colour", "us an image"):
                table.add_column(heading, justify="right")
            told = rates(list(scenes.values()), k, poses)
            for name, (depth, colour) in zip(scenes, told, strict=True):
                table.add_row(name, f"{depth:,.0f}", f"{colour:,.0f}", f"{1e6 / colour:.0f}")
            console.print(table)
        if options.views:
            seen = scenes[f"{THINGS} meshes of 2,000 triangles"]
            for k in cameras:
                compare(seen, k, options.views, rng, console)


if __name__ == "__main__":
    main()
