"""Meshes that cameras see, against every ray and every triangle in float64, and against boxes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from airl_mav.addons.colour.picture import render_picture
from airl_mav.addons.colour.profile import Appearance
from airl_mav.arena.geometry import Arena, Obstacles, PlacedMesh, Shape
from airl_mav.arena.triangles import Triangles, decoded, encoded, triangles_of
from airl_mav.camera.bvh import LEAF, build_bvh
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.primitives import OBSTACLE, SKY
from airl_mav.camera.render import render
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import quat_from_euler, quat_to_matrix
from airl_mav.profiles.projections import PROJECTIONS, UNDISTORTED, Projection, sees_to
from tests.support.lenses import AT_NIGHT_THE_FISHEYE, BARREL, ENDING, OPENING, rays_of_fisheye
from tests.support.meshes import ROOM, kept, ring, scene_of, triangles

Floats = NDArray[np.float64]


def without_meshes(arena: Arena) -> Arena:
    o = arena.obstacles
    none = Obstacles(o.shape[:0], o.center[:0], o.half_size[:0], o.yaw[:0])
    return replace(arena, meshes=(), obstacles=none)


def in_world(arena: Arena) -> Floats:
    """Return the corners (m, 3, 3) of all triangles, NED."""
    parts = []
    for each in arena.meshes:
        cos, sin = math.cos(each.yaw), math.sin(each.yaw)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        own = triangles_of(each.file).corners.astype(np.float64)
        parts.append(each.scale * own @ turn.T + [*each.place, 0.0])
    return np.concatenate(parts)


def rays_of(k: Intrinsics, quaternion: Floats) -> Floats:
    """Return the ray (h w, 3) of each pixel, NED, of the length 1 in depth; 0: it sees nothing."""
    v, u = np.mgrid[: k.height, : k.width].reshape(2, -1)
    x, y = (u - k.cx) / k.focal, (v - k.cy) / k.focal
    ahead, right = (np.cos(x), np.sin(x)) if k.model.cylindrical else (np.ones(len(x)), x)
    own = np.stack([ahead, right, y], axis=1)
    if k.projection == "fisheye":
        own = np.nan_to_num(rays_of_fisheye(k).reshape(-1, 3))
    rays: Floats = own @ quat_to_matrix(quaternion).T
    return rays


def fisheye(side: int, number: int) -> Intrinsics:
    """Return one of a few lenses, whose circle ends within the image or beyond it."""
    k = (UNDISTORTED, BARREL, OPENING, ENDING)[number % 4]
    fov = 2.0 * sees_to(k) * (1.0 if number % 3 else 0.7)
    return Intrinsics.from_fov(side, side, fov, "fisheye", distortion=k)


def nearest(origins: Floats, rays: Floats, corners: Floats, least: float = 0.0) -> Floats:
    """Return how far each ray (n, 3) goes to a triangle (m, 3, 3); infinity: to none.

    Moller and Trumbore's test of every ray with every triangle.
    """
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    found = np.full(len(rays), math.inf)
    with np.errstate(all="ignore"):
        for i, (origin, ray) in enumerate(zip(origins, rays, strict=True)):
            across = np.cross(ray, ac)
            per = 1.0 / np.einsum("ij,ij->i", ab, across)
            away = origin - a
            first = per * np.einsum("ij,ij->i", away, across)
            turned = np.cross(away, ab)
            second = per * (turned @ ray)
            t = per * np.einsum("ij,ij->i", ac, turned)
            hit = (first >= 0.0) & (second >= 0.0) & (first + second <= 1.0) & (t > least)
            if hit.any():
                found[i] = t[hit].min()
    return found


def pose_in(rng: np.random.Generator, arena: Arena) -> tuple[Floats, Floats]:
    """Return a pose in the room, every third one near or in a mesh."""
    position = rng.uniform([-11.0, -11.0, -4.0], [11.0, 11.0, -0.2])
    if rng.random() < 1.0 / 3.0:
        position[:2] = arena.meshes[0].place + rng.normal(0.0, 0.7, 2)
        position[2] = -rng.uniform(0.3, 1.8)
    roll, pitch = rng.normal(0.0, 0.3, 2)
    return position, quat_from_euler(roll, pitch, rng.uniform(-np.pi, np.pi))


# --- depth


@pytest.mark.timeout(600)  # Compiles kernels, on a busy machine for minutes.
@pytest.mark.parametrize("projection", AT_NIGHT_THE_FISHEYE)
def test_depth_is_that_of_rays_in_float64(projection: Projection, tmp_path: Path) -> None:
    file = kept(triangles(ring()), tmp_path / "ring.npz")
    rng = np.random.default_rng(3)
    pixels = 0
    for view in range(12):
        arena = scene_of(
            file,
            [(*rng.uniform(-8, 8, 2), rng.uniform(-3, 3), rng.uniform(0.4, 3.0)) for _ in range(3)],
        )
        fov = rng.uniform(0.6, 2.4) if projection == "pinhole" else 2.0 * math.pi
        k = Intrinsics.from_fov(33, 25, fov, projection)
        if projection == "fisheye":
            k = fisheye(33, view)
        pose = pose_in(rng, arena)
        range_m = math.inf if view % 2 else 9.0
        seen = render(arena, arena.obstacles.center, k, range_m, *pose).astype(np.float64)
        bare = without_meshes(arena)
        room = render(bare, bare.obstacles.center, k, range_m, *pose).astype(np.float64)
        rays = rays_of(k, pose[1])
        hits = nearest(np.broadcast_to(pose[0], rays.shape), rays, in_world(arena))
        hits = np.where(hits <= range_m, hits, math.inf).reshape(seen.shape)
        both = np.minimum(np.where(room > 0.0, room, math.inf), hits)
        expected = np.where(np.isfinite(both), np.maximum(both, 0.001), 0.0)
        assert np.abs(seen - expected).max() < 1e-4, f"view {view}"
        pixels += int(np.count_nonzero(np.isfinite(hits)))
    assert pixels > 1000


def test_no_ray_passes_between_triangles(tmp_path: Path) -> None:
    # A finely cut wall, seen head on by rays that go exactly through its corners and along its
    # edges: a whole number of squares for each pixel.
    steps = np.linspace(-8.0, 8.0, 129)
    y, z = np.meshgrid(steps, steps, indexing="ij")
    places = np.stack([np.zeros(y.size), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    at = np.arange(128 * 128)
    corner = at // 128 * 129 + at % 128
    faces = [(corner, corner + 1, corner + 130), (corner, corner + 130, corner + 129)]
    square = np.concatenate([np.stack(face, axis=1) for face in faces]).astype(np.int32)
    file = kept(Triangles(places, square), tmp_path / "wall.npz")
    k = Intrinsics.from_fov(32, 24, math.pi / 2)
    for yaw in (0.0, 0.3):
        arena = scene_of(file, [(5.0, 0.0, yaw, 1.0)])
        for offset in (0.0, 0.5):
            aimed = replace(k, cx=16.0 - offset, cy=12.0 - offset)
            position = np.array([1.0, 0.0, -2.0])
            seen = render(arena, arena.obstacles.center, aimed, 100.0, position, np.eye(4)[0])
            rays = rays_of(aimed, np.eye(4)[0])
            plane = np.array([math.cos(yaw), math.sin(yaw), 0.0])
            depth = (4.0 * plane[0] / (rays @ plane)).reshape(seen.shape)
            floor = np.where(rays[:, 2] > 0.0, 2.0 / np.maximum(rays[:, 2], 1e-9), math.inf)
            np.testing.assert_allclose(seen, np.minimum(depth, floor.reshape(seen.shape)), 1e-6)


@pytest.mark.nightly
@pytest.mark.timeout(600)  # Compiles kernels, on a busy machine for minutes.
@pytest.mark.parametrize("projection", PROJECTIONS)
def test_a_mesh_of_a_box_is_the_box(projection: Projection, tmp_path: Path) -> None:
    half = np.array([0.6, 0.9, 0.75])
    file = kept(triangles(trimesh.creation.box(2.0 * half)), tmp_path / "box.npz")
    plain = {"floor": "gravel", "walls": "brick", "static": "orange"}
    appearance = Appearance.model_validate(
        {name: {"materials": [material]} for name, material in plain.items()}
    )
    rng = np.random.default_rng(5)
    k = Intrinsics.from_fov(64, 48, 1.4, projection)
    if projection == "fisheye":
        k = Intrinsics.from_fov(64, 48, 2.4, projection, distortion=BARREL)
    shaded = 0
    for seed in range(6):
        n = 5
        place, yaw = rng.uniform(-7.0, 7.0, (n, 2)), rng.uniform(-3.0, 3.0, n)
        center = np.column_stack([place, np.full(n, -half[2])])
        boxes = Obstacles(np.full(n, Shape.BOX, np.int8), center, np.tile(half, (n, 1)), yaw)
        arena = Arena("test", seed, ROOM, (90, 90, 90), boxes, (), np.zeros(2), appearance)
        meshes = tuple(
            PlacedMesh(file, (north, east), float(yaw[i]), 1.0, i, 1)
            for i, (north, east) in enumerate(place.tolist())
        )
        position = np.array([*rng.uniform(-10, 10, 2), -3.0])
        attitude = quat_from_euler(0.05, -0.3, math.atan2(-position[1], -position[0]))
        first = render_picture(arena, center, k, position, attitude)
        second = render_picture(replace(arena, meshes=meshes), center, k, position, attitude)
        np.testing.assert_allclose(second.depth_m, first.depth_m, atol=2e-5)
        # An edge, or the border of a shadow, may fall on either side of a pixel's ray.
        assert np.count_nonzero(first.seen != second.seen) <= 2
        apart = np.abs(first.rgb.astype(int) - second.rgb.astype(int)).max(axis=2)
        assert np.count_nonzero(apart > 1) <= 6
        shaded += int(np.count_nonzero(second.seen >= OBSTACLE))
    assert shaded > 1000


@pytest.mark.nightly
@pytest.mark.parametrize("projection", ["pinhole", "fisheye"])
def test_shadows_are_those_of_rays_in_float64(projection: Projection, tmp_path: Path) -> None:
    file = kept(triangles(ring()), tmp_path / "ring.npz")
    # White surfaces under a sun alone: dark pixels are in shadow or face away.
    # A black floor throws no light onto the meshes.
    plain = {"brightness": [1, 1], "tint": 0.0}
    looks = [
        Appearance.model_validate(
            {
                "materials": {"white": {"albedo": [255] * 3}, "black": {"albedo": [0] * 3}},
                "floor": {"materials": [floor], **plain},
                "static": {"materials": ["white"], **plain},
                "sky": {"irradiance": [0, 0]},
                "sun": {"elevation_deg": [35, 60], "irradiance": [1, 1]},
            }
        )
        for floor in ("white", "black")
    ]
    rng = np.random.default_rng(8)
    k = Intrinsics.from_fov(48, 36, 1.3)
    if projection == "fisheye":
        k = Intrinsics.from_fov(48, 36, 1.7, projection, distortion=OPENING)
    own = floor = 0
    for seed in range(4):
        arena = scene_of(file, [(0.0, 0.0, rng.uniform(-3, 3), 2.0), (3.0, -2.0, 0.4, 1.3)])
        arena, black = (replace(arena, seed=seed, appearance=look) for look in looks)
        position = np.array([*rng.uniform(-6, 6, 2), -2.5])
        attitude = quat_from_euler(0.0, -0.25, math.atan2(-position[1], -position[0]))
        picture = render_picture(arena, arena.obstacles.center, k, position, attitude)
        rays, to_sun = rays_of(k, attitude), arena.look.light.to_sun
        points = position + picture.depth_m.reshape(-1, 1).astype(np.float64) * rays
        corners = in_world(arena)
        hidden = np.isfinite(
            nearest(points, np.broadcast_to(to_sun, points.shape), corners, least=2e-3)
        )
        seen = picture.seen.ravel()
        lit = picture.rgb.reshape(-1, 3).max(axis=1) > 40
        dark = render_picture(black, arena.obstacles.center, k, position, attitude).rgb
        mesh_lit = dark.reshape(-1, 3).max(axis=1) > 40
        on_mesh, on_floor = seen >= OBSTACLE, seen == 1
        # The wall's shadow falls on the floor as well, as in the room without meshes.
        bare = without_meshes(arena)
        room = render_picture(bare, bare.obstacles.center, k, position, attitude).rgb
        by_wall = room.reshape(-1, 3).max(axis=1) <= 40
        wrong = on_floor & (lit != ~(hidden | by_wall))
        # Where a ray passes an edge, rounding decides.
        assert np.count_nonzero(wrong) <= 3
        # Lit pixels of a mesh are not hidden. Pixels that are dark and not hidden face away: the
        # next test checks them.
        assert np.count_nonzero(on_mesh & mesh_lit & hidden) <= 3
        assert np.count_nonzero(on_mesh & mesh_lit) > 30
        own += int(np.count_nonzero(on_mesh & ~mesh_lit & hidden))
        floor += int(np.count_nonzero(on_floor & hidden))
        assert np.count_nonzero(seen != SKY) > 500
    assert own > 50
    assert floor > 100


@pytest.mark.nightly
def test_a_ball_is_as_bright_as_the_cosine_law_says(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    file = kept(triangles(ball), tmp_path / "ball.npz")
    look: dict[str, Any] = {
        "materials": {"white": {"albedo": [255, 255, 255]}},
        "static": {"materials": ["white"], "brightness": [1, 1], "tint": 0.0},
        "sky": {"irradiance": [0.0, 0.0]},
        "sun": {"azimuth_deg": [180, 180], "elevation_deg": [45, 45], "irradiance": [1, 1]},
        "floor": {"materials": ["black"]},
    }
    look["materials"] = {**look["materials"], "black": {"albedo": [0, 0, 0]}}
    arena = scene_of(file, [(4.0, 0.0, 0.7, 1.0)])
    arena = replace(arena, appearance=Appearance.model_validate(look))
    k = Intrinsics.from_fov(65, 65, 0.5)
    position = np.array([0.0, 0.0, -1.0])
    picture = render_picture(arena, arena.obstacles.center, k, position, np.eye(4)[0])
    on_ball = picture.seen == OBSTACLE
    points = position + picture.depth_m.reshape(-1, 1) * rays_of(k, np.eye(4)[0])
    normals = (points - [4.0, 0.0, -1.0]).reshape(65, 65, 3)
    normals /= np.linalg.norm(normals, axis=2)[..., None]
    sun = arena.look.light.sun
    light = np.clip(normals @ arena.look.light.to_sun, 0.0, None)[..., None] * sun
    red = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    codes = 255.0 * np.clip(red, 0.0, 1.0)
    inside = on_ball & (light[..., 0] > 0.1)
    assert np.count_nonzero(inside) > 500
    # Each triangle is flat: 2.3 degrees from its middle to a corner.
    assert np.abs(picture.rgb.astype(float) - codes)[inside].max() < 16.0
    assert np.abs((picture.rgb.astype(float) - codes)[inside].mean()) < 1.0


# --- the tree


def test_the_tree_holds_every_triangle_once_and_nodes_hold_what_is_below() -> None:
    rng = np.random.default_rng(2)
    middle = rng.normal(0.0, 2.0, (700, 1, 3))
    middle[:100] = middle[0]  # Many in one place.
    corners = (middle + rng.normal(0.0, 0.1, (700, 3, 3))).astype(np.float32)
    corners[3] = corners[3, 0]  # Without an area.
    held = Triangles(corners.reshape(-1, 3), np.arange(2100, dtype=np.int32).reshape(-1, 3))
    tree = build_bvh(held)
    expected = np.delete(corners, 3, axis=0).reshape(-1, 9)
    order = np.lexsort(tree.corners.T)
    np.testing.assert_array_equal(tree.corners[order], expected[np.lexsort(expected.T)])
    visited = np.zeros(len(tree.corners), np.int64)

    def walk(node: int) -> tuple[Floats, Floats]:
        first, count = tree.links[node].tolist()
        if count:
            assert count <= LEAF
            visited[first : first + count] += 1
            own = tree.corners[first : first + count].reshape(-1, 3)
            low, high = own.min(axis=0), own.max(axis=0)
        else:
            (low_l, high_l), (low_r, high_r) = walk(node + 1), walk(first)
            low, high = np.minimum(low_l, low_r), np.maximum(high_l, high_r)
        box = tree.boxes[node].astype(np.float64)
        assert (box[:3] - box[3:] <= low).all()
        assert (box[:3] + box[3:] >= high).all()
        return low, high

    walk(0)
    assert (visited == 1).all()
    again = build_bvh(held)
    assert all(np.array_equal(a, b) for a, b in zip(tree, again, strict=True))


# --- files


def test_a_file_that_is_not_what_it_was_is_told(tmp_path: Path) -> None:
    held = triangles(ring())
    file = kept(held, tmp_path / "ring.npz")
    np.testing.assert_array_equal(triangles_of(file).faces, held.faces)
    other = file.model_copy(update={"sha256": "0" * 64})
    with pytest.raises(UsageError, match=r"ring\.npz: changed since its arena was made"):
        triangles_of(other)
    with pytest.raises(UsageError, match=r"gone\.npz: No such file"):
        triangles_of(file.model_copy(update={"file": str(tmp_path / "gone.npz")}))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"faces": np.zeros((0, 3), np.int32)}, "0 triangles: accepted: 1 to 200,000"),
        ({"faces": np.array([[0, 1, 9]], np.int32)}, "numbers of its 3 vertices"),
        ({"faces": np.array([[0, 1, 1]], np.int32)}, "at least one of which has an area"),
        ({"faces": np.array([[0, 1, 2]], np.int64)}, "accepted: int32"),
        ({"vertices": np.full((3, 3), np.nan, np.float32)}, "places within 50 m"),
        ({"vertices": np.zeros((3, 2), np.float32)}, "accepted: float32"),
    ],
)
def test_a_file_with_anything_else_gets_one_line(
    change: dict[str, NDArray[np.generic]], said: str, tmp_path: Path
) -> None:
    arrays: dict[str, NDArray[np.generic]] = {
        "vertices": np.eye(3, dtype=np.float32),
        "faces": np.array([[0, 1, 2]], np.int32),
    }
    path = tmp_path / "mesh.npz"
    np.savez(path, **(arrays | change))  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=said) as told:
        decoded(path.read_bytes(), "mesh.npz")
    assert "\n" not in str(told.value)


def test_what_is_no_archive_gets_one_line() -> None:
    for data in (b"", b"solid", encoded(triangles(ring()))[:200]):
        with pytest.raises(UsageError, match=r"mesh\.npz: not the triangles of a mesh"):
            decoded(data, "mesh.npz")
    # An archive of pickled objects is not opened.
    held = Triangles(np.array([[None]], object), np.zeros((1, 3), np.int32))
    with pytest.raises(UsageError, match=r"not the triangles of a mesh"):
        decoded(encoded(held), "mesh.npz")
