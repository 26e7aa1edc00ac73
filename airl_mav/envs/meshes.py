"""The meshes of n arenas as arrays, hills among them: what the cameras of the batch twin see.

The trees of files are there once, whichever arenas they stand in. Each arena has ground of its own:
behind the trees of files there is room for that of every arena.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.arena.ground import Relief
from airl_mav.camera.bvh import UNSEEN, Bvh, Forest, Meshes, forest_of, ground_tree, placed_in
from airl_mav.core.kernels import kernel
from airl_mav.profiles.asset_files import MeshFile


class MeshBatch(NamedTuple):
    """The meshes of n arenas, padded to the most obstacles and meshes; see `camera.bvh.Meshes`."""

    bvh: Bvh
    present: NDArray[np.int64]  # (n,) number of meshes of each arena
    owner: NDArray[np.int32]  # (n, obstacles)
    first: NDArray[np.int32]  # (n, meshes)
    root: NDArray[np.int32]  # (n, meshes)
    pose: NDArray[np.float64]  # (n, meshes, 6)


@kernel
def meshes_in(batch: MeshBatch | None, i: int, obstacles: int, relief: Relief) -> Meshes | None:
    """Return the meshes of arena i, which has so many obstacles, and such ground; None: none."""
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
    """The meshes of the arenas of n slots."""

    def __init__(self, n: int) -> None:
        """Know none yet."""
        self.batch: MeshBatch | None = None
        """What colour cameras look at; None: no arena has had a mesh, and nothing is spent on any.
        """
        self.by_depth: MeshBatch | None = None
        """What depth passes by and ends on: `batch`, without what is of glass; None as there."""
        self._arenas: list[Arena | None] = [None] * n
        self._files: dict[MeshFile, None] = {}
        """All that have been seen, in order."""
        self._glass = False
        """Whether any arena has had an obstacle of glass."""
        self._bare: MeshBatch | None = None
        """What there is in place of `batch` where there is glass, and no mesh."""
        self._room = (0, 0)
        """Nodes and triangles that there is room for in the tree of each arena's ground."""

    def put(self, i: int, arena: Arena) -> None:
        """Take the meshes of slot i's arena.

        Raises:
            UsageError: The file of one cannot be read, or is another one.
        """
        self._arenas[i] = arena
        before = len(self._files)
        self._files.update(dict.fromkeys(each.file for each in arena.meshes))
        forest = forest_of(tuple(self._files))
        if self._files or arena.ground is not None or self.batch is not None:
            batch = self.batch
            if batch is None or len(self._files) > before or not self._fits(batch, arena):
                self.batch = batch = self._made(forest)
            self._put(batch, forest, i, arena)
        self._leave_glass_out(i, arena)

    def _leave_glass_out(self, i: int, arena: Arena) -> None:
        """Bring `by_depth` up to date with slot i's arena, and with `batch`."""
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
                depth.owner[k, : len(each.obstacles)][each.clear] = UNSEEN

    def _fits(self, batch: MeshBatch, arena: Arena) -> bool:
        """Return whether an arena has room in a batch."""
        room = batch.owner.shape[1], batch.first.shape[1], *self._room
        need = len(arena.obstacles), _meshes_of(arena), *_room_of(arena)
        return all(each <= most for each, most in zip(need, room, strict=True))

    def _made(self, forest: Forest) -> MeshBatch:
        """Return a batch in which all present arenas have room, with their meshes."""
        present = [arena for arena in self._arenas if arena is not None]
        n = len(self._arenas)
        obstacles = max(len(arena.obstacles) for arena in present)
        meshes = max(_meshes_of(arena) for arena in present)
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
        """Write the meshes of slot i's arena, which fits."""
        n, k = len(arena.obstacles), _meshes_of(arena)
        batch.present[i] = k
        roots = forest.roots
        if arena.ground is not None:
            nodes, faces = self._room
            node, face = len(forest.bvh.boxes) + i * nodes, len(forest.bvh.corners) + i * faces
            _plant(batch.bvh, ground_tree(arena.ground), node, face)
            roots = {**roots, None: node}
        rows = placed_in(roots, arena.meshes, n)
        batch.owner[i, :n], batch.first[i, :k], batch.root[i, :k], batch.pose[i, :k] = rows


def _meshes_of(arena: Arena) -> int:
    """Return how many meshes an arena has; its hills are one."""
    return len(arena.meshes) + (arena.ground is not None)


def _room_of(arena: Arena) -> tuple[int, int]:
    """Return how many nodes and triangles the tree of an arena's ground may have.

    As many as if all of its triangles rose above the floor: other seeds of an arena fit as well.
    """
    if arena.ground is None:
        return 0, 0
    rows, columns = arena.ground.heights.shape
    most = 2 * (rows - 1) * (columns - 1)
    return max(most, len(ground_tree(arena.ground).boxes)), most


def _with_room(bvh: Bvh, n: int, room: tuple[int, int]) -> Bvh:
    """Return trees with room for n more behind them, of so many nodes and triangles each."""
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
    """Write a tree into others, its nodes and triangles from some places on."""
    nodes, faces = slice(node, node + len(tree.boxes)), slice(face, face + len(tree.corners))
    bvh.boxes[nodes], bvh.corners[faces], bvh.normals[faces] = (
        tree.boxes,
        tree.corners,
        tree.normals,
    )
    leaf = tree.links[:, 1] > 0
    bvh.links[nodes] = tree.links
    bvh.links[nodes, 0] += np.where(leaf, face, node).astype(np.int32)
