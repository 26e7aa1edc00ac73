"""What a camera of any kind takes from a pose: depth, colour or grey, without noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.picture import grey, render_picture
from airl_mav.camera.render import render
from airl_mav.vehicle.rotation import Quat, Vec


def expose(
    arena: Arena,
    centers: NDArray[np.float64],
    intrinsics: Intrinsics,
    max_range: float,
    position: Vec | NDArray[np.float64],
    quaternion: Quat | NDArray[np.float64],
) -> NDArray[Any]:
    """Return the image of an arena that a camera takes, as `Frame.image` holds it.

    Args:
        arena: What is seen.
        centers: (n, 3) present obstacle centres NED [m], as `Arena.centers_at` gives them.
        intrinsics: The camera.
        max_range: Greatest depth that gives a return [m]; colour has no limit.
        position: (3,) camera NED [m].
        quaternion: (4,) unit [w, x, y, z] camera -> NED; its x axis is the optical axis.
    """
    if intrinsics.kind == "depth":
        return depth_to_z16(render(arena, centers, intrinsics, max_range, position, quaternion))
    rgb = render_picture(arena, centers, intrinsics, position, quaternion).rgb
    return rgb if intrinsics.kind == "rgb" else grey(rgb)[..., None]
