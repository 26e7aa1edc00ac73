"""Level range scans made of depth images, and earlier ones carried to where the vehicle is now.

A scan has a range for each of its bearings: how far from the camera, horizontally, the nearest
return is of those that are about as high as the camera. It is what a planar lidar on a level
platform measures, and what MAVLink's OBSTACLE_DISTANCE carries. Earlier scans are carried by the
vehicle's own motion since: what stands is then where it is in the newest, and the rest has moved.

With numpy, as the companion does it; `envs.encoding` has the same as compiled loops.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MM_PER_M
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import ned_to_heading, quats_to_euler
from airl_mav.policy.observation import Observation

Floats = NDArray[np.float64]

BAND_M = 0.9
"""Returns so much higher or lower than the camera belong to the scan. A row of a coarse image
(2 degrees) is 0.7 m high at 20 m, so that one at least is inside."""

NEAREST_M = 0.3
"""Range of byte 0; the rotors reach farther."""

WIDEST_RAD = 1.0
"""A return that is carried covers no more to either side, however near it comes."""


class Rays(NamedTuple):
    """Where a camera's pixels look that looks along the nose, in the body frame at a depth of 1."""

    forward: Floats
    """(w,) of each column."""
    right: Floats
    """(w,) of each column."""
    down: Floats
    """(h,) of each row."""
    fov_rad: float
    """Horizontal field of view, over which the bearings of a scan are spread."""


class Tilt(NamedTuple):
    """Attitudes of n cameras, without the heading."""

    sin_roll: Floats  # (n,)
    cos_roll: Floats
    sin_pitch: Floats
    cos_pitch: Floats


class Moved(NamedTuple):
    """How n vehicles have moved since an earlier scan."""

    forward_m: Floats
    """(n,) where it was made: so far ahead of where they are, in the present heading frame."""
    right_m: Floats
    turned_rad: Floats
    """(n,) by which their headings have grown, clockwise."""


class Scanning(NamedTuple):
    """What makes scans."""

    level: Callable[[NDArray[np.uint16], Rays, Tilt, int], Floats]
    carried: Callable[[Floats, Moved, float], Floats]


@cache
def rays_of(camera: Intrinsics) -> Rays:
    """Return where the pixels of a camera look: of a pinhole or a cylinder. Raises UsageError."""
    if camera.projection == "fisheye":
        raise UsageError("a fisheye gives no level scan; accepted: a pinhole or a cylinder")
    columns: Floats = (np.arange(camera.width, dtype=np.float64) - camera.cx) / camera.focal
    down: Floats = (np.arange(camera.height, dtype=np.float64) - camera.cy) / camera.focal
    if camera.cylindrical:
        return Rays(np.cos(columns), np.sin(columns), down, camera.horizontal_fov_rad)
    return Rays(np.ones(camera.width), columns, down, camera.horizontal_fov_rad)


def tilt_of(roll: Floats, pitch: Floats) -> Tilt:
    """Return the tilt (n,) of roll and pitch (n,) [rad]."""
    return Tilt(np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch))


def level_scan(depth_mm: NDArray[np.uint16], rays: Rays, tilt: Tilt, bearings: int) -> Floats:
    """Return the nearest horizontal ranges (n, bearings) [m] at about the height of the cameras.

    `depth_mm` are (n, h, w) images, 0 = no return. Bearings go from the left edge of the field of
    view to the right; infinite: nothing is there.
    """
    sr, cr, sp, cp = (np.asarray(each)[:, None, None] for each in tilt)
    depth = depth_mm / MM_PER_M
    ahead, right, down = depth * rays.forward, depth * rays.right, depth * rays.down[:, None]
    below = sr * right + cr * down
    high = cp * below - sp * ahead
    who, row, column = np.nonzero((depth_mm > 0) & (np.abs(high) <= BAND_M))
    at = who, row, column
    level_right = (cr * right - sr * down)[at]
    level_ahead = (cp * ahead + sp * below)[at]
    angle = np.arctan2(level_right, level_ahead) + 0.5 * rays.fov_rad
    bearing = np.floor(angle * (bearings / rays.fov_rad)).astype(np.int64)
    if goes_round(rays.fov_rad):
        bearing %= bearings
    inside = (bearing >= 0) & (bearing < bearings)
    found = np.full((len(depth_mm), bearings), np.inf)
    ranges = np.sqrt(level_ahead * level_ahead + level_right * level_right)
    np.minimum.at(found, (who[inside], bearing[inside]), ranges[inside])
    return found


def carried(scans: Floats, moved: Moved, fov_rad: float) -> Floats:
    """Return earlier scans (n, bearings) as if nothing but the vehicles had moved.

    Ranges [m] are infinite where nothing is. A return keeps its angular width. Hidden places stay
    unknown.
    """
    bearings = scans.shape[1]
    step = fov_rad / bearings
    who, bearing = np.nonzero(np.isfinite(scans))
    ranges = scans[who, bearing]
    angle = (bearing + 0.5) * step - 0.5 * fov_rad - moved.turned_rad[who]
    ahead = ranges * np.cos(angle) + moved.forward_m[who]
    right = ranges * np.sin(angle) + moved.right_m[who]
    now = np.sqrt(ahead * ahead + right * right)
    half = np.minimum(0.5 * step * ranges / np.maximum(now, NEAREST_M), WIDEST_RAD)
    angle = np.arctan2(right, ahead) + 0.5 * fov_rad
    # Of the bearings, those whose middle it covers, and the one that its own middle is in.
    middle = np.floor(angle / step).astype(np.int64)
    first = np.minimum(np.ceil((angle - half) / step - 0.5).astype(np.int64), middle)
    last = np.maximum(np.floor((angle + half) / step - 0.5).astype(np.int64), middle)
    found = np.full(scans.shape, np.inf)
    for k in range(int((last - first).max(initial=-1)) + 1):
        covered = first + k
        use = covered <= last
        if goes_round(fov_rad):
            covered %= bearings
        use &= (covered >= 0) & (covered < bearings)
        np.minimum.at(found, (who[use], covered[use]), now[use])
    return found


NUMPY_SCANNING = Scanning(level_scan, carried)
"""As the companion does it, which has no numba."""


def scans_of(
    seen: Observation, frames: int, bearings: int, make: Scanning = NUMPY_SCANNING
) -> Floats:
    """Return scans (n, frames, bearings) of n vehicles from here, the newest first [m]."""
    rays, now = rays_of(seen.intrinsics), seen.states[0]
    scans = np.full((len(seen.goal), frames, bearings), np.inf)
    images = (seen.depth_mm, *seen.earlier_mm)[:frames]
    for k, (image, state) in enumerate(zip(images, seen.states, strict=False)):
        roll, pitch, yaw = quats_to_euler(state.quaternion)
        scan = make.level(image, rays, tilt_of(roll, pitch), bearings)
        if k > 0:
            ahead = ned_to_heading(state.position - now.position, seen.yaw)
            moved = Moved(ahead[:, 0], ahead[:, 1], seen.yaw - yaw)
            scan = make.carried(scan, moved, rays.fov_rad)
        scans[:, k] = scan
    return scans


def goes_round(fov_rad: float) -> bool:
    """Return whether a field of view [rad] ends where it begins."""
    return fov_rad > 2.0 * math.pi - 1e-6


def scan_bytes(scans: Floats, range_m: float) -> NDArray[np.uint8]:
    """Return scans as a network takes them: logarithms of ranges, from NEAREST_M to `range_m`.

    A step is 1.7 % of the range where `range_m` is 20 m, so that what is near is seen to move
    sooner. 255: nothing, or farther.
    """
    return np.searchsorted(_edges(range_m), scans, side="right").astype(np.uint8)


@cache
def _edges(range_m: float) -> Floats:
    """Return the ranges (255,) [m] from which on each byte but 0 stands."""
    share = (np.arange(1, 256, dtype=np.float64) - 0.5) / 255.0
    return np.asarray(NEAREST_M * (range_m / NEAREST_M) ** share, np.float64)
