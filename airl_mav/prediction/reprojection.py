"""Reprojection of a depth image to another pose, from the newest images.

Every pixel with a return is a point. Points are transformed into the other camera, and each pixel
shows its nearest point. The newest image has priority; older images fill pixels that it did not see
(beyond its edges, occluded). Remaining pixels show level ground at the take-off height, and nothing
above the horizon. Moving objects are assumed to be static.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MAX_MM, MM_PER_M
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.rays import fisheye_places, fisheye_rays
from airl_mav.profiles.camera import Camera

LEAST_DEPTH_M = 0.05
"""Minimum depth [m]: points closer to the image plane, or a cylinder's axis, have no pixel."""

_RANK = 1 << 16
"""Rank step: older images rank behind all depths of newer ones."""

_UNSEEN = np.uint32(0xFFFFFFFF)

Image = NDArray[np.uint16]
Floats = NDArray[np.float32]


class CameraPose(NamedTuple):
    """Position and orientation of a camera."""

    position: NDArray[np.float64]  # (3,) NED [m]
    axes: NDArray[np.float64]  # (3, 3) columns: forward (optical axis), right, down, in NED


class PosedImage(NamedTuple):
    """Depth image and its camera pose."""

    depth_mm: Image  # (h, w), 0 = no return
    pose: CameraPose


class Reprojector:
    """Reprojects the images of one camera."""

    def __init__(self, camera: Camera, intrinsics: Intrinsics) -> None:
        """Take the camera, and the intrinsics of its images."""
        self._k = k = intrinsics
        self._range_m = camera.range_m
        u = (np.arange(k.width, dtype=np.float32) - np.float32(k.cx)) / np.float32(k.focal)
        v = (np.arange(k.height, dtype=np.float32) - np.float32(k.cy)) / np.float32(k.focal)
        rays = np.ones((3, k.height, k.width), np.float32)
        if k.projection == "fisheye":
            rays[:] = fisheye_rays(k)
        elif k.cylindrical:
            rays[0], rays[1] = np.cos(u)[None, :], np.sin(u)[None, :]
        else:
            rays[1] = u[None, :]
        if k.projection != "fisheye":
            rays[2] = v[:, None]
        self._rays = rays.reshape(3, -1)
        """(3, h w) viewing direction of each pixel at a depth of 1: forward, right, down."""
        self._sees = self._rays.any(axis=0)
        """(h w) True if a pixel has a direction: inside a fisheye's circle."""

    def image(self, sights: Sequence[PosedImage], pose: CameraPose) -> Image:
        """Return the depth image (h, w) [mm] from a pose. The newest sight is first."""
        k, size = self._k, self._rays.shape[1]
        nearest = np.full(size, _UNSEEN, np.uint32)
        for rank, sight in enumerate(sights):
            pixels, depth_mm = self._carried(sight, pose)
            np.minimum.at(nearest, pixels, depth_mm + np.uint32(rank * _RANK))
        out = (nearest & np.uint32(MAX_MM)).astype(np.uint16)
        # Points beyond the range were observed as empty.
        out[out == MAX_MM] = 0
        unseen = nearest == _UNSEEN
        out[unseen] = self._ground_mm(pose)[unseen]
        return out.reshape(k.height, k.width)

    def _carried(
        self, sight: PosedImage, pose: CameraPose
    ) -> tuple[NDArray[np.intp], NDArray[np.uint32]]:
        """Return the pixels hit by the points of an image, and their depths [mm]."""
        k = self._k
        turn = (pose.axes.T @ sight.pose.axes).astype(np.float32)
        shift = (pose.axes.T @ (sight.pose.position - pose.position)).astype(np.float32)
        mm = sight.depth_mm.reshape(-1)
        empty = mm == 0
        depth = mm * np.float32(1.0 / MM_PER_M)
        depth[empty] = self._range_m
        points = (turn @ self._rays) * depth
        forward, right = points[0] + shift[0], points[1] + shift[1]
        if k.projection == "fisheye":
            return self._on_fisheye(np.stack([forward, right, points[2] + shift[2]]), empty)
        there = np.hypot(forward, right) if k.cylindrical else forward
        kept = there > LEAST_DEPTH_M
        scale = np.float32(k.focal) / np.maximum(there, np.float32(LEAST_DEPTH_M))
        if k.cylindrical:
            column = self._bearing_column(forward, right)
        else:
            column = np.rint(right * scale + np.float32(k.cx))
        row = np.rint((points[2] + shift[2]) * scale + np.float32(k.cy))
        return self._fallen(column, row, there, kept, empty)

    def _on_fisheye(
        self, points: Floats, empty: NDArray[np.bool_]
    ) -> tuple[NDArray[np.intp], NDArray[np.uint32]]:
        """Return as `_carried` the fisheye pixels of points (3, h w) from the camera."""
        there = np.sqrt((points * points).sum(axis=0))
        column, row = (np.rint(place) for place in fisheye_places(self._k, points))
        kept = self._sees & (there > LEAST_DEPTH_M)
        return self._fallen(column, row, there, kept, empty)

    def _fallen(
        self,
        column: Floats,
        row: Floats,
        there: Floats,
        kept: NDArray[np.bool_],
        empty: NDArray[np.bool_],
    ) -> tuple[NDArray[np.intp], NDArray[np.uint32]]:
        """Return the pixels hit by points, filtered by `kept`, and their depths [mm]."""
        k = self._k
        kept &= (column >= 0) & (column < k.width) & (row >= 0) & (row < k.height)
        column, row, there, empty = column[kept], row[kept], there[kept], empty[kept]
        pixels = (row * np.float32(k.width) + column).astype(np.intp)
        carried_mm = np.rint(there * np.float32(MM_PER_M)).astype(np.uint32)
        carried_mm[empty | (there > self._range_m)] = MAX_MM
        return pixels, carried_mm

    def _bearing_column(self, forward: Floats, right: Floats) -> Floats:
        """Return the cylinder columns (h w) of points, modulo full turns."""
        k = self._k
        turn = np.float32(2.0 * math.pi * k.focal)
        column = np.arctan2(right, forward) * np.float32(k.focal) + np.float32(k.cx)
        # A point half a pixel left of the first column, on the seam, maps to the last one.
        column -= turn * np.floor((column + np.float32(0.5)) / turn)
        found: Floats = np.rint(column)
        return found

    def _ground_mm(self, pose: CameraPose) -> Image:
        """Return the depth (h w) [mm] of level ground at the height of the take-off."""
        sinking = pose.axes[2].astype(np.float32) @ self._rays
        height = np.float32(-pose.position[2])
        with np.errstate(divide="ignore"):
            depth = np.where(sinking > 0.0, height / sinking, np.inf)
        depth[(depth > self._range_m) | (depth < LEAST_DEPTH_M)] = 0.0
        ground: Image = np.rint(depth * np.float32(MM_PER_M)).astype(np.uint16)
        return ground
