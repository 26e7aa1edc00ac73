"""Bounding volume hierarchy over the triangles of a mesh, built once for each mesh.

The tree is binary, with boxes along the mesh's axes (Wald, On fast construction of SAH-based
bounding volume hierarchies, 2007). Each node is split where the expected cost of a ray is lowest,
from the surface areas of both sides, among `BINS` positions along each axis. The tree is stored in
flat arrays, depth first. The left child of an inner node is the next node.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Ground, PlacedMesh, Relief, no_relief
from airl_mav.arena.relief import plane_at
from airl_mav.arena.triangles import KEPT, Triangles, triangles_of
from airl_mav.camera.primitives import GROUND, OBSTACLE
from airl_mav.camera.projection import MIN_DEPTH_M
from airl_mav.core.kernels import borrowing_kernel, large_kernel
from airl_mav.profiles.assets import MeshFile
from airl_mav.vehicle.rotation import Vec

BINS: Final = 16
"""Candidate split positions along an axis."""

LEAF: Final = 4
"""Maximum number of triangles in a leaf."""

DEEPEST: Final = 32
"""Level below which nodes are split in halves; the depth is at most twice this value."""

SPARE_M: Final = 1e-6
"""Margin by which a node's box exceeds its triangles, on each side [m]."""

STACK: Final = 2 * DEEPEST
"""Maximum number of pending nodes during a traversal."""


class Bvh(NamedTuple):
    """Concatenated trees over the triangles of meshes; a tuple, because kernels require one."""

    boxes: NDArray[np.float32]  # (k, 6) centre and half size of each node along the axes [m]
    links: NDArray[np.int32]
    """(k, 2) inner node: right child, 0; leaf: first triangle, number of triangles."""
    corners: NDArray[np.float32]  # (m, 9) three corners of each triangle, in the leaves' order [m]
    normals: NDArray[np.float32]  # (m, 3) unit vectors, to either side


def build_bvh(triangles: Triangles) -> Bvh:
    """Return the tree over triangles of non-zero area; deterministic."""
    corners = triangles.corners.astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    # Triangles of zero area have no normal and no hit.
    keep = area > 0.0
    corners, normals = corners[keep], across[keep] / area[keep, None]
    low, high = corners.min(axis=1), corners.max(axis=1)
    m = len(corners)
    order = np.arange(m, dtype=np.int32)
    # A binary tree with at most m leaves has at most 2 m - 1 nodes.
    room = max(2 * m - 1, 1)
    bounds, links = np.zeros((room, 6)), np.zeros((room, 2), np.int32)
    count = _build(low, high, order, bounds, links)
    bounds, links = bounds[:count], links[:count].copy()
    centre = (0.5 * (bounds[:, :3] + bounds[:, 3:])).astype(np.float32)
    reach = np.maximum(bounds[:, 3:] - centre, centre - bounds[:, :3])
    # The margin and the next float32 up keep every triangle inside its box despite rounding.
    half = np.nextafter((reach + SPARE_M).astype(np.float32), np.float32(np.inf))
    return Bvh(
        np.concatenate([centre, half], axis=1),
        links,
        corners[order].reshape(m, 9).astype(np.float32),
        normals[order].astype(np.float32),
    )


@large_kernel
def _build(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    order: NDArray[np.int32],
    bounds: NDArray[np.float64],
    links: NDArray[np.int32],
) -> int:
    """Write the tree over m boxes, `low` and `high` (m, 3); return its number of nodes.

    `order` (m,) contains the boxes' indices and is sorted by leaf. The outputs are `bounds` (2 m -
    1, 6), the lowest and highest corner of each node, and `links` (2 m - 1, 2), as in `Bvh`.
    """
    waiting = np.empty((STACK + 1, 4), np.int64)  # begin, end, parent of a right child, level
    waiting[0] = (0, len(order), -1, 0)
    tops, count = 1, 0
    from_low, from_high = np.empty(3), np.empty(3)  # of twice the centres
    while tops > 0:
        tops -= 1
        begin, end, parent, level = waiting[tops]
        node = count
        count += 1
        # A right child gets its index only when it is popped.
        if parent >= 0:
            links[parent, 0] = node
        bounds[node, :3], bounds[node, 3:] = math.inf, -math.inf
        from_low[:], from_high[:] = math.inf, -math.inf
        for k in range(begin, end):
            i = order[k]
            for axis in range(3):
                a, b = low[i, axis], high[i, axis]
                bounds[node, axis] = min(bounds[node, axis], a)
                bounds[node, 3 + axis] = max(bounds[node, 3 + axis], b)
                from_low[axis] = min(from_low[axis], a + b)
                from_high[axis] = max(from_high[axis], a + b)
        if end - begin <= LEAF:
            links[node, 0], links[node, 1] = begin, end - begin
            continue
        axis, place = -1, 0
        if level < DEEPEST:
            axis, place = _best_split(low, high, order, begin, end, from_low, from_high)
        # Without a useful split, halves bound the depth of the tree.
        middle = (begin + end) // 2
        if axis >= 0:
            # Partition `order` in place: boxes of bins up to `place` go left.
            per = BINS / (from_high[axis] - from_low[axis])
            first, last = begin, end - 1
            while first <= last:
                i = order[first]
                # The same expression as in `_best_split`, so that a box falls into the same bin.
                at = min(int((low[i, axis] + high[i, axis] - from_low[axis]) * per), BINS - 1)
                if at <= place:
                    first += 1
                else:
                    order[first], order[last] = order[last], i
                    last -= 1
            middle = first
        waiting[tops] = (middle, end, node, level + 1)
        # Pushed last, the left child is popped first and becomes node + 1, as `Bvh` assumes.
        waiting[tops + 1] = (begin, middle, -1, level + 1)
        tops += 2
    return count


@large_kernel
def _best_split(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    order: NDArray[np.int32],
    begin: int,
    end: int,
    from_low: NDArray[np.float64],
    from_high: NDArray[np.float64],
) -> tuple[int, int]:
    """Return axis and last left bin of the cheapest split of boxes begin..end; -1 = none.

    `from_low` and `from_high` (3,) are twice the extremes of their centres.
    """
    filled = np.empty(BINS, np.int64)
    bin_low, bin_high = np.empty((BINS, 3)), np.empty((BINS, 3))
    right_area = np.empty(BINS)
    side_low, side_high = np.empty(3), np.empty(3)
    best, best_axis, best_bin = math.inf, -1, 0
    for axis in range(3):
        extent = from_high[axis] - from_low[axis]
        if not extent > 0.0:
            continue
        per = BINS / extent
        filled[:] = 0
        bin_low[:, :], bin_high[:, :] = math.inf, -math.inf
        for k in range(begin, end):
            i = order[k]
            at = min(int((low[i, axis] + high[i, axis] - from_low[axis]) * per), BINS - 1)
            filled[at] += 1
            for each in range(3):
                bin_low[at, each] = min(bin_low[at, each], low[i, each])
                bin_high[at, each] = max(bin_high[at, each], high[i, each])
        # Sweep from the right: cost of the boxes in bin `at` and above.
        side_low[:], side_high[:] = math.inf, -math.inf
        number = 0
        for at in range(BINS - 1, 0, -1):
            number += filled[at]
            right_area[at] = number * _grown_area(side_low, side_high, bin_low, bin_high, at)
        # Sweep from the left. The cost of a side is its number of boxes times its surface area.
        side_low[:], side_high[:] = math.inf, -math.inf
        number = 0
        for at in range(BINS - 1):
            number += filled[at]
            cost = number * _grown_area(side_low, side_high, bin_low, bin_high, at)
            cost += right_area[at + 1]
            # An empty side would split nothing.
            if number > 0 and number < end - begin and cost < best:
                best, best_axis, best_bin = cost, axis, at
    return best_axis, best_bin


@large_kernel
def _grown_area(
    side_low: NDArray[np.float64],
    side_high: NDArray[np.float64],
    bin_low: NDArray[np.float64],
    bin_high: NDArray[np.float64],
    at: int,
) -> float:
    """Extend a side by a bin; return half the surface area of its box, 0 if the side is empty."""
    for each in range(3):
        side_low[each] = min(side_low[each], bin_low[at, each])
        side_high[each] = max(side_high[each], bin_high[at, each])
    a, b, c = side_high[0] - side_low[0], side_high[1] - side_low[1], side_high[2] - side_low[2]
    return a * b + b * c + c * a if a >= 0.0 else 0.0


@lru_cache(maxsize=KEPT)
def bvh_of(file: MeshFile) -> Bvh:
    """Return the tree of a file's triangles. Raises UsageError as `triangles_of`."""
    return build_bvh(triangles_of(file))


@lru_cache(maxsize=KEPT)
def ground_tree(ground: Ground) -> Bvh:
    """Return the tree of the ground's triangles along east, south and down (`GROUND_POSE`).

    The floor's pattern starts along these axes and continues on hills (`surfaces.shade_floor`).
    """
    corners = ground.points[:, [1, 0, 2]] * (1.0, -1.0, 1.0)
    return build_bvh(Triangles(corners.astype(np.float32), ground.faces))


class Forest(NamedTuple):
    """Trees of several meshes, and the root of each; the key None is the ground."""

    bvh: Bvh
    roots: dict[MeshFile | None, int]


NO_TREES: Final = Forest(
    Bvh(
        np.zeros((0, 6), np.float32),
        np.zeros((0, 2), np.int32),
        np.zeros((0, 9), np.float32),
        np.zeros((0, 3), np.float32),
    ),
    {},
)


@lru_cache(maxsize=4)
def forest_of(files: tuple[MeshFile, ...], ground: Ground | None = None) -> Forest:
    """Return the joint trees of meshes and ground. Raises as `triangles_of`."""
    names: list[MeshFile | None] = [*files]
    trees = [bvh_of(file) for file in files]
    if ground is not None:
        names.append(None)
        trees.append(ground_tree(ground))
    if not trees:
        return NO_TREES
    if len(trees) == 1:
        return Forest(trees[0], {names[0]: 0})
    nodes = np.cumsum([0, *(len(tree.boxes) for tree in trees)])
    faces = np.cumsum([0, *(len(tree.corners) for tree in trees)])
    links = []
    for tree, node, face in zip(trees, nodes, faces, strict=False):
        moved = tree.links.copy()
        # A leaf's link points into the triangles, an inner node's link to a node.
        moved[:, 0] += np.where(moved[:, 1] > 0, face, node).astype(np.int32)
        links.append(moved)
    bvh = Bvh(
        np.concatenate([tree.boxes for tree in trees]),
        np.concatenate(links),
        np.concatenate([tree.corners for tree in trees]),
        np.concatenate([tree.normals for tree in trees]),
    )
    return Forest(bvh, dict(zip(names, nodes.tolist(), strict=False)))


GROUND_FIRST: Final = GROUND - OBSTACLE

GROUND_POSE: Final = (0.0, 0.0, 0.0, 1.0, 1.0, 0.0)
"""`Meshes.pose` of the ground: its first axis is east."""


UNSEEN: Final = 1 << 30
"""`Meshes.owner` of an obstacle that depth rays pass through; it is invisible."""


class Meshes(NamedTuple):
    """The k placed meshes of an arena for kernels; hills come last and have no obstacle."""

    bvh: Bvh
    owner: NDArray[np.int32]
    """(n,) index of the mesh that contains each obstacle; -1 = no mesh; UNSEEN."""
    first: NDArray[np.int32]  # (k,) obstacle with the mesh's number and material; GROUND_FIRST
    root: NDArray[np.int32]  # (k,) root of its tree
    pose: NDArray[np.float64]
    """(k, 6) north, east [m], cosine and sine of its heading, scale, down [m]."""
    relief: Relief


@borrowing_kernel
def count_of(meshes: Meshes | None) -> int:
    """Return the number of meshes."""
    return 0 if meshes is None else len(meshes.first)


@borrowing_kernel
def raised(meshes: Meshes | None, position: Vec | NDArray[np.float64]) -> Vec:
    """Return a camera's position NED [m], raised to `MIN_DEPTH_M` above the ground."""
    lowest = -MIN_DEPTH_M
    if meshes is not None:
        lowest -= plane_at(meshes.relief, position[0], position[1])[0]
    # Down is positive, so the minimum is the higher position.
    return (position[0], position[1], min(position[2], lowest))


@borrowing_kernel
def is_owned(meshes: Meshes | None, i: int) -> bool:
    """Return True if cameras see a mesh, or nothing, in place of obstacle i."""
    return False if meshes is None else meshes.owner[i] >= 0


def meshes_of(
    placed: tuple[PlacedMesh, ...],
    n_obstacles: int,
    ground: Ground | None = None,
    clear: NDArray[np.bool_] | None = None,
) -> Meshes | None:
    """Return an arena's meshes, hills included; None without meshes, hills and glass.

    Depth rays pass through the obstacles `clear` (n,), see `Arena.clear`; None = through none of
    them, as for colour. Raises UsageError if a file is missing or has changed.
    """
    if not placed and ground is None and clear is None:
        return None
    # Meshes of the same file share one tree.
    forest = forest_of(tuple(dict.fromkeys(each.file for each in placed)), ground)
    rows = placed_in(forest.roots, placed, n_obstacles, clear)
    return Meshes(forest.bvh, *rows, no_relief() if ground is None else ground.relief)


def placed_in(
    roots: dict[MeshFile | None, int],
    placed: tuple[PlacedMesh, ...],
    n_obstacles: int,
    clear: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    """Return `owner`, `first`, `root` and `pose` of `Meshes`, with hills if `roots` has them."""
    owner = np.full(n_obstacles, -1, np.int32)
    if clear is not None:
        owner[clear] = UNSEEN
    for k, each in enumerate(placed):
        owner[each.first : each.first + each.count] = k
    first = [each.first for each in placed]
    root = [roots[each.file] for each in placed]
    pose = [
        (*each.place, math.cos(each.yaw), math.sin(each.yaw), each.scale, -each.base_m)
        for each in placed
    ]
    if None in roots:
        first, root, pose = [*first, GROUND_FIRST], [*root, roots[None]], [*pose, GROUND_POSE]
    return owner, np.array(first, np.int32), np.array(root, np.int32), np.array(pose).reshape(-1, 6)
