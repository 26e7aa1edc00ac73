"""A fisheye as the ray casters take it: a ray of its own for each pixel."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from airl_mav.camera.equidistant import fisheye_rays
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import Bent
from airl_mav.profiles.distortion import sees_to


def bent_of(camera: Intrinsics) -> Bent | None:
    """Return the rays of a camera; None: it is no fisheye."""
    return _bent_of(camera) if camera.projection == "fisheye" else None


@lru_cache(maxsize=64)
def _bent_of(camera: Intrinsics) -> Bent:
    forward, right, down = np.ascontiguousarray(fisheye_rays(camera))
    # Numbers of one type, so that there is one compiled kernel.
    k1, k2, k3, k4 = (float(each) for each in camera.distortion)
    return Bent(forward, down, right, (k1, k2, k3, k4), sees_to(camera.distortion))
