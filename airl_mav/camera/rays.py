"""What the pixels of a camera look along, of any projection; with numpy alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.equidistant import fisheye_rays
from airl_mav.camera.intrinsics import Intrinsics


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
    """Return a camera that sees the same with side x side pixels in the place of each."""
    k = camera
    return replace(
        k,
        width=side * k.width,
        height=side * k.height,
        focal=side * k.focal,
        cx=side * (k.cx + 0.5) - 0.5,
        cy=side * (k.cy + 0.5) - 0.5,
    )
