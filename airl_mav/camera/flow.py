"""Optical flow: the image velocity of the point that each pixel shows, in closed form.

A point p in the camera's axes moves by p' = R^T (v_point - v_camera) - w x p, where R are these
axes, and w is their angular velocity. Its image moves by the derivative of the projection along p'
(Longuet-Higgins and Prazdny, "The interpretation of a moving retinal image", 1980). Infinitely
distant points move by the rotation only.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.intrinsics import Intrinsics, rays_of
from airl_mav.camera.picture import Picture
from airl_mav.camera.primitives import OBSTACLE
from airl_mav.camera.render import Motion, Mount, camera_pose
from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import quat_to_matrix
from airl_mav.profiles.distortion import distorted, steepness

Floats = NDArray[np.float64]

MOVED_OVER_US = 1_000
"""Half interval of the central difference for velocities of moving obstacles [µs]."""

# Distance from the optical axis below which 1 / z replaces theta_d / aside.
_ON_AXIS = 1e-9


class CameraMotion(NamedTuple):
    """Pose and velocity of a camera."""

    position: Floats
    """(3,) NED [m]."""
    quaternion: Floats
    """(4,) camera -> NED; its x axis is the optical axis."""
    velocity: Floats
    """(3,) NED [m/s]."""
    rates: Floats
    """(3,) angular velocity about the camera's axes forward, right, down [rad/s]."""


def motion_of_camera(vehicle: Motion, mount: Mount) -> CameraMotion:
    """Return the motion of a camera mounted on a vehicle."""
    at, attitude = camera_pose(vehicle.position, vehicle.quaternion, mount)
    body = quat_to_matrix(vehicle.quaternion)
    lever = np.cross(vehicle.rates, np.array(mount.offset))
    axes = quat_to_matrix(np.array(attitude))
    rates = axes.T @ body @ vehicle.rates
    return CameraMotion(np.array(at), np.array(attitude), vehicle.velocity + body @ lever, rates)


def velocities_of(arena: Arena, elapsed_us: int) -> Floats:
    """Return the velocities (n, 3) NED [m/s] of all obstacles, `elapsed_us` after the start."""
    before, after = (
        arena.centers_at(elapsed_us + step) for step in (-MOVED_OVER_US, MOVED_OVER_US)
    )
    found: Floats = (after - before) * (US_PER_S / (2.0 * MOVED_OVER_US))
    return found


def optical_flow(
    picture: Picture, camera: Intrinsics, motion: CameraMotion, velocities: Floats
) -> NDArray[np.float32]:
    """Return the flow (h, w, 2) of a picture [px/s]; NaN outside a fisheye's field of view."""
    rays = rays_of(camera)
    axes = quat_to_matrix(motion.quaternion)
    depth = picture.depth_m.astype(np.float64)
    # Depth 0 is infinitely distant. Such points only turn, for which any depth will do.
    far = depth <= 0.0
    points = rays * np.where(far, 1.0, depth)
    number = picture.seen - OBSTACLE
    moves = np.zeros((*depth.shape, 3))
    if len(velocities):
        # Only obstacles move; room and sky have numbers below OBSTACLE.
        moves = np.where((number >= 0)[..., None], velocities[np.maximum(number, 0)], 0.0)
    apart = (moves - motion.velocity) @ axes
    apart[far] = 0.0
    turning = np.cross(motion.rates, np.moveaxis(points, 0, -1))
    flow = np.stack(_pushed(camera, points, np.moveaxis(apart - turning, -1, 0)), axis=-1)
    flow[~rays.any(axis=0)] = np.nan
    return flow.astype(np.float32)


def _pushed(camera: Intrinsics, points: Floats, moves: Floats) -> tuple[Any, Any]:
    """Return the image velocity [px/s] of points (3, h, w) with velocities `moves` (3, h, w)."""
    (z, x, y), (dz, dx, dy), f = points, moves, camera.focal
    # On the optical axis `aside` is 0; `np.where` selects the limit there.
    with np.errstate(invalid="ignore", divide="ignore"):
        if camera.projection == "pinhole":
            return f * (dx - x / z * dz) / z, f * (dy - y / z * dz) / z
        if camera.cylindrical:
            # Derivatives of focal * atan2(x, z) and focal * y / hypot(x, z).
            square = x * x + z * z
            away = np.sqrt(square)
            receding = (x * dx + z * dz) / square
            return f * (z * dx - x * dz) / square, f * (dy - y * receding) / away
        aside = np.hypot(x, y)
        off = np.arctan2(aside, z)
        growing = (x * dx + y * dy) / aside
        # Columns and rows are f c x and f c y, with c = theta_d / aside: 1 / z on the axis.
        share = np.where(aside > _ON_AXIS, distorted(off, camera.distortion) / aside, 1.0 / z)
        opening = (z * growing - aside * dz) / (aside * aside + z * z)
        opening = steepness(off, camera.distortion) * opening
        changing = np.where(aside > _ON_AXIS, (opening - share * growing) / aside, -dz / (z * z))
        return f * (changing * x + share * dx), f * (changing * y + share * dy)
