"""Resampling of an image with arbitrary rays from pinhole images of a cube's faces.

For renderers that only support pinholes. A pixel is divided into `side` x `side` samples. Each
sample's ray leaves the cube through one face and takes the value of the nearest pixel there. Only
faces with rays are rendered, and only the rectangle that the rays cover.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics, finer, rays_of
from airl_mav.profiles.projections import sees_to, steepness


Floats2 = 0
FACES = tuple((axis, sign) for axis in range(3) for sign in (1.0, -1.0))
"""Camera axis (forward, right, down) perpendicular to a face, and the side of the face."""

MOST_SIDE = 4
"""Maximum samples along each side of a pixel."""

MOST_PLACES = 1 << 24
"""Maximum samples of an image; the search takes about a hundred bytes for each sample."""


class Face(NamedTuple):
    """One face of the cube: the axes of its image, and the rendered part."""

    axes: Floats
    """(3, 3) rows forward, right, down of the face's camera, in the camera's axes forward, right,
    down."""
    pixels: int
    """Pixels along each side of the whole face, a pinhole of 90 degrees."""
    left: int
    top: int
    width: int
    height: int
    places: NDArray[np.intp]
    """(n,) indices of the samples (h side, w side), flattened, that look through this face."""
    source: NDArray[np.intp]
    """(n,) pixel of the rendered part, flattened, for each sample."""


class Cube(NamedTuple):
    """Cube faces of an image and their mapping to pixels."""

    shape: tuple[int, int]
    """Rows and columns of the image."""
    side: int
    faces: tuple[Face, ...]


def side_for(camera: Intrinsics, samples: int) -> int:
    """Return the samples along each side of a pixel for a total number of samples."""
    side = min(MOST_SIDE, math.isqrt(samples))
    # Large images get fewer samples, because the search holds all of them in memory.
    while side > 1 and side * side * camera.width * camera.height > MOST_PLACES:
        side -= 1
    return side


def cube_of(camera: Intrinsics, side: int) -> Cube:
    """Return the cube faces of a camera's image with side x side samples per pixel.

    Faces are coarsest in the middle, where they match the resolution of the image's middle times
    `side`. Around it a fisheye's image is finer, by half at 90 degrees.
    """
    k, fine = camera, finer(camera, side)
    rays = rays_of(fine)
    # A pixel outside the field of view is entirely black.
    blind = ~rays_of(k).any(axis=0)
    rays[:, np.repeat(np.repeat(blind, side, axis=0), side, axis=1)] = 0.0
    rays = rays.reshape(3, -1)
    # A pinhole of 90 degrees is two focal lengths wide.
    pixels = 2 * math.ceil(fine.focal * _finest(k))
    # A ray leaves the cube through the face of its largest component.
    across = np.abs(rays).argmax(axis=0)
    sees = rays.any(axis=0)
    faces = []
    for axis, sign in FACES:
        places = np.flatnonzero(sees & (across == axis) & (sign * rays[axis] > 0.0))
        if len(places):
            faces.append(_face(rays[:, places], places, axis, sign, pixels))
    return Cube((k.height, k.width), side, tuple(faces))


def resampled(cube: Cube, images: list[Floats]) -> Floats:
    """Return the image (h, w, channels) from faces: mean of each pixel's samples, 0 without any."""
    height, width = cube.shape
    side, channels = cube.side, images[0].shape[-1] if images else 3
    light = np.zeros((height * side * width * side, channels))
    seen = np.zeros(len(light))
    for face, image in zip(cube.faces, images, strict=True):
        light[face.places] = image.reshape(-1, channels)[face.source]
        seen[face.places] = 1.0
    blocks = (height, side, width, side)
    total = light.reshape(*blocks, channels).sum(axis=(1, 3))
    count = seen.reshape(blocks).sum(axis=(1, 3))
    mean: Floats = total / np.maximum(count, 1.0)[..., None]
    return mean


def _finest(k: Intrinsics) -> float:
    """Return the maximum pixels per angle of an image, relative to the focal length."""
    if k.projection != "fisheye":
        return 1.0
    # The slope of the lens polynomial is sampled over half the field of view.
    angles = np.linspace(0.0, min(0.5 * k.horizontal_fov_rad, sees_to(k.distortion)), 65)
    return float(np.max(steepness(angles, k.distortion)))


def _face(rays: Floats, places: NDArray[np.intp], axis: int, sign: float, pixels: int) -> Face:
    """Return the face for rays (3, n) of these samples."""
    forward, right = np.zeros(3), np.zeros(3)
    forward[axis] = sign
    # The rotation about the optical axis is arbitrary.
    right[(axis + 1) % 3] = 1.0
    axes = np.stack([forward, right, np.cross(forward, right)])
    ahead, aside, below = axes @ rays
    # The ratios are in -1..1 on a face; the clip catches rays on its edge.
    column, row = (
        np.clip(((0.5 + 0.5 * part / ahead) * pixels).astype(np.intp), 0, pixels - 1)
        for part in (aside, below)
    )
    left, top = int(column.min()), int(row.min())
    width, height = int(column.max()) - left + 1, int(row.max()) - top + 1
    source = (row - top) * width + column - left
    return Face(axes, pixels, left, top, width, height, places, source)
