"""Visibility and direction of an obstacle in a camera frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena, Obstacles, PlacedMesh, Shape
from airl_mav.arena.ground import Ground
from airl_mav.camera.render import camera_pose, render
from airl_mav.core.frames import quat_yaw
from airl_mav.flight.trajectory import Trajectory, pose_at
from airl_mav.profiles.arena import DEFAULT_APPEARANCE
from airl_mav.report.policy_view import PolicyCamera

Floats = NDArray[np.float64]

NOTHING_M = 1e-6
"""Half extents of a removed obstacle [m]."""

SAME_DEPTH_M = 1e-3
"""Tolerance for depths of the same surface."""


@dataclass(frozen=True)
class ObstacleView:
    """Point of impact as seen from the vehicle at the exposure of a frame."""

    distance_m: float
    """Horizontal distance from the vehicle's centre [m]."""
    bearing_rad: float
    """Bearing from the vehicle's heading, positive to the right [rad]."""
    share: float | None
    """Share of the image that shows the obstacle, 0 to 1; None for a wall or the floor."""
    hidden: bool
    """True if the obstacle is within the image but completely occluded."""


def passes_through(arena: Arena, i: int, camera: PolicyCamera) -> bool:
    """Return True if obstacle i is glass and the camera measures through it."""
    clear = _clear(arena, camera)
    return clear is not None and bool(clear[i])


def _clear(arena: Arena, camera: PolicyCamera) -> NDArray[np.bool_] | None:
    """Return a mask (n,) of obstacles invisible to a camera; None if all are visible."""
    return arena.clear if camera.intrinsics.kind == "depth" else None


def bearing(quaternion: Floats, offset: Floats) -> float:
    """Return the bearing [rad] of an offset NED [m] from the heading, positive to the right."""
    angle = math.atan2(offset[1], offset[0]) - quat_yaw(quaternion)
    return math.remainder(angle, 2.0 * math.pi)


def nearest_spot(obstacles: Obstacles, i: int, center: Floats, position: Floats) -> Floats:
    """Return the point (2,) of obstacle i's outline nearest to a position NED [m]."""
    offset = position[:2] - center[:2]
    if obstacles.shape[i] == Shape.BOX:
        cos, sin = math.cos(float(obstacles.yaw[i])), math.sin(float(obstacles.yaw[i]))
        axes = np.array([[cos, sin], [-sin, cos]])
        half = obstacles.half_size[i, :2]
        spot: Floats = center[:2] + np.clip(axes @ offset, -half, half) @ axes
        return spot
    reach = float(np.linalg.norm(offset))
    radius = float(obstacles.half_size[i, 0])
    return center[:2] + offset * min(1.0, radius / reach if reach else 0.0)


def view_obstacle(
    path: Trajectory,
    frame_us: int,
    hit_us: int,
    arena: Arena,
    began_us: int,
    i: int,
    camera: PolicyCamera,
) -> ObstacleView:
    """Return direction and visibility of obstacle i in a frame; it may move since `began_us`."""
    position, _, quaternion = pose_at(path, frame_us)
    centers = arena.centers_at(frame_us - began_us)
    centers_then = arena.centers_at(hit_us - began_us)
    spot = nearest_spot(arena.obstacles, i, centers_then[i], pose_at(path, hit_us)[0])
    offset = spot + (centers[i] - centers_then[i])[:2] - position[:2]
    eye, attitude = camera_pose(position, quaternion, camera.mount)
    clear = _clear(arena, camera)
    if passes_through(arena, i, camera):
        distance = float(np.linalg.norm(offset))
        return ObstacleView(distance, bearing(quaternion, offset), 0.0, hidden=False)

    def depth(
        keep: slice, meshes: tuple[PlacedMesh, ...], ground: Ground | None = None
    ) -> NDArray[np.float32]:
        """Return the depth image (h, w) of the arena with only the kept obstacles."""
        o, half = arena.obstacles, arena.obstacles.half_size
        if clear is not None:
            # A negligible size makes glass invisible and keeps the obstacle numbers.
            half = np.where(clear[:, None], NOTHING_M, half)
        some = Obstacles(o.shape[keep], o.center[keep], half[keep], o.yaw[keep])
        # Without appearance and statics, all remaining obstacles are opaque.
        bare = replace(arena, obstacles=some, tours=(), meshes=meshes, ground=ground, statics=None)
        bare = replace(bare, appearance=DEFAULT_APPEARANCE)
        return render(bare, centers[keep], camera.intrinsics, camera.range_m, eye, attitude)

    whole = depth(slice(None), arena.meshes, arena.ground)
    empty = depth(slice(0, 0), ())
    if (mesh := arena.mesh_of(i)) is None:
        alone = depth(slice(i, i + 1), ())
    else:
        owned = slice(mesh.first, mesh.first + mesh.count)
        alone = depth(owned, (replace(mesh, first=0),))
    outline = np.abs(alone - empty) > SAME_DEPTH_M
    shown = outline & (np.abs(whole - alone) <= SAME_DEPTH_M)
    return ObstacleView(
        distance_m=float(np.linalg.norm(offset)),
        bearing_rad=bearing(quaternion, offset),
        share=float(shown.mean()),
        hidden=bool(outline.any() and not shown.any()),
    )


def view_wall(path: Trajectory, frame_us: int, hit_us: int, arena: Arena) -> ObstacleView:
    """Return the direction of a wall's point of impact at the exposure of a frame."""
    b = arena.bounds
    north, east = pose_at(path, hit_us)[0][:2]
    spots = np.array(
        [[b.north_max, east], [b.north_min, east], [north, b.east_max], [north, b.east_min]]
    )
    spot = spots[np.argmin(np.linalg.norm(spots - [north, east], axis=1))]
    position, _, quaternion = pose_at(path, frame_us)
    offset = spot - position[:2]
    return ObstacleView(
        float(np.linalg.norm(offset)), bearing(quaternion, offset), None, hidden=False
    )
