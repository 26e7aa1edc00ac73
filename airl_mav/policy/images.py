"""Inputs of networks from camera images: smaller images, depth as bytes, and level range scans.

A scan has a range for each of its bearings: the horizontal distance from the camera to the nearest
return at about the camera's height. A planar lidar on a level platform measures the same, and
MAVLink's OBSTACLE_DISTANCE carries it. Earlier scans are compensated for the vehicle's own motion:
static objects keep their position in the newest scan, moving ones do not.

This is the numpy version of the companion; `envs.observations` has the same as compiled loops.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera import frame, intrinsics
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import ned_to_heading, quats_to_euler
from airl_mav.policy.observation import Observation


class Bytes(NamedTuple):
    """Conversion of depths to the network's bytes."""

    table: NDArray[np.uint8]
    """(65536,) byte of each value of `nearest_returns`."""
    far_mm: float = 0.0
    """Scale of a linear conversion; 0 = use the table. A byte is 255 (value + 1) / far_mm in single
    precision, rounded to nearest and at most 255. Compilers vectorize this, unlike a table."""


class Shrink(NamedTuple):
    """Conversions from camera images to network images."""

    depth: Callable[[NDArray[np.uint16], int, int, Bytes], NDArray[np.uint8]]
    """Conversion of Z16 images (n, h, w), with rows, columns and `Bytes`, to byte images
    (n, rows, columns)."""
    colour: Callable[[NDArray[np.uint8], int, int], NDArray[np.uint8]]
    """Conversion of sRGB or grey images (n, h, w, channels), with rows and columns, to block means
    (n, channels, rows, columns)."""
    scanning: Scanning
    """Conversion of depth images to level scans."""


def shrink_depth(
    depth_mm: NDArray[np.uint16], rows: int, columns: int, bytes_of: Bytes
) -> NDArray[np.uint8]:
    """Return network images of depth images with numpy; see `Shrink.depth`."""
    return bytes_of.table[nearest_returns(depth_mm, rows, columns)]


def shrink_colour(image: NDArray[np.uint8], rows: int, columns: int) -> NDArray[np.uint8]:
    """Return network images of colour images with numpy; see `Shrink.colour`.

    A pixel is the mean of its block's sRGB numbers, halves rounded up: area resampling as in OpenCV
    (INTER_AREA) and Pillow (BOX).
    """
    n, height, width, channels = image.shape
    tall, wide = height // rows, width // columns
    planes = image.transpose(0, 3, 1, 2)
    if tall == wide == 1:
        return np.ascontiguousarray(planes)
    blocks = planes.reshape(n, channels, rows, tall, columns, wide).astype(np.uint32)
    count = tall * wide
    mean: NDArray[np.uint8] = ((blocks.sum(axis=(3, 5)) + count // 2) // count).astype(np.uint8)
    return mean


def nearest_returns(depth_mm: NDArray[np.uint16], rows: int, columns: int) -> NDArray[np.uint16]:
    """Shrink Z16 images (n, h, w) to (n, rows, columns). The nearest return of each block wins.

    Values are one less than in the images, so that "no return" (0) wraps around to the maximum.
    """
    image = depth_mm - np.uint16(1)
    vertical, horizontal = depth_mm.shape[1] // rows, depth_mm.shape[2] // columns
    nearest = image[:, ::vertical]
    for k in range(1, vertical):
        nearest = np.minimum(nearest, image[:, k::vertical])
    image, nearest = nearest, nearest[:, :, ::horizontal]
    for k in range(1, horizontal):
        nearest = np.minimum(nearest, image[:, :, k::horizontal])
    return nearest


def _depths_m(range_m: float) -> NDArray[np.float64]:
    """Return the depth [m] of every value of `nearest_returns`; infinite beyond the range."""
    depth = (np.arange(frame.MAX_MM + 1) + 1) / frame.MM_PER_M
    depth[(depth > range_m) | (np.arange(frame.MAX_MM + 1) == frame.MAX_MM)] = np.inf
    return depth


@cache
def body_bytes(range_m: float) -> Bytes:
    """Return bytes proportional to depth: 0 is at the lens, 255 at the range and beyond."""
    share = np.minimum(_depths_m(range_m) / range_m, 1.0)
    table = np.rint(255.0 * share).astype(np.uint8)
    far_mm = range_m * frame.MM_PER_M
    values = np.arange(1, frame.MAX_MM + 2).astype(np.float32)
    ratios = np.float32(255.0) * values / np.float32(far_mm)
    in_single = np.rint(np.minimum(ratios, np.float32(255.0))).astype(np.uint8)
    return Bytes(table, far_mm if np.array_equal(in_single, table) else 0.0)


@cache
def paper_bytes(range_m: float) -> Bytes:
    """Return Air Learning's mapping (airlearning-rl, getScreenDepthVis).

    255 / max(1 m, depth) truncated to a byte, inverted, to the tenth power of the byte's range.
    """
    byte = (255.0 / np.maximum(1.0, _depths_m(range_m))).astype(np.uint8)
    return Bytes((255.0 * ((255.0 - byte) / 255.0) ** 10).astype(np.uint8))


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
def rays_of(camera: intrinsics.Intrinsics) -> ScanRays:
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
    depth = depth_mm / frame.MM_PER_M
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


NUMPY = Shrink(shrink_depth, shrink_colour, Scanning(level_scan, carried))
"""Numpy versions, for the companion without numba."""


def scans_of(
    seen: Observation, frames: int, bearings: int, make: Scanning = NUMPY.scanning
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
