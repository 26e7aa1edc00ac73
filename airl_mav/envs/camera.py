"""What every vehicle of a fleet sees: Z16 depth images, one compiled call for all."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MAX_MM, MM_PER_M
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.raycast import render_depth
from airl_mav.camera.render import Mount, camera_pose
from airl_mav.core.kernels import kernel
from airl_mav.envs.arenas import ArenaBatch, move_obstacles
from airl_mav.envs.fleet import Fleet


class Lens(NamedTuple):
    """The pinhole camera's constants; a tuple, so that compiled loops take it."""

    focal: float
    """Focal length [px]."""
    cx: float
    """Column of the optical axis [px]; pixel centres are at whole numbers."""
    cy: float
    """Row of the optical axis [px]."""
    range_m: float
    """Greatest depth along the optical axis that gives a return [m]."""


def lens_of(intrinsics: Intrinsics, range_m: float) -> Lens:
    """Return the lens of a camera that sees `range_m` [m] far."""
    return Lens(intrinsics.focal, intrinsics.cx, intrinsics.cy, range_m)


@kernel
def look(
    fleet: Fleet,
    arenas: ArenaBatch,
    who: NDArray[np.bool_],
    mount: Mount,
    lens: Lens,
    out: NDArray[np.uint16],
) -> None:
    """Render the depth image of every vehicle in `who`, from where it is now.

    Args:
        fleet: Poses and times.
        arenas: One a vehicle; moving obstacles are put where they are at its time.
        who: (n,) whose image is rendered; the others' stays as it is.
        mount: The camera's place on the body.
        lens: The camera.
        out: (n, height, width) depth along the optical axis [mm], written; 0 = no return. Rounded
            and clipped as `camera.frame.depth_to_z16` does.
    """
    image = np.empty(out.shape[1:], np.float32)
    for i in range(len(who)):
        if not who[i]:
            continue
        move_obstacles(arenas, i, fleet.time_us[i])
        count = arenas.n_obstacles[i]
        position, quaternion = camera_pose(fleet.position[i], fleet.quaternion[i], mount)
        render_depth(
            image,
            position,
            quaternion,
            lens.focal,
            lens.cx,
            lens.cy,
            lens.range_m,
            arenas.bounds[i],
            arenas.shape[i, :count],
            arenas.center[i, :count],
            arenas.half_size[i, :count],
            arenas.yaw[i, :count],
        )
        _to_z16(image, out[i])


@kernel
def _to_z16(depth_m: NDArray[np.float32], out: NDArray[np.uint16]) -> None:
    """Write depth [m] as millimetres: `camera.frame.depth_to_z16` without temporaries."""
    for v in range(depth_m.shape[0]):
        for u in range(depth_m.shape[1]):
            mm = np.rint(depth_m[v, u] * np.float32(MM_PER_M))
            out[v, u] = np.uint16(min(mm, np.float32(MAX_MM)))
