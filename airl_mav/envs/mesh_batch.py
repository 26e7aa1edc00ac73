"""Meshes of n arenas as arrays, hills included, for the cameras of the vectorized simulator.

Trees of files are stored once, for all arenas. The ground differs between arenas: behind the trees
of files there is space for each arena's ground.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena, Relief
from airl_mav.camera.bvh import UNSEEN, Bvh, Forest, Meshes, forest_of, ground_tree, placed_in
from airl_mav.core.kernels import kernel
from airl_mav.profiles.assets import MeshFile


class MeshBatch(NamedTuple):
    """Meshes of n arenas, padded to the maximum obstacles and meshes; see `camera.bvh.Meshes`."""

    bvh: Bvh
    present: NDArray[np.int64]  # (n,) number of meshes of each arena
    owner: NDArray[np.int32]  # (n, obstacles)
    first: NDArray[np.int32]  # (n, meshes)
    root: NDArray[np.int32]  # (n, meshes)
    pose: NDArray[np.float64]  # (n, meshes, 6)


@kernel
def meshes_in(batch: MeshBatch | None, i: int, obstacles: int, relief: Relief) -> Meshes | None:
    """Return the meshes of arena i, for its number of obstacles and ground; None without any."""
    if batch is None:
        return None
    k = batch.present[i]
    return Meshes(
        batch.bvh,
        batch.owner[i, :obstacles],
        batch.first[i, :k],
        batch.root[i, :k],
        batch.pose[i, :k],
        relief,
    )


class MeshesSeen:
    """Meshes of the arenas of n slots."""

    def __init__(self, n: int) -> None:
        """Start without any arena."""
        self.batch: MeshBatch | None = None
        """Meshes for colour cameras; None until an arena has one, at no cost."""
        self.by_depth: MeshBatch | None = None
        """Meshes for depth cameras: `batch` without glass; None as for `batch`."""
        self._arenas: list[Arena | None] = [None] * n
        self._files: dict[MeshFile, None] = {}
        """Files of all meshes so far, in order."""
        self._glass = False
        """True if any arena so far has an obstacle of glass."""
        self._bare: MeshBatch | None = None
        """Replacement of `batch` for arenas with glass but without meshes."""
        self._room = (0, 0)
        """Capacity for nodes and triangles in the tree of each arena's ground."""

    def put(self, i: int, arena: Arena) -> None:
        """Add the meshes of slot i's arena.

        Raises:
            UsageError: A mesh's file is unreadable, or has changed.
        """
        self._arenas[i] = arena
        before = len(self._files)
        self._files.update(dict.fromkeys(each.file for each in arena.meshes))
        forest = forest_of(tuple(self._files))
        if self._files or arena.ground is not None or self.batch is not None:
            batch = self.batch
            # A new file, or an arena that is too large, rebuilds the trees.
            if batch is None or len(self._files) > before or not self._fits(batch, arena):
                self.batch = batch = self._made(forest)
            self._put(batch, forest, i, arena)
        self._leave_glass_out(i, arena)

    def _leave_glass_out(self, i: int, arena: Arena) -> None:
        """Update `by_depth` for slot i's arena, and for `batch`."""
        # Without glass both batches are the same object.
        if not self._glass and arena.clear is None:
            self.by_depth = self.batch
            return
        self._glass = True
        present = [i]
        shown, depth = self.batch, self.by_depth
        if shown is None:
            shown = self._bare = self._bare or self._made(forest_of(()))
        if (
            depth is None
            or depth.bvh is not shown.bvh
            or depth.owner.shape[1] < len(arena.obstacles)
        ):
            # New trees, or more obstacles, invalidate all rows.
            present = [k for k, each in enumerate(self._arenas) if each is not None]
            most = max(len(each.obstacles) for each in self._arenas if each is not None)
            room = len(self._arenas), max(most, shown.owner.shape[1])
            self.by_depth = depth = shown._replace(owner=np.full(room, -1, np.int32))
        width = shown.owner.shape[1]
        for k in present:
            depth.owner[k] = -1
            depth.owner[k, :width] = shown.owner[k]
            each = self._arenas[k]
            if each is not None and each.clear is not None:
                # Depth rays pass through glass.
                depth.owner[k, : len(each.obstacles)][each.clear] = UNSEEN

    def _fits(self, batch: MeshBatch, arena: Arena) -> bool:
        """Return True if an arena fits into a batch."""
        room = batch.owner.shape[1], batch.first.shape[1], *self._room
        need = len(arena.obstacles), _meshes_of(arena), *_room_of(arena)
        return all(each <= most for each, most in zip(need, room, strict=True))

    def _made(self, forest: Forest) -> MeshBatch:
        """Return a batch that fits all present arenas, with their meshes."""
        present = [arena for arena in self._arenas if arena is not None]
        n = len(self._arenas)
        obstacles = max(len(arena.obstacles) for arena in present)
        meshes = max(_meshes_of(arena) for arena in present)
        # Space only grows, so that a return to an earlier arena does not rebuild.
        rooms = [self._room, *map(_room_of, present)]
        self._room = max(nodes for nodes, _ in rooms), max(faces for _, faces in rooms)
        batch = MeshBatch(
            _with_room(forest.bvh, n, self._room),
            np.zeros(n, np.int64),
            np.full((n, obstacles), -1, np.int32),
            np.zeros((n, meshes), np.int32),
            np.zeros((n, meshes), np.int32),
            np.zeros((n, meshes, 6)),
        )
        for i, arena in enumerate(self._arenas):
            if arena is not None:
                self._put(batch, forest, i, arena)
        return batch

    def _put(self, batch: MeshBatch, forest: Forest, i: int, arena: Arena) -> None:
        """Write the meshes of slot i's arena, which must fit."""
        n, k = len(arena.obstacles), _meshes_of(arena)
        batch.present[i] = k
        roots = forest.roots
        if arena.ground is not None:
            # Each slot has a fixed space behind the trees of the files.
            nodes, faces = self._room
            node, face = len(forest.bvh.boxes) + i * nodes, len(forest.bvh.corners) + i * faces
            _plant(batch.bvh, ground_tree(arena.ground), node, face)
            roots = {**roots, None: node}
        rows = placed_in(roots, arena.meshes, n)
        batch.owner[i, :n], batch.first[i, :k], batch.root[i, :k], batch.pose[i, :k] = rows


def _meshes_of(arena: Arena) -> int:
    """Return the number of meshes of an arena; hills count as one."""
    return len(arena.meshes) + (arena.ground is not None)


def _room_of(arena: Arena) -> tuple[int, int]:
    """Return the maximum numbers of nodes and triangles in the tree of an arena's ground.

    All triangles count as if above the floor, so other seeds of the arena also fit.
    """
    if arena.ground is None:
        return 0, 0
    rows, columns = arena.ground.heights.shape
    most = 2 * (rows - 1) * (columns - 1)
    return max(most, len(ground_tree(arena.ground).boxes)), most


def _with_room(bvh: Bvh, n: int, room: tuple[int, int]) -> Bvh:
    """Return trees with space for n more behind them, `room` = nodes and triangles of each."""
    nodes, faces = room
    if nodes == 0:
        return bvh
    more = (nodes, nodes, faces, faces)
    return Bvh(
        *(
            np.concatenate([each, np.zeros((n * count, each.shape[1]), each.dtype)])
            for each, count in zip(bvh, more, strict=True)
        )
    )


def _plant(bvh: Bvh, tree: Bvh, node: int, face: int) -> None:
    """Write a tree into others, its nodes from `node` and its triangles from `face` on."""
    nodes, faces = slice(node, node + len(tree.boxes)), slice(face, face + len(tree.corners))
    bvh.boxes[nodes], bvh.corners[faces], bvh.normals[faces] = (
        tree.boxes,
        tree.corners,
        tree.normals,
    )
    # A leaf's link points to a triangle, an inner node's to a node.
    leaf = tree.links[:, 1] > 0
    bvh.links[nodes] = tree.links
    bvh.links[nodes, 0] += np.where(leaf, face, node).astype(np.int32)
