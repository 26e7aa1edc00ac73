"""Conversion of a mesh to an asset: axis-aligned boxes that cover the mesh's surface.

The mesh is divided into cubic cells. Cells at the surface and inside a closed mesh are joined to
boxes, which exceed it by at most `MeshBoxes.beyond_m`. Cameras see the mesh itself (`triangles`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes

from airl_mav.arena.triangles import Triangles, areas
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.profiles.assets import MOST_PARTS, Asset, BoxPart

Up = Literal["auto", "y", "z"]

Y_UP = (".glb", ".gltf")
"""Formats specified with y up."""

FORMATS = (".stl", ".obj", ".glb", ".gltf", ".ply", ".off")

COARSEST, FINEST = 1.0, 1 / 48
"""Cell sizes tried, as shares of the longest side."""

FINER = 0.88
"""Factor from one cell size to the next."""

EDGE_SHARE = 0.5
"""Maximum edge of the subdivided surface triangles, as a share of a cell."""

MOST_CUTS = 20
"""Maximum subdivisions of an edge."""

MOST_PIECES = 500_000
"""Maximum estimated number of subdivided triangles; the number is up to four times as large."""

PATIENCE = 3
"""Consecutive sizes with too many boxes that end the search: finer cells mostly need more."""

LEAST_M, GREATEST_M = 0.01, 20.0
"""Minimum side of a part and maximum side of an asset [m]."""

_Y_TO_Z = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""Rotation of 90 degrees about x: y up becomes z up."""

Cells = NDArray[np.bool_]


@dataclass(frozen=True)
class MeshBoxes:
    """A mesh as an asset."""

    asset: Asset
    cell_m: float
    size_m: tuple[float, float, float]
    """Size of the mesh: forward, right, up [m]."""
    closed: bool
    """True if the mesh is watertight; its inside is filled."""
    surface: Triangles

    @property
    def beyond_m(self) -> float:
        """Maximum distance of the boxes beyond the mesh [m]."""
        return math.sqrt(3.0) * self.cell_m + EDGE_SHARE * self.cell_m


def boxes_of_mesh(
    path: Path, *, most: int = MOST_PARTS, scale: float = 1.0, up: Up = "auto"
) -> MeshBoxes:
    """Return a mesh as an asset of at most `most` boxes, with the finest possible cells.

    The origin is the middle of the mesh's footprint. The lowest point is at floor level. The x axis
    points forward. The file is STL, OBJ, GLB, glTF, PLY or OFF. `scale` is metres per unit of the
    file, `up` the axis that points up; "auto" = y for GLB and glTF, else z. Raises UsageError if
    the file cannot be read, has no surface, or is too large for an asset.
    """
    mesh = _read(path)
    if up == "y" or (up == "auto" and path.suffix.lower() in Y_UP):
        mesh.apply_transform(_Y_TO_Z)
    # From x forward, y left, z up to forward, right, up.
    mesh.apply_transform(np.diag((scale, -scale, scale, 1.0)))
    low, high = (np.asarray(each, np.float64) for each in mesh.bounds)
    size = high - low
    if not 0.0 < float(size.max()) <= GREATEST_M:
        sides = " x ".join(f"{side:.3g}" for side in size)
        raise FieldError(
            "mesh", str(path), f"at most {GREATEST_M:g} m a side, not {sides} m (see --scale)"
        )
    # Origin: middle of the footprint, lowest point at the floor.
    mesh.apply_translation((*-0.5 * (low + high)[:2], -low[2]))
    closed = bool(mesh.is_watertight)
    cell_m, parts = _finest(mesh, float(size.max()), closed, most)
    forward, right, height = map(float, size)
    surface = _surface(mesh)
    return MeshBoxes(Asset(parts=parts), cell_m, (forward, right, height), closed, surface)


def _surface(mesh: trimesh.Trimesh) -> Triangles:
    """Return the triangles of a mesh in its pose, without degenerate ones."""
    # Triangles have down, boxes have heights.
    vertices = (np.asarray(mesh.vertices, np.float64) * [1.0, 1.0, -1.0]).astype(np.float32)
    faces = np.asarray(mesh.faces, np.int32)
    return Triangles(vertices, faces[areas(vertices[faces]) > 0.0])


def _finest(
    mesh: trimesh.Trimesh, side_m: float, closed: bool, most: int
) -> tuple[float, tuple[BoxPart, ...]]:
    """Return the edge of the finest cells that need at most `most` boxes, and the boxes."""
    # One box around the mesh is always a solution.
    low, high = (np.asarray(each, np.float64) for each in mesh.bounds)
    found: tuple[float, tuple[BoxPart, ...]] = side_m, (_box(low, high),)
    vertices, faces = mesh.vertices, mesh.faces
    failed, share = 0, COARSEST
    while share >= FINEST and failed < PATIENCE:
        cell_m = share * side_m
        sides = np.linalg.norm(np.diff(vertices[faces[:, [0, 1, 2, 0]]], axis=1), axis=2)
        parts = np.maximum(sides.max(axis=1) / (EDGE_SHARE * cell_m), 1.0)
        if np.square(parts).sum() > MOST_PIECES:
            break
        # Subdivide the previous result; trimesh has no types for the function.
        vertices, faces = trimesh.remesh.subdivide_to_size(  # type: ignore[no-untyped-call]
            vertices, faces, EDGE_SHARE * cell_m, max_iter=MOST_CUTS
        )
        cells, corner = _cells(np.asarray(vertices, np.float64), cell_m, closed)
        boxes = joined(cells, most)
        if boxes is None:
            failed += 1
        else:
            failed = 0
            found = cell_m, tuple(_box(corner + cell_m * a, corner + cell_m * b) for a, b in boxes)
        share *= FINER
    return found


def joined(cells: Cells, most: int) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]] | None:
    """Return boxes that equal the set cells, first and one past last; None above `most`.

    Each box starts at the first free cell. The largest box over all orders of the axes is used.
    """
    left = cells.copy()
    boxes: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    while left.any():
        if len(boxes) >= most:
            return None
        first = np.array(np.unravel_index(int(left.argmax()), left.shape), np.int64)
        # The greedy growth depends on the order of axes, so try all six.
        ends = [_grown(left, first, order) for order in permutations(range(3))]
        end = max(ends, key=lambda each: int(np.prod(each - first)))
        left[tuple(map(slice, first, end))] = False
        boxes.append((first, end))
    return boxes


def _grown(left: Cells, first: NDArray[np.int64], order: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the end (exclusive) of a box grown from its first cell along axes in an order."""
    end = first + 1
    for axis in order:
        begin = first.copy()
        while end[axis] < left.shape[axis]:
            # Only the new layer of cells needs a test.
            begin[axis] = end[axis]
            further = end.copy()
            further[axis] += 1
            if not left[tuple(map(slice, begin, further))].all():
                break
            end = further
    return end


def _read(path: Path) -> trimesh.Trimesh:
    if path.suffix.lower() not in FORMATS:
        raise FieldError("mesh", str(path), f"a file that ends in {', '.join(FORMATS)}")
    try:
        # trimesh compares coordinates that may be NaN.
        with np.errstate(all="ignore"):
            mesh = trimesh.load(path, force="mesh")
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    except Exception as error:  # trimesh raises arbitrary exceptions for damaged files
        why = " ".join(str(error).split())
        raise UsageError(f"{path}: cannot be read as a mesh: {why}") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise UsageError(f"{path}: holds no triangles")
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise UsageError(f"{path}: its places do not have three coordinates each")
    if not np.isfinite(vertices).all():
        raise UsageError(f"{path}: has places that are no numbers")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UsageError(f"{path}: has triangles with corners that it does not have")
    return mesh


def _cells(
    corners: NDArray[np.float64], cell_m: float, closed: bool
) -> tuple[Cells, NDArray[np.float64]]:
    """Return the cells (a, b, c) that a mesh fills, and the corner of the first (3,) [m].

    `corners` (n, 3) belong to triangles with edges of at most e = `EDGE_SHARE` of a cell, so each
    point is at most e / sqrt(3) from a corner; cubes of that half side cover the surface.
    """
    reach_m = EDGE_SHARE * cell_m / math.sqrt(3.0)
    first = corners.min(axis=0) - reach_m
    size = np.ptp(corners, axis=0) + 2.0 * reach_m
    cells = np.zeros(np.ceil(size / cell_m).astype(np.int64), np.bool_)
    # The eight corners of a cube around each point mark all cells that it may reach.
    for sides in product((-reach_m, reach_m), repeat=3):
        at = np.floor((corners + sides - first) / cell_m).astype(np.int64)
        at = np.clip(at, 0, np.array(cells.shape) - 1)  # rounding at the last face
        cells[tuple(at.T)] = True
    return (binary_fill_holes(cells) if closed else cells), first


def _box(low: NDArray[np.float64], high: NDArray[np.float64]) -> BoxPart:
    least, most = low.copy(), high.copy()
    # Parts are not below the floor and have a minimum size.
    least[2], most[2] = max(float(least[2]), 0.0), max(float(most[2]), LEAST_M)
    middle, size = 0.5 * (least + most), np.maximum(most - least, LEAST_M)
    return BoxPart(
        shape="box",
        forward_m=_round(middle[0]),
        right_m=_round(middle[1]),
        bottom_m=_round(least[2]),
        length_m=_round(size[0]),
        width_m=_round(size[1]),
        height_m=_round(size[2]),
    )


def _round(value: float) -> float:
    return round(float(value), 4)
