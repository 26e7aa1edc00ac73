"""Triangles of a visible mesh, in a file beside the arena's profile, which has its SHA-256.

A NumPy archive (.npz) without pickled objects holds `vertices` (n, 3) float32, forward, right and
down from the asset's position on the floor [m], and `faces` (m, 3) int32, the triangles' corners.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import PlacedMesh
from airl_mav.core.errors import UsageError
from airl_mav.core.files import check_inflated
from airl_mav.profiles import assets, loading

KEPT = 16
"""Meshes cached in a process."""

MOST_DRAWN = 100_000
"""Maximum triangles of one scene in a browser."""


@dataclass(frozen=True, eq=False)
class Triangles:
    """m triangles. Compared by identity, as they are large."""

    vertices: NDArray[np.float32]  # (n, 3) forward, right, down [m]
    faces: NDArray[np.int32]  # (m, 3) numbers of vertices

    def __len__(self) -> int:
        """Return m."""
        return len(self.faces)

    @property
    def corners(self) -> NDArray[np.float32]:
        """The corners (m, 3, 3) of each triangle [m]."""
        return self.vertices[self.faces]


@lru_cache(maxsize=KEPT)
def triangles_of(file: assets.MeshFile) -> Triangles:
    """Return the triangles of a file, cached; UsageError if it is missing or changed."""
    return decoded(loading.read_checked(file), file.file)


def standing(placed: PlacedMesh) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return vertices (n, 3) NED [m] and faces (m, 3) of a mesh; raises as `triangles_of`."""
    held = triangles_of(placed.file)
    cos, sin = math.cos(placed.yaw), math.sin(placed.yaw)
    turn = placed.scale * np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    places: NDArray[np.float64] = held.vertices @ turn + [*placed.place, -placed.base_m]
    return places, held.faces


def drawn(meshes: Iterable[PlacedMesh], most: int = MOST_DRAWN) -> list[PlacedMesh]:
    """Return the meshes that scenes draw; large or missing ones are drawn as boxes instead."""
    shown: list[PlacedMesh] = []
    left = most
    for each in meshes:
        try:
            count = len(triangles_of(each.file))
        except UsageError:
            continue
        if count <= left:
            left -= count
            shown.append(each)
    return shown


def encoded(triangles: Triangles) -> bytes:
    """Return the file contents of triangles, deterministic."""
    held = io.BytesIO()
    np.savez(held, vertices=triangles.vertices, faces=triangles.faces)
    return held.getvalue()


def decoded(data: bytes, source: str) -> Triangles:
    """Return the triangles in a file's data, or UsageError naming `source`."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            check_inflated(archive.zip)
            vertices, faces = archive["vertices"], archive["faces"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        told = " ".join(f"{error}".split())
        raise UsageError(f"{source}: not the triangles of a mesh: {told}") from None
    if (problem := _problem(vertices, faces)) is not None:
        raise UsageError(f"{source}: {problem}")
    for each in (vertices, faces):
        # The cache shares the arrays between callers.
        each.setflags(write=False)
    return Triangles(vertices, faces)


def _problem(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> str | None:
    """Return the first error in the arrays of a file, or None."""
    for name, array, kind in (("vertices", vertices, np.float32), ("faces", faces, np.int32)):
        if array.dtype != kind or array.ndim != 2 or array.shape[1] != 3:
            return f"{name} {array.dtype} {array.shape}: accepted: {np.dtype(kind)} (n, 3)"
    if not 1 <= len(faces) <= assets.MOST_TRIANGLES:
        return f"{len(faces):,} triangles: accepted: 1 to {assets.MOST_TRIANGLES:,}"
    if int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        return f"faces: accepted: numbers of its {len(vertices):,} vertices"
    if not (np.abs(vertices) <= assets.GREATEST_M).all():  # also rejects NaN
        return f"vertices: accepted: places within {assets.GREATEST_M:g} m of the asset's"
    if not areas(vertices[faces]).any():
        return "faces: accepted: triangles, at least one of which has an area"
    return None


def areas(corners: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return twice the area (m,) [m²] of triangles by their corners (m, 3, 3) [m]."""
    sides = np.diff(corners.astype(np.float64), axis=1)
    twice: NDArray[np.float64] = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return twice
