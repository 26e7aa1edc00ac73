"""Rays of a camera's pixels, of any projection; depends on numpy only.

A fisheye has r = f theta_d, with theta_d the angle from the optical axis as distorted by
`profiles.distortion`. Its depth is measured along the ray: along the optical axis it would be 0 at
90 degrees, and negative beyond.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.profiles.distortion import distorted, sees_to, undistorted


def rays_of(camera: Intrinsics) -> NDArray[np.float64]:
    """Return rays (3, h, w) forward, right, down at a depth of 1; 0 outside a fisheye's circle."""
    if camera.projection == "fisheye":
        return fisheye_rays(camera)
    rays = np.ones((3, camera.height, camera.width))
    across = (np.arange(camera.width) - camera.cx) / camera.focal
    if camera.cylindrical:
        rays[0], rays[1] = np.cos(across), np.sin(across)
    else:
        rays[1] = across
    rays[2] = ((np.arange(camera.height) - camera.cy) / camera.focal)[:, None]
    return rays


def finer(camera: Intrinsics, side: int) -> Intrinsics:
    """Return a camera with the same field of view and side x side pixels in place of each."""
    k = camera
    return replace(
        k,
        width=side * k.width,
        height=side * k.height,
        focal=side * k.focal,
        cx=side * (k.cx + 0.5) - 0.5,
        cy=side * (k.cy + 0.5) - 0.5,
    )


def fisheye_rays(camera: Intrinsics) -> NDArray[np.float64]:
    """Return unit rays (3, h, w) forward, right, down of a fisheye; 0 outside the circle."""
    across = (np.arange(camera.width) - camera.cx) / camera.focal
    down = ((np.arange(camera.height) - camera.cy) / camera.focal)[:, None]
    out = np.hypot(across, down)
    off = undistorted(out, camera.distortion)
    outside = np.isinf(off)
    off[outside] = 0.0
    # sin(off) / out, which is 1 in the middle.
    share = np.sinc(off / math.pi) * np.divide(off, out, out=np.ones_like(out), where=out > 0.0)
    rays = np.stack([np.cos(off), across * share, down * share])
    rays[:, outside] = 0.0
    return rays


def fisheye_places(camera: Intrinsics, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return columns and rows of points (3, ...); infinity outside the circle."""
    aside = np.hypot(points[1], points[2])
    off = np.arctan2(aside, points[0])
    scale = camera.focal * distorted(off, camera.distortion) / np.maximum(aside, 1e-9)
    scale = np.where(off > sees_to(camera.distortion), np.inf, scale)
    with np.errstate(invalid="ignore"):
        return points[1] * scale + camera.cx, points[2] * scale + camera.cy
