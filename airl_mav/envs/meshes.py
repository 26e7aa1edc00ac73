"""The meshes of n arenas as arrays: what the cameras of the batch twin see of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.bvh import Bvh, Forest, Meshes, forest_of, placed_in
from airl_mav.core.kernels import kernel
from airl_mav.profiles.mesh_file import MeshFile


class MeshBatch(NamedTuple):
    """The meshes of n arenas, padded to the most obstacles and meshes; see `camera.bvh.Meshes`."""

    bvh: Bvh
    present: NDArray[np.int64]  # (n,) number of meshes of each arena
    owner: NDArray[np.int32]  # (n, obstacles)
    first: NDArray[np.int32]  # (n, meshes)
    root: NDArray[np.int32]  # (n, meshes)
    pose: NDArray[np.float64]  # (n, meshes, 5)


@kernel
def meshes_in(batch: MeshBatch, i: int, obstacles: int) -> Meshes:
    """Return the meshes of arena i, which has so many obstacles."""
    k = batch.present[i]
    return Meshes(
        batch.bvh,
        batch.owner[i, :obstacles],
        batch.first[i, :k],
        batch.root[i, :k],
        batch.pose[i, :k],
    )


class MeshesSeen:
    """The meshes of the arenas of n slots."""

    def __init__(self, n: int) -> None:
        """Know none yet."""
        self.batch: MeshBatch | None = None
        """What the kernels look at; None: no arena has had a mesh, and nothing is spent on any."""
        self._arenas: list[Arena | None] = [None] * n
        self._files: dict[MeshFile, None] = {}
        """All that have been seen, in order."""

    def put(self, i: int, arena: Arena) -> None:
        """Take the meshes of slot i's arena.

        Raises:
            UsageError: The file of one cannot be read, or is another one.
        """
        self._arenas[i] = arena
        before = len(self._files)
        self._files.update(dict.fromkeys(each.file for each in arena.meshes))
        if not self._files:
            return
        forest = forest_of(tuple(self._files))
        batch = self.batch
        if batch is None or len(self._files) > before or not _fits(batch, arena):
            self.batch = batch = self._made(forest)
        _put(batch, forest, i, arena)

    def restore(self, arenas: Sequence[Arena | None]) -> None:
        """Take the meshes of all slots again; None: no episode has begun there."""
        for i, arena in enumerate(arenas):
            if arena is not None:
                self.put(i, arena)

    def _made(self, forest: Forest) -> MeshBatch:
        """Return a batch in which all present arenas have room, with their meshes."""
        present = [arena for arena in self._arenas if arena is not None]
        n = len(self._arenas)
        obstacles = max(len(arena.obstacles) for arena in present)
        meshes = max(len(arena.meshes) for arena in present)
        batch = MeshBatch(
            forest.bvh,
            np.zeros(n, np.int64),
            np.full((n, obstacles), -1, np.int32),
            np.zeros((n, meshes), np.int32),
            np.zeros((n, meshes), np.int32),
            np.zeros((n, meshes, 5)),
        )
        for i, arena in enumerate(self._arenas):
            if arena is not None:
                _put(batch, forest, i, arena)
        return batch


def _fits(batch: MeshBatch, arena: Arena) -> bool:
    """Return whether an arena has room in a batch."""
    room = batch.owner.shape[1], batch.first.shape[1]
    return bool(len(arena.obstacles) <= room[0] and len(arena.meshes) <= room[1])


def _put(batch: MeshBatch, forest: Forest, i: int, arena: Arena) -> None:
    """Write the meshes of slot i's arena, which fits."""
    n, k = len(arena.obstacles), len(arena.meshes)
    batch.present[i] = k
    rows = placed_in(forest, arena.meshes, n)
    batch.owner[i, :n], batch.first[i, :k], batch.root[i, :k], batch.pose[i, :k] = rows
