"""Level range scans from depth images, with earlier scans moved to the present position.

A scan has a range for each of its bearings: the horizontal distance from the camera to the nearest
return at about the camera's height. A planar lidar on a level platform measures the same, and
MAVLink's OBSTACLE_DISTANCE carries it. Earlier scans are compensated for the vehicle's own motion:
static objects keep their position in the newest scan, moving ones do not.

This is the numpy version of the companion; `envs.encoding` has the same as compiled loops.
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
"""Maximum height difference between camera and returns of a scan [m]. A row of a coarse image
(2 degrees) is 0.7 m high at 20 m, so that at least one row is inside."""

NEAREST_M = 0.3
"""Range of byte 0 [m]; the rotors extend farther."""

WIDEST_RAD = 1.0
"""Maximum half width of a moved return [rad], however near it is."""


class ScanRays(NamedTuple):
    """Rays of a camera along the nose, in the body frame at a depth of 1."""

    forward: Floats
    """(w,) of each column."""
    right: Floats
    """(w,) of each column."""
    down: Floats
    """(h,) of each row."""
    fov_rad: float
    """Horizontal field of view, divided into the bearings of a scan."""


class Tilt(NamedTuple):
    """Attitudes of n cameras, without the heading."""

    sin_roll: Floats  # (n,)
    cos_roll: Floats
    sin_pitch: Floats
    cos_pitch: Floats


class Moved(NamedTuple):
    """Motion of n vehicles since an earlier scan."""

    forward_m: Floats
    """(n,) position of the earlier scan in the present heading frame."""
    right_m: Floats
    turned_rad: Floats
    """(n,) change of heading since, clockwise."""


class Scanning(NamedTuple):
    """Functions that compute scans."""

    level: Callable[[NDArray[np.uint16], ScanRays, Tilt, int], Floats]
    carried: Callable[[Floats, Moved, float], Floats]


@cache
def rays_of(camera: Intrinsics) -> ScanRays:
    """Return the rays of a pinhole or cylindrical camera. Raises UsageError for a fisheye."""
    if camera.model.tabled:
        raise UsageError(
            f"a {camera.projection} gives no level scan; accepted: a pinhole or a cylinder"
        )
    columns: Floats = (np.arange(camera.width, dtype=np.float64) - camera.cx) / camera.focal
    down: Floats = (np.arange(camera.height, dtype=np.float64) - camera.cy) / camera.focal
    if camera.model.cylindrical:
        return ScanRays(np.cos(columns), np.sin(columns), down, camera.horizontal_fov_rad)
    return ScanRays(np.ones(camera.width), columns, down, camera.horizontal_fov_rad)


def tilt_of(roll: Floats, pitch: Floats) -> Tilt:
    """Return the tilt (n,) of roll and pitch (n,) [rad]."""
    return Tilt(np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch))


def level_scan(depth_mm: NDArray[np.uint16], rays: ScanRays, tilt: Tilt, bearings: int) -> Floats:
    """Return the nearest horizontal ranges (n, bearings) [m] at about the height of the cameras.

    `depth_mm` are (n, h, w) images, 0 = no return. Bearings run from the left edge of the field of
    view to the right. Infinite = no return.
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
    """Return earlier scans (n, bearings) compensated for the vehicles' motion.

    Ranges [m] are infinite without a return. A return keeps its width. Occluded places stay
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
    # Bearings with their middle inside the return, and the bearing of the return's own middle.
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
"""Numpy versions, for the companion without numba."""


def scans_of(
    seen: Observation, frames: int, bearings: int, make: Scanning = NUMPY_SCANNING
) -> Floats:
    """Return scans (n, frames, bearings) [m] of n vehicles in the present pose, newest first."""
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
    """Return whether a field of view [rad] is a full circle."""
    return fov_rad > 2.0 * math.pi - 1e-6


def scan_bytes(scans: Floats, range_m: float) -> NDArray[np.uint8]:
    """Return scans as bytes for a network: logarithms of ranges, from NEAREST_M to `range_m`.

    A step is 1.7 % of the range if `range_m` is 20 m, so that the motion of near objects shows
    sooner. 255 = no return, or farther.
    """
    return np.searchsorted(_edges(range_m), scans, side="right").astype(np.uint8)


@cache
def _edges(range_m: float) -> Floats:
    """Return the lower range limits (255,) [m] of all bytes but 0."""
    share = (np.arange(1, 256, dtype=np.float64) - 0.5) / 255.0
    return np.asarray(NEAREST_M * (range_m / NEAREST_M) ** share, np.float64)
