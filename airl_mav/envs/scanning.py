"""Level range scans of n vehicles by compiled loops: those of numpy, several times faster.

`policy.scans` says what they are; the companion, which has no numba, makes them with numpy.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MM_PER_M
from airl_mav.core.kernels import kernel
from airl_mav.policy.scans import (
    BAND_M,
    NEAREST_M,
    WIDEST_RAD,
    Floats,
    Moved,
    Rays,
    Scanning,
    Tilt,
    goes_round,
)


def level_scan(depth_mm: NDArray[np.uint16], rays: Rays, tilt: Tilt, bearings: int) -> Floats:
    """Return what `policy.scans.level_scan` returns."""
    found = np.full((len(depth_mm), bearings), np.inf)
    _level_scan(np.ascontiguousarray(depth_mm), rays, tilt, goes_round(rays.fov_rad), found)
    return found


def carried(scans: Floats, moved: Moved, fov_rad: float) -> Floats:
    """Return what `policy.scans.carried` returns."""
    found = np.full(scans.shape, np.inf)
    _carry(scans, moved, fov_rad, goes_round(fov_rad), found)
    return found


COMPILED_SCANNING = Scanning(level_scan, carried)
"""As the batch twin does it."""


@kernel
def _level_scan(
    depth_mm: NDArray[np.uint16], rays: Rays, tilt: Tilt, whole: bool, found: Floats
) -> None:
    bearings = found.shape[1]
    share = bearings / rays.fov_rad
    for i in range(len(depth_mm)):
        sr, cr = tilt.sin_roll[i], tilt.cos_roll[i]
        sp, cp = tilt.sin_pitch[i], tilt.cos_pitch[i]
        for v in range(depth_mm.shape[1]):
            for u in range(depth_mm.shape[2]):
                if depth_mm[i, v, u] == 0:
                    continue
                depth = depth_mm[i, v, u] / MM_PER_M
                ahead, right = depth * rays.forward[u], depth * rays.right[u]
                down = depth * rays.down[v]
                below = sr * right + cr * down
                if abs(cp * below - sp * ahead) > BAND_M:
                    continue
                level_right, level_ahead = cr * right - sr * down, cp * ahead + sp * below
                angle = math.atan2(level_right, level_ahead) + 0.5 * rays.fov_rad
                bearing = math.floor(angle * share)
                if whole:
                    bearing %= bearings
                if 0 <= bearing < bearings:
                    distance = math.sqrt(level_ahead * level_ahead + level_right * level_right)
                    found[i, bearing] = min(found[i, bearing], distance)


@kernel
def _carry(scans: Floats, moved: Moved, fov_rad: float, whole: bool, found: Floats) -> None:
    bearings = scans.shape[1]
    step = fov_rad / bearings
    for i in range(len(scans)):
        for bearing in range(bearings):
            distance = scans[i, bearing]
            if not math.isfinite(distance):
                continue
            angle = (bearing + 0.5) * step - 0.5 * fov_rad - moved.turned_rad[i]
            ahead = distance * math.cos(angle) + moved.forward_m[i]
            right = distance * math.sin(angle) + moved.right_m[i]
            now = math.sqrt(ahead * ahead + right * right)
            half = min(0.5 * step * distance / max(now, NEAREST_M), WIDEST_RAD)
            angle = math.atan2(right, ahead) + 0.5 * fov_rad
            middle = math.floor(angle / step)
            first = min(math.ceil((angle - half) / step - 0.5), middle)
            last = max(math.floor((angle + half) / step - 0.5), middle)
            for covered in range(first, last + 1):
                at = covered % bearings if whole else covered
                if 0 <= at < bearings:
                    found[i, at] = min(found[i, at], now)
