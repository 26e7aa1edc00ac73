"""The depth kernel against a float64 brute-force caster, pybullet's renderer and closed forms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pybullet
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.camera import projection
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import MIN_DEPTH_M, lens_of
from airl_mav.camera.raycast import render_depth
from airl_mav.camera.render import Mount, camera_pose, render
from airl_mav.core.frames import (
    ned_to_enu,
    quat_from_euler,
    quat_multiply,
    quat_to_matrix,
)
from airl_mav.profiles.projections import PROJECTIONS, UNDISTORTED, Projection, sees_to
from tests.support.lenses import BARREL, ENDING, OPENING, rays_of_fisheye

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
RIGHT_ANGLE = Intrinsics.from_fov(33, 25, math.pi / 2)  # Odd: the centre pixel is the optical axis.


@dataclass
class Scene:
    bounds: Bounds
    obstacles: Obstacles
    position: np.ndarray
    quaternion: np.ndarray
    intrinsics: Intrinsics
    max_range: float

    def render(self) -> np.ndarray:
        arena = Arena("test", 0, self.bounds, (0, 0, 0), self.obstacles, (), np.zeros(2))
        return render(
            arena,
            self.obstacles.center,
            self.intrinsics,
            self.max_range,
            self.position,
            self.quaternion,
        )


Body = tuple[Shape, Sequence[float], Sequence[float], float]
"""Shape, centre, half size, yaw."""


def obstacles(*bodies: Body) -> Obstacles:
    return Obstacles(
        np.array([b[0] for b in bodies], np.int8),
        np.array([b[1] for b in bodies], np.float64).reshape(-1, 3),
        np.array([b[2] for b in bodies], np.float64).reshape(-1, 3),
        np.array([b[3] for b in bodies], np.float64),
    )


def seen(
    *bodies: Body,
    position: Sequence[float] = (0.0, 0.0, -2.0),
    quaternion: np.ndarray = LEVEL,
    max_range: float = 100.0,
    side: float = 20.0,
) -> np.ndarray:
    """Render bodies in a square room with 5 m walls."""
    bounds = Bounds(-side, side, -side, side, 5.0)
    return Scene(
        bounds,
        obstacles(*bodies),
        np.array(position),
        np.asarray(quaternion),
        RIGHT_ANGLE,
        max_range,
    ).render()


# --- the reference: every ray against every surface, float64, no culling, no slabs ---------------


class Rays:
    """All rays of an image; `hit` keeps the nearest crossing of each."""

    def __init__(self, scene: Scene) -> None:
        k = scene.intrinsics
        v, u = np.mgrid[: k.height, : k.width]
        x, y = (u - k.cx) / k.focal, (v - k.cy) / k.focal
        ahead, right = (np.cos(x), np.sin(x)) if k.projection == "cylindrical" else (x**0, x)
        camera = np.stack([ahead, right, y], -1)
        if k.projection == "fisheye":
            camera = rays_of_fisheye(k)
        attitude = Rotation.from_quat(np.roll(scene.quaternion, -1)).as_matrix()
        self.d = camera.reshape(-1, 3) @ attitude.T
        self.o = np.array([*scene.position[:2], min(scene.position[2], -MIN_DEPTH_M)])
        self.t = np.full(len(self.d), np.inf)
        self.body = np.full(len(self.d), -1)  # Which was hit: -1 nothing or the room, else number.
        self.number = -1

    def hit(self, t: np.ndarray, where: np.ndarray) -> None:
        nearer = where & (t > 0) & (t < self.t)
        self.t[nearer] = t[nearer]
        self.body[nearer] = self.number

    def rectangle(
        self, d: np.ndarray, o: np.ndarray, axis: int, at: float, low: np.ndarray, high: np.ndarray
    ) -> None:
        """Cross the plane x[axis] = at where the other coordinates are within low..high."""
        t = (at - o[axis]) / d[:, axis]
        p = o + t[:, None] * d
        others = [i for i in range(3) if i != axis]
        within = [(p[:, i] >= low[i]) & (p[:, i] <= high[i]) for i in others]
        self.hit(t, within[0] & within[1])

    def room(self, b: Bounds) -> None:
        low = np.array([b.north_min, b.east_min, -b.height])
        high = np.array([b.north_max, b.east_max, 0.0])
        for axis in (0, 1):
            self.rectangle(self.d, self.o, axis, low[axis], low, high)
            self.rectangle(self.d, self.o, axis, high[axis], low, high)
        self.rectangle(self.d, self.o, 2, 0.0, low, high)
        if b.ceiling:
            self.rectangle(self.d, self.o, 2, low[2], low, high)

    def box(self, center: np.ndarray, half: np.ndarray, yaw: float) -> bool:
        turn = Rotation.from_euler("z", -yaw).as_matrix()
        o, d = turn @ (self.o - center), self.d @ turn.T
        for axis in range(3):
            for sign in (-1.0, 1.0):
                self.rectangle(d, o, axis, sign * half[axis], -half, half)
        return bool(np.all(np.abs(o) <= half))

    def quadratic(self, a: Any, b: np.ndarray, c: float) -> tuple[np.ndarray, np.ndarray]:
        """Return both roots of a t² + 2 b t + c; NaN if they are not real."""
        root = np.sqrt(b * b - a * c)
        return (-b - root) / a, (-b + root) / a

    def cylinder(self, center: np.ndarray, half: np.ndarray) -> bool:
        o, radius = self.o - center, half[0]
        a = np.sum(self.d[:, :2] ** 2, axis=1)
        b = self.d[:, :2] @ o[:2]
        c = o[:2] @ o[:2] - radius**2
        for t in self.quadratic(a, b, c):
            self.hit(t, np.abs(o[2] + t * self.d[:, 2]) <= half[2])
        for cap in (-half[2], half[2]):
            t = (cap - o[2]) / self.d[:, 2]
            p = o[:2] + t[:, None] * self.d[:, :2]
            self.hit(t, np.sum(p**2, axis=1) <= radius**2)
        return bool(c <= 0.0 and abs(o[2]) <= half[2])

    def sphere(self, center: np.ndarray, radius: float) -> bool:
        o = self.o - center
        c = o @ o - radius**2
        for t in self.quadratic(np.sum(self.d**2, axis=1), self.d @ o, c):
            self.hit(t, np.isfinite(t))
        return bool(c <= 0.0)


def brute_force(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return depth [m] and obstacle numbers (-1: none), both (height, width)."""
    rays, k, o = Rays(scene), scene.intrinsics, scene.obstacles
    inside = False
    with np.errstate(all="ignore"):
        rays.room(scene.bounds)
        for shape, center, half, yaw in zip(o.shape, o.center, o.half_size, o.yaw, strict=True):
            rays.number += 1
            if shape == Shape.BOX:
                inside |= rays.box(center, half, yaw)
            elif shape == Shape.CYLINDER:
                inside |= rays.cylinder(center, half)
            else:
                inside |= rays.sphere(center, half[0])
    returned = np.isfinite(rays.t) & (rays.t <= scene.max_range)
    depth = np.where(returned, np.maximum(rays.t, MIN_DEPTH_M), 0.0)
    if inside:
        depth[:] = np.where(np.isnan(rays.d[:, 0]), 0.0, MIN_DEPTH_M)
    return depth.reshape(k.height, k.width), rays.body.reshape(k.height, k.width)


def random_scene(rng: np.random.Generator) -> Scene:
    """Make a room of random size and obstacles, and a camera in, near, above or outside of it."""
    north, east = rng.uniform(4.0, 30.0, 2)
    shift = rng.uniform(-4.0, 4.0)
    bounds = Bounds(shift - north, shift + north, -east, east, rng.uniform(1.0, 8.0))
    n = int(rng.integers(0, 13))
    shape = rng.integers(0, 3, n).astype(np.int8)
    half = rng.uniform(0.1, 2.5, (n, 3))
    half[shape == Shape.CYLINDER, 1] = half[shape == Shape.CYLINDER, 0]
    half[shape == Shape.SPHERE] = half[shape == Shape.SPHERE, :1]
    center = rng.uniform([-north, -east, -6.0], [north, east, 0.0], (n, 3))
    position = rng.uniform([-north, -east, -0.9 * bounds.height], [north, east, -0.05])
    where = rng.random()
    if where < 0.2:  # Above the walls.
        position[2] = -bounds.height - rng.uniform(0.0, 6.0)
    elif where < 0.3:  # Anywhere around, also outside and below the floor.
        position = rng.uniform([-40.0, -40.0, -15.0], [40.0, 40.0, 0.1])
    elif where < 0.5 and n:  # Beside or inside an obstacle.
        position = center[0] + rng.uniform(-1.5, 1.5, 3) * half[0]
    if rng.random() < 0.5:
        roll, pitch = rng.normal(0.0, 0.2, 2)
        quaternion = quat_from_euler(roll, pitch, rng.uniform(-np.pi, np.pi))
    else:
        quaternion = rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
    width, height = rng.integers(5, 49), rng.integers(4, 37)
    k = Intrinsics.from_fov(int(width), int(height), rng.uniform(0.4, 2.6))
    max_range = math.inf if rng.random() < 0.2 else rng.uniform(3.0, 60.0)
    yaw = rng.uniform(-np.pi, np.pi, n)
    return Scene(bounds, Obstacles(shape, center, half, yaw), position, quaternion, k, max_range)


def all_round(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return a scene seen by a cylinder, every other time one of a full turn."""
    k = scene.intrinsics
    fov = 2.0 * math.pi if rng.random() < 0.5 else rng.uniform(0.4, 2.0 * math.pi)
    return replace(scene, intrinsics=Intrinsics.from_fov(2 * k.width, k.height, fov, "cylindrical"))


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(1, 10))]
)
@pytest.mark.parametrize("projection", PROJECTIONS)
def test_agrees_with_brute_force(projection: Projection, seed: int) -> None:
    rng = np.random.default_rng(seed)
    returns = escapes = inside = 0
    for number in range(100):
        scene = random_scene(rng)
        if projection == "cylindrical":
            scene = all_round(scene, rng)
        elif projection == "fisheye":
            k, bent = scene.intrinsics, (UNDISTORTED, BARREL, OPENING, ENDING)[number % 4]
            fov = rng.uniform(0.4, 2.0 * sees_to(bent))
            lens = Intrinsics.from_fov(k.width, k.height, fov, "fisheye", distortion=bent)
            scene = replace(scene, intrinsics=lens)
        depth, expected = scene.render(), brute_force(scene)[0]
        error = float(np.max(np.abs(depth - expected)))
        assert error < 1e-4, f"scene {number}: {error} m, {scene}"
        returns += int(np.count_nonzero(expected > MIN_DEPTH_M))
        escapes += int(np.count_nonzero(expected == 0.0))
        inside += bool(np.all((expected == np.float64(MIN_DEPTH_M)) | (expected == 0.0)))
    # The scenes must not be trivial.
    assert returns > 15_000
    assert escapes > 3_000
    assert inside > 0


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_a_ceiling_agrees_with_brute_force(projection: Projection) -> None:
    """From inside, from above and from beside: of every scene with and without it."""
    rng = np.random.default_rng(77)
    overhead = 0
    for number in range(100):
        scene = random_scene(rng)
        if projection == "cylindrical":
            scene = all_round(scene, rng)
        closed = replace(scene, bounds=replace(scene.bounds, ceiling=True))
        depth, expected = closed.render(), brute_force(closed)[0]
        error = float(np.max(np.abs(depth - expected)))
        assert error < 1e-4, f"scene {number}: {error} m, {closed}"
        overhead += int(np.count_nonzero(expected != brute_force(scene)[0]))
    assert overhead > 3_000


# --- pybullet ------------------------------------------------------------------------------------


def points_on(shape: Shape, half: np.ndarray) -> np.ndarray:
    """Return points whose convex hull is the body.

    pybullet's own cylinder and sphere are too coarse: centimetres off the true surface.
    """
    if shape == Shape.BOX:
        return half * np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3)
    if shape == Shape.CYLINDER:
        turn = np.linspace(0.0, 2.0 * np.pi, 160, endpoint=False)
        rim = np.stack([np.cos(turn), np.sin(turn), np.ones_like(turn)], axis=1)
        return half * np.concatenate([rim, rim * [1.0, 1.0, -1.0]])
    i = np.arange(4000)  # A Fibonacci sphere.
    z, angle = 1.0 - (2.0 * i + 1.0) / len(i), i * np.pi * (3.0 - math.sqrt(5.0))
    ring = np.sqrt(1.0 - z * z)
    return half * np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def add_body(
    client: int,
    shape: int,
    center: Sequence[float] | np.ndarray,
    half: Sequence[float] | np.ndarray,
    yaw: float,
) -> None:
    points = points_on(Shape(shape), np.asarray(half, np.float64))
    faces = ConvexHull(points).simplices
    visual = pybullet.createVisualShape(
        pybullet.GEOM_MESH,
        vertices=ned_to_enu(points).tolist(),
        # Both sides: pybullet draws only the front of a triangle.
        indices=np.concatenate([faces, faces[:, ::-1]]).ravel().tolist(),
        physicsClientId=client,
    )
    # The vertices' axes were swapped one by one, so that yaw is a turn about -up.
    turn = (0.0, 0.0, -math.sin(0.5 * yaw), math.cos(0.5 * yaw))
    position = ned_to_enu(np.asarray(center, np.float64)).tolist()
    pybullet.createMultiBody(0, -1, visual, position, turn, physicsClientId=client)


def tiny_renderer(client: int, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return pybullet's depth [m] and body numbers (-1 = none), both (height, width)."""
    k, near, far = scene.intrinsics, 0.05, 60.0
    forward, _, down = quat_to_matrix(scene.quaternion).T
    view = pybullet.computeViewMatrix(
        ned_to_enu(scene.position).tolist(),
        ned_to_enu(scene.position + forward).tolist(),
        ned_to_enu(-down).tolist(),
    )
    vertical_fov = math.degrees(2.0 * math.atan(0.5 * k.height / k.focal))
    projection = pybullet.computeProjectionMatrixFOV(vertical_fov, k.width / k.height, near, far)
    image = pybullet.getCameraImage(
        k.width,
        k.height,
        view,
        projection,
        shadow=0,
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=client,
    )
    buffer = np.reshape(image[3], (k.height, k.width)).astype(np.float64)
    body = np.reshape(image[4], (k.height, k.width))
    return far * near / (far - (far - near) * buffer), body


def off_edges(body: np.ndarray) -> np.ndarray:
    """Return which pixels have all eight neighbours, all on the same body."""
    same = np.zeros(body.shape, bool)
    h, w = body.shape
    shifted = [body[v : h - 2 + v, u : w - 2 + u] for v in range(3) for u in range(3)]
    same[1:-1, 1:-1] = np.all([s == shifted[4] for s in shifted], axis=0)
    return same


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_pybullet_tiny_renderer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bounds = Bounds(-10.0, 10.0, -12.0, 12.0, 4.0)
    shape = np.tile(np.array([0, 1, 2], np.int8), 3)
    half = rng.uniform(0.4, 1.4, (9, 3))
    half[shape == Shape.CYLINDER, 1] = half[shape == Shape.CYLINDER, 0]
    half[shape == Shape.SPHERE] = half[shape == Shape.SPHERE, :1]
    center = rng.uniform([-9, -11, -3], [9, 11, -0.5], (9, 3))
    bodies = Obstacles(shape, center, half, rng.uniform(-np.pi, np.pi, 9))
    client = pybullet.connect(pybullet.DIRECT)
    try:
        for row in zip(bodies.shape, bodies.center, bodies.half_size, bodies.yaw, strict=True):
            add_body(client, *row)
        add_body(client, Shape.BOX, (0, 0, 0.5), (10, 12, 0.5), 0.0)
        for side in (-1, 1):
            add_body(client, Shape.BOX, (side * 10.5, 0, -2), (0.5, 12, 2), 0.0)
            add_body(client, Shape.BOX, (0, side * 12.5, -2), (10, 0.5, 2), 0.0)
        compared, bodies_seen = 0, set()
        for _ in range(12):
            position = rng.uniform([-9, -11, -3.5], [9, 11, -0.3])
            if np.min(np.linalg.norm(center - position, axis=1)) < 2.5:
                continue  # Inside, or nearer than pybullet's near plane.
            roll, pitch = rng.normal(0.0, 0.25, 2)
            attitude = quat_from_euler(roll, pitch, rng.uniform(-np.pi, np.pi))
            w, h = 64, 48
            # TinyRenderer samples the lower left corner of a pixel, not its centre.
            corner = Intrinsics(w, h, 0.5 * w, 0.5 * w, 0.5 * h - 1.0)
            scene = Scene(bounds, bodies, position, attitude, corner, 60.0)
            expected, body = tiny_renderer(client, scene)
            # Edges by both: TinyRenderer loses bodies that are smaller than a pixel.
            compare = off_edges(body) & off_edges(brute_force(scene)[1]) & (body >= 0)
            error = np.abs(scene.render() - expected)[compare]
            assert np.max(error) < 0.02
            compared += error.size
            bodies_seen |= set(body[compare].tolist())
    finally:
        pybullet.disconnect(client)
    assert compared > 5_000
    assert len(bodies_seen) > 8


# --- closed forms and edge cases -----------------------------------------------------------------


def test_depth_is_planar_not_along_the_ray() -> None:
    depth = seen()  # A wall 20 m ahead, square to the optical axis.
    np.testing.assert_allclose(depth[12], 20.0, rtol=1e-6)


def test_floor_depth_follows_the_row() -> None:
    depth = seen(position=(0.0, 0.0, -2.0))
    k = RIGHT_ANGLE
    for v in range(14, k.height):
        expected = 2.0 * k.focal / (v - k.cy)  # Height / slope.
        if expected < 20.0:
            np.testing.assert_allclose(depth[v], expected, rtol=1e-6)


def test_ray_over_the_walls_has_no_return() -> None:
    depth = seen()
    # The wall rises 3 m above the camera at 20 m: slope 0.15.
    slopes = (np.arange(25) - RIGHT_ANGLE.cy) / RIGHT_ANGLE.focal
    assert np.all((depth[:, 16] == 0.0) == (slopes < -0.15))


def test_walls_are_seen_from_outside_and_over() -> None:
    assert seen(position=(-30.0, 0.0, -2.0))[12, 16] == pytest.approx(10.0)
    over = seen(position=(-30.0, 0.0, -6.0))
    assert over[12, 16] == 0.0  # Level, 1 m over the wall.
    # Steeper, a ray goes over the near wall to the far one, 50 m away; then it meets the near
    # wall; at last it passes below the floor, which ends at the walls.
    k = RIGHT_ANGLE
    slopes = (np.arange(13, 25) - k.cy) / k.focal
    expected = np.where(slopes < 0.1, 50.0, np.where(slopes < 0.6, 10.0, 0.0))
    assert set(expected) == {50.0, 10.0, 0.0}
    np.testing.assert_allclose(over[13:, 16], expected, rtol=1e-6)


def test_range_limits_depth_along_the_axis() -> None:
    assert np.all(seen(max_range=19.99)[12] == 0.0)
    assert np.all(seen(max_range=20.01)[12] > 0.0)
    depth = seen((Shape.SPHERE, (8.0, 0, -2.0), (1, 1, 1), 0.0), max_range=6.9)
    assert depth[12, 16] == 0.0


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ((Shape.BOX, (6, 0, -2), (1, 2, 1), 0.0), 5.0),
        ((Shape.BOX, (6, 0, -2), (1, 2, 1), math.pi / 2), 4.0),
        ((Shape.BOX, (6, 0, -2), (1, 1, 1), math.pi / 4), 6.0 - math.sqrt(2.0)),
        ((Shape.CYLINDER, (6, 0, -2), (1.5, 1.5, 2), 0.0), 4.5),
        ((Shape.SPHERE, (6, 0, -2), (0.5, 0.5, 0.5), 0.0), 5.5),
    ],
)
def test_distance_to_a_body_ahead(body: Body, expected: float) -> None:
    assert seen(body)[12, 16] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("shape", list(Shape))
def test_body_behind_the_camera_is_not_seen(shape: Shape) -> None:
    np.testing.assert_array_equal(seen((shape, (-3, 0, -2), (1, 1, 1), 0.3)), seen())


@pytest.mark.parametrize("shape", list(Shape))
def test_body_across_the_image_plane(shape: Shape) -> None:
    # 1.1 m to the right, reaching 1 m ahead and 1 m behind.
    depth = seen((shape, (0, 1.1, -2), (1, 1, 1), 0.0))
    assert np.all(depth[12, :17] == seen()[12, :17])
    assert 0.0 < depth[12, -1] < 1.0


@pytest.mark.parametrize("shape", list(Shape))
def test_camera_inside_a_body(shape: Shape) -> None:
    depth = seen((shape, (0, 0, -2), (1, 1, 1), 0.3), position=(0.4, 0.3, -2.2))
    assert np.all(depth == np.float32(MIN_DEPTH_M))


@pytest.mark.parametrize("shape", list(Shape))
def test_camera_on_the_surface(shape: Shape) -> None:
    toward = seen((shape, (1, 0, -2), (1, 1, 1), 0.0))
    assert toward[12, 16] == np.float32(MIN_DEPTH_M)
    assert np.all(np.isfinite(toward))
    away = seen((shape, (-1, 0, -2), (1, 1, 1), 0.0))
    assert np.all(np.isfinite(away))


@pytest.mark.parametrize("shape", list(Shape))
def test_camera_a_micrometre_off_the_surface_looks_away(shape: Shape) -> None:
    away = seen((shape, (-1, 0, -2), (1, 1, 1), 0.0), position=(1e-6, 0.0, -2.0))
    np.testing.assert_array_equal(away, seen(position=(1e-6, 0.0, -2.0)))


def test_vertical_rays_and_caps() -> None:
    pillar = (Shape.CYLINDER, (0, 0, -1), (0.5, 0.5, 1), 0.0)
    straight_down = quat_from_euler(0.0, -math.pi / 2, 0.0)
    above = seen(pillar, position=(0.0, 0.0, -3.0), quaternion=straight_down)
    assert above[12, 16] == pytest.approx(1.0)
    beside = seen(pillar, position=(0.0, 0.6, -3.0), quaternion=straight_down)
    assert beside[12, 16] == pytest.approx(3.0)


@pytest.mark.parametrize("down", [0.0, 0.02, -0.0005])
def test_camera_resting_on_the_floor_still_sees(down: float) -> None:
    depth = seen((Shape.BOX, (5, 0, -1), (1, 1, 1), 0.0), position=(0.0, 0.0, down))
    assert depth[12, 16] == pytest.approx(4.0)
    assert np.all(depth[14:] < 0.1)


def test_nothing_to_see_without_walls_in_range() -> None:
    up = quat_from_euler(0.0, math.pi / 2, 0.0)
    assert not np.any(seen(quaternion=up)[5:-5, 5:-5])


def test_obstacles_move_with_the_centers_given() -> None:
    bodies = obstacles((Shape.SPHERE, (6, 0, -2), (1, 1, 1), 0.0))
    arena = Arena("t", 0, Bounds(-20, 20, -20, 20, 5), (0, 0, 0), bodies, (), np.zeros(2))
    at = np.array([[9.0, 0.0, -2.0]])
    depth = render(arena, at, RIGHT_ANGLE, 50.0, np.array([0.0, 0.0, -2.0]), LEVEL)
    assert depth[12, 16] == pytest.approx(8.0)


def test_writes_into_the_image_of_a_batch() -> None:
    scene = random_scene(np.random.default_rng(3))
    k, o = scene.intrinsics, scene.obstacles
    batch = np.full((3, k.height, k.width), 7.0, np.float32)
    bodies = projection.Scene(scene.bounds.as_array(), o.shape, o.center, o.half_size, o.yaw)
    pose = tuple(scene.position), tuple(scene.quaternion)
    render_depth(batch[1], *pose, lens_of(k, scene.max_range), bodies, None)
    np.testing.assert_array_equal(batch[1], scene.render())
    assert np.all(batch[[0, 2]] == 7.0)


def test_camera_pose_agrees_with_scipy() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        vehicle = Rotation.from_quat(rng.normal(size=4))
        position, offset = rng.normal(size=3), rng.normal(size=3)
        pitch_up = rng.uniform(-1.5, 1.5)
        at, q = camera_pose(
            tuple(position), tuple(np.roll(vehicle.as_quat(), 1)), Mount(tuple(offset), pitch_up)
        )
        np.testing.assert_allclose(at, position + vehicle.apply(offset), atol=1e-12)
        expected = vehicle * Rotation.from_euler("y", pitch_up)
        np.testing.assert_allclose(
            Rotation.from_quat(np.roll(q, -1)).as_matrix(), expected.as_matrix(), atol=1e-12
        )


def test_mount_pitched_up_looks_up() -> None:
    _, q = camera_pose((0.0, 0.0, -2.0), (1.0, 0.0, 0.0, 0.0), Mount((0.1, 0.0, 0.0), 0.4))
    assert quat_to_matrix(np.array(q))[2, 0] == pytest.approx(-math.sin(0.4))  # Down is positive.


# --- all round -----------------------------------------------------------------------------------

PANORAMA = Intrinsics.from_fov(72, 41, 2.0 * math.pi, "cylindrical")  # 5 degrees a column.
STRAIGHT_AHEAD = 35.5
"""Column of the optical axis, between two pixels."""


def all_round_from(
    *bodies: Body, quaternion: np.ndarray = LEVEL, intrinsics: Intrinsics = PANORAMA
) -> np.ndarray:
    """Render bodies around a camera 2 m above the middle of a room of 40 m."""
    scene = Scene(
        Bounds(-20.0, 20.0, -20.0, 20.0, 5.0),
        obstacles(*bodies),
        np.array([0.0, 0.0, -2.0]),
        quaternion,
        intrinsics,
        100.0,
    )
    return scene.render()


@pytest.mark.parametrize("degrees", range(-180, 180, 15))
def test_a_pillar_is_seen_at_its_bearing(degrees: int) -> None:
    """Also behind the camera, where it is half at either end of the image."""
    bearing = math.radians(degrees)
    center = (8.0 * math.cos(bearing), 8.0 * math.sin(bearing), -2.0)
    found = all_round_from((Shape.CYLINDER, center, (1.0, 1.0, 1.5), 0.0))
    empty = all_round_from()
    changed = np.flatnonzero((found != empty).any(axis=0))
    angles = np.radians((np.arange(72) - STRAIGHT_AHEAD) * 5.0)
    off = np.remainder(angles - bearing + math.pi, 2.0 * math.pi) - math.pi
    half = math.asin(1.0 / 8.0)  # Of a circle of 1 m, 8 m away.
    np.testing.assert_array_equal(changed, np.flatnonzero(np.abs(off) < half))
    # The near side of a circle along a ray; depth is that in the horizontal plane.
    near = 8.0 * np.cos(off[changed]) - np.sqrt(1.0 - (8.0 * np.sin(off[changed])) ** 2)
    np.testing.assert_allclose(found[20, changed], near, atol=1e-5)


def test_the_seam_is_where_the_image_s_ends_meet() -> None:
    """A turn by one column to the right shifts the image by one column, with wrap-around."""
    bodies = [
        (Shape.BOX, (-9.0, 0.3, -1.5), (0.7, 1.8, 1.5), 0.4),
        (Shape.SPHERE, (4.0, 5.0, -2.5), (1.2, 1.2, 1.2), 0.0),
        (Shape.CYLINDER, (-3.0, -2.5, -1.0), (0.5, 0.5, 1.0), 0.0),
    ]
    straight = all_round_from(*bodies)
    for columns in (1, 20, 36, 71):
        turned = quat_from_euler(0.0, 0.0, math.radians(5.0 * columns))
        seen = all_round_from(*bodies, quaternion=turned)
        np.testing.assert_allclose(seen, np.roll(straight, -columns, axis=1), atol=1e-4)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.3, -0.2), (-0.5, 0.6)])
def test_along_the_same_directions_a_cylinder_sees_what_a_pinhole_sees(
    tilt: tuple[float, float],
) -> None:
    """The two models are of one arena: turned to a column, a pinhole's middle one is the same."""
    scene = random_scene(np.random.default_rng(11))
    body = quat_from_euler(*tilt, 0.7)
    center = np.array([0.0, 0.0, -2.0])
    k = PANORAMA
    pinhole = Intrinsics(1, k.height, k.focal, 0.0, k.cy)
    scene = replace(scene, position=center, max_range=60.0)
    image = replace(scene, quaternion=body, intrinsics=k).render()
    returns = 0
    for column in range(k.width):
        turn = quat_from_euler(0.0, 0.0, (column - k.cx) / k.focal)
        there = replace(scene, quaternion=quat_multiply(body, turn), intrinsics=pinhole).render()
        np.testing.assert_allclose(image[:, [column]], there, rtol=1e-5, atol=1e-5)
        returns += int(np.count_nonzero(there))
    assert returns > 500


def test_a_body_above_or_below_is_seen_by_all_columns() -> None:
    overhead = all_round_from((Shape.BOX, (0.0, 0.0, -6.0), (8.0, 8.0, 0.5), 0.3))
    # The lowest corner-free circle: its lower face 3.5 m above, cut by the rows that reach it.
    slope = -(np.arange(41) - 20.0) / PANORAMA.focal
    for row in np.flatnonzero(slope > 3.5 / 8.0):
        np.testing.assert_allclose(overhead[row], 3.5 / slope[row], rtol=1e-5)
