"""What a camera of any kind takes from a pose: depth, colour or grey, without noise."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.picture import grey, render_picture
from airl_mav.camera.render import render
from airl_mav.core.streams import words_of
from airl_mav.profiles.camera_kind import Renderer
from airl_mav.vehicle.rotation import Quat, Vec

PATHS = 16
"""Paths that Mitsuba traces through a pixel: their noise is that of a sensor in daylight."""


_SEEDS = 1 << 32


class Exposure(Protocol):
    """Takes images; see `expose`."""

    def __call__(
        self,
        arena: Arena,
        centers: NDArray[np.float64],
        intrinsics: Intrinsics,
        max_range: float,
        position: Vec | NDArray[np.float64],
        quaternion: Quat | NDArray[np.float64],
        number: int = 0,
    ) -> NDArray[Any]:
        """Return the image."""


def exposure_by(renderer: Renderer, name: str = "") -> Exposure:
    """Return what takes the images of a camera with this renderer; "" is the main camera."""
    return expose if renderer == "raycast" else PathTraced(1 + sum(words_of(name)))


class PathTraced:
    """Takes colour images by Mitsuba's path tracer, each number with noise of its own."""

    def __init__(self, first: int = 0) -> None:
        """Take the seed of image 0's noise; those of the next numbers follow, modulo 2^32."""
        # Imported here: what it draws with is an extra.
        from airl_mav.camera.mitsuba import PathTracer

        self._tracer = PathTracer(PATHS)
        self._first = first

    def __call__(
        self,
        arena: Arena,
        centers: NDArray[np.float64],
        intrinsics: Intrinsics,
        max_range: float,  # noqa: ARG002 (colour has no limit)
        position: Vec | NDArray[np.float64],
        quaternion: Quat | NDArray[np.float64],
        number: int = 0,
    ) -> NDArray[Any]:
        """Return the image; see `expose`. Raises as `mitsuba.PathTracer`."""
        pose = np.asarray(position), np.asarray(quaternion)
        seed = (self._first + number) % _SEEDS
        rgb = self._tracer(arena, centers, intrinsics, *pose, seed=seed)
        return rgb if intrinsics.kind == "rgb" else grey(rgb)[..., None]


def expose(
    arena: Arena,
    centers: NDArray[np.float64],
    intrinsics: Intrinsics,
    max_range: float,
    position: Vec | NDArray[np.float64],
    quaternion: Quat | NDArray[np.float64],
    number: int = 0,  # noqa: ARG001 (nothing is drawn by lot)
) -> NDArray[Any]:
    """Return the image that a camera takes of an arena, as in `Frame.image`; see `render.render`.

    Colour has no maximum depth. `number`: the image's in the episode, for renderers with noise.
    """
    if intrinsics.kind == "depth":
        return depth_to_z16(render(arena, centers, intrinsics, max_range, position, quaternion))
    rgb = render_picture(arena, centers, intrinsics, position, quaternion).rgb
    return rgb if intrinsics.kind == "rgb" else grey(rgb)[..., None]
