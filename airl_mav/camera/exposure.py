"""Images of any camera kind from a pose: depth, colour or grey, without noise."""

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
from airl_mav.profiles.projections import Renderer
from airl_mav.vehicle.rotation import Quat, Vec

PATHS = 16
"""Mitsuba paths per pixel; the noise resembles a sensor in daylight."""


_SEEDS = 1 << 32


class Exposure(Protocol):
    """Interface of image functions; see `expose`."""

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
    """Return the image function of a camera for a renderer; "" is the main camera."""
    return expose if renderer == "raycast" else PathTraced(1 + sum(words_of(name)))


class PathTraced:
    """Colour images from Mitsuba's path tracer; each image number has different noise."""

    def __init__(self, first: int = 0) -> None:
        """Store the noise seed of image 0; later images count up from it, modulo 2^32."""
        # Imported here because Mitsuba is an optional dependency.
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
    """Return a camera's image of an arena, as in `Frame.image`; see `render.render`.

    Colour has no maximum depth. `number`: image number in the episode, for renderers with noise.
    """
    if intrinsics.kind == "depth":
        return depth_to_z16(render(arena, centers, intrinsics, max_range, position, quaternion))
    rgb = render_picture(arena, centers, intrinsics, position, quaternion).rgb
    return rgb if intrinsics.kind == "rgb" else grey(rgb)[..., None]
