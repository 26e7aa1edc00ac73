"""Cameras of a vehicle: mounting, pose, and images of any kind, without noise."""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.bvh import meshes_of
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import Scene, lens_of
from airl_mav.camera.raycast import render_depth
from airl_mav.core.addons import load_entry
from airl_mav.core.kernels import kernel
from airl_mav.profiles.camera import Camera
from airl_mav.vehicle.rotation import Quat, Vec, exponential, multiply, rotate

RANGE_M: Final = 10_000.0
"""Range of a colour camera [m]; exceeds every arena."""


class Mount(NamedTuple):
    """Mounting of a camera on the vehicle; a tuple, because compiled loops require one."""

    offset: Vec
    """Position of the camera in the body frame FRD [m]."""
    pitch_up: float
    """Angle of the optical axis above the body's level plane [rad]."""
    yaw: float = 0.0
    """Heading of the optical axis from the body's forward axis, clockwise seen from above [rad]."""

    @classmethod
    def of(cls, camera: Camera) -> Mount:
        """Return the mounting of a vehicle profile's camera."""
        offset = (camera.forward_m, camera.right_m, -camera.up_m)
        return cls(offset, math.radians(camera.pitch_up_deg), math.radians(camera.yaw_deg))


class Motion(NamedTuple):
    """Pose and velocity of a vehicle."""

    position: NDArray[np.float64]
    """(3,) NED [m]."""
    quaternion: NDArray[np.float64]
    """(4,) unit [w, x, y, z] body -> NED."""
    velocity: NDArray[np.float64]
    """(3,) NED [m/s]."""
    rates: NDArray[np.float64]
    """(3,) angular velocity FRD [rad/s]."""

    @classmethod
    def at_rest(cls, position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> Motion:
        """Return the motion of a vehicle at rest."""
        return cls(position, quaternion, np.zeros(3), np.zeros(3))


@kernel
def carried_on(motion: Motion, seconds: float) -> tuple[Vec, Quat]:
    """Return position and attitude after a time [s] at constant velocity and angular rates."""
    p, v, q, w = motion.position, motion.velocity, motion.quaternion, motion.rates
    turned = exponential((seconds * w[0], seconds * w[1], seconds * w[2]))
    at = (p[0] + seconds * v[0], p[1] + seconds * v[1], p[2] + seconds * v[2])
    return at, multiply((q[0], q[1], q[2], q[3]), turned)


@kernel
def camera_pose(
    position: Vec | NDArray[np.float64], quaternion: Quat | NDArray[np.float64], mount: Mount
) -> tuple[Vec, Quat]:
    """Return NED position [m] and quaternion of a camera mounted on a vehicle's pose."""
    q = (quaternion[0], quaternion[1], quaternion[2], quaternion[3])
    x, y, z = rotate(q, mount.offset)
    # A positive rotation about the body's right axis raises the nose.
    half = 0.5 * mount.pitch_up
    tilt = (math.cos(half), 0.0, math.sin(half), 0.0)
    # Intrinsic order: yaw about the body's down axis, then pitch.
    if mount.yaw != 0.0:
        turn = 0.5 * mount.yaw
        tilt = multiply((math.cos(turn), 0.0, 0.0, math.sin(turn)), tilt)
    return (position[0] + x, position[1] + y, position[2] + z), multiply(q, tilt)


def pose_of(
    position: Vec | NDArray[np.float64], quaternion: Quat | NDArray[np.float64]
) -> tuple[Vec, Quat]:
    """Return a camera's pose as tuples, as at level gym, so that one renderer is compiled."""
    north, east, down = (float(part) for part in position)
    w, x, y, z = (float(part) for part in quaternion)
    return (north, east, down), (w, x, y, z)


def scene_of(arena: Arena, centers: NDArray[np.float64]) -> Scene:
    """Return room and obstacles of an arena for kernels, with centres (n, 3) NED [m]."""
    o = arena.obstacles
    return Scene(arena.bounds.as_array(), o.shape, centers, o.half_size, o.yaw)


def render(
    arena: Arena,
    centers: NDArray[np.float64],
    intrinsics: Intrinsics,
    max_range: float,
    position: Vec | NDArray[np.float64],
    quaternion: Quat | NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the depth image (height, width) [m] of an arena; 0 = no return.

    Depth rays pass through glass obstacles to the surfaces behind them. `centers` (n, 3) is the
    result of `Arena.centers_at`. The pose is the camera's, NED [m], camera -> NED. Raises
    UsageError if a mesh's file is missing or has changed.
    """
    image = np.empty((intrinsics.height, intrinsics.width), np.float32)
    meshes = meshes_of(arena.meshes, len(arena.obstacles), arena.ground, arena.clear)
    pose = pose_of(position, quaternion)
    render_depth(image, *pose, lens_of(intrinsics, max_range), scene_of(arena, centers), meshes)
    return image


def colour(name: str) -> Any:
    """Return a part of colour cameras. Raises UsageError without the add-on that renders colour.

    Parts: `expose` renders an image, `sensor` is the class of image formation, `batch` renders the
    images of n vehicles and `looks` holds the appearance of their arenas, `look` and `clear` are an
    arena's appearance and its mask of glass.
    """
    return load_entry("airl_mav", "COLOUR", name, ("camera.kind", "rgb or grey"), "colour")


def expose(
    arena: Arena,
    centers: NDArray[np.float64],
    intrinsics: Intrinsics,
    max_range: float,
    position: Vec | NDArray[np.float64],
    quaternion: Quat | NDArray[np.float64],
) -> NDArray[Any]:
    """Return a camera's image of an arena, as in `Frame.image`; see `render.render`.

    Colour has no maximum depth.
    """
    if intrinsics.kind == "depth":
        return depth_to_z16(render(arena, centers, intrinsics, max_range, position, quaternion))
    image: NDArray[Any] = colour("expose")(arena, centers, intrinsics, position, quaternion)
    return image
