"""Colour images of n vehicles in one compiled call, and the appearance of their arenas."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.colour.appearance import OBSTACLE
from airl_mav.addons.colour.picture import ColourArrays, Work, render_colour, write_grey
from airl_mav.addons.colour.profile import ImageFile
from airl_mav.addons.colour.shading import MATT, Gloss
from airl_mav.addons.colour.textures import atlas
from airl_mav.arena.geometry import Arena
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import LensConstants, lens_of
from airl_mav.camera.render import RANGE_M, Mount, camera_pose
from airl_mav.core.errors import UsageError
from airl_mav.core.kernels import kernel
from airl_mav.envs.arena_batch import ArenaBatch, copy_rows, move_obstacles, relief_of
from airl_mav.envs.cameras import scene_in
from airl_mav.envs.fleet import Fleet, FramePoses
from airl_mav.envs.mesh_batch import MeshBatch, MeshesSeen, meshes_in


class LookBatch(NamedTuple):
    """Appearance of n arenas for `render_colour`, padded to the maximum number of surfaces."""

    texture: NDArray[np.int8]  # (n, m)
    per_m: NDArray[np.float32]  # (n, m)
    offset: NDArray[np.float32]  # (n, m, 2)
    albedo: NDArray[np.float32]  # (n, m, 2, 3)
    lights: NDArray[np.float32]  # (n, 7, 3)


class GlossBatch(NamedTuple):
    """Properties of non-matt surfaces in n arenas, padded; see `camera.gloss.Gloss`."""

    surface: NDArray[np.int8]  # (n, m)
    alpha: NDArray[np.float32]  # (n, m)
    lets: NDArray[np.float32]  # (n, m)


def _all_matt(n: int, surfaces: int) -> GlossBatch:
    shape = (n, surfaces)
    return GlossBatch(
        np.full(shape, MATT, np.int8), np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    )


def _empty(n: int, surfaces: int) -> LookBatch:
    return LookBatch(
        np.zeros((n, surfaces), np.int8),
        np.zeros((n, surfaces), np.float32),
        np.zeros((n, surfaces, 2), np.float32),
        np.zeros((n, surfaces, 2, 3), np.float32),
        np.zeros((n, 7, 3), np.float32),
    )


class Looks:
    """Appearance of the arenas of n slots."""

    def __init__(self, n: int) -> None:
        """Start without any arena."""
        self.arenas: dict[int, Arena] = {}
        """Arenas by slot."""
        self.batch = _empty(n, OBSTACLE)
        """Appearance for the kernel; replaced when an arena exceeds its number of surfaces."""
        self.gloss: GlossBatch | None = None
        """Surface properties as in `batch`; None while all surfaces are matt, at no cost."""
        self.images: tuple[ImageFile, ...] = ()
        """Image textures of all arenas."""

    def put(self, i: int, arena: Arena) -> None:
        """Add the appearance of slot i's arena.

        Raises UsageError if its images differ from the images of previous arenas.
        """
        if images := arena.look.finish.images:
            # One atlas of textures serves all arenas in a call.
            if self.images not in ((), images):
                raise UsageError(
                    f"arena {arena.name!r}, seed {arena.seed}: appearance.materials: accepted: the"
                    " same images in all arenas that are flown in side by side"
                )
            self.images = images
        self.arenas[i] = arena
        look = ColourArrays.of(arena.look)
        room, count = self.batch.texture.shape[1], len(look.texture)
        if count > room:
            larger = _empty(len(self.batch.texture), count)
            copy_rows(self.batch, larger)
            self.batch = larger
            if self.gloss is not None:
                roomy = _all_matt(len(self.batch.texture), count)
                copy_rows(self.gloss, roomy)
                self.gloss = roomy
        batch = self.batch
        batch.lights[i] = look.lights
        for name in ("texture", "per_m", "offset", "albedo"):
            getattr(batch, name)[i, :count] = getattr(look, name)
        if self.gloss is None and look.gloss is not None:
            self.gloss = _all_matt(*batch.texture.shape)
        # Rows of an earlier arena in this slot must not remain.
        if self.gloss is not None:
            self.gloss.surface[i] = MATT
            self.gloss.lets[i] = 0.0
        if self.gloss is not None and look.gloss is not None:
            for name, rows in look.gloss._asdict().items():
                getattr(self.gloss, name)[i, :count] = rows


class ImageBuffers(NamedTuple):
    """Work buffers for an image (h, w, ...)."""

    work: Work
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    seen: NDArray[np.int32]


class ColourImages:
    """Renderer for n vehicles with one colour camera each."""

    def __init__(
        self, intrinsics: Intrinsics, mount: Mount, looks: Looks, meshes: MeshesSeen
    ) -> None:
        """Store camera, mounting, arena appearance and meshes."""
        k, shape = intrinsics, (intrinsics.height, intrinsics.width)
        self._lens = lens_of(k, RANGE_M)
        self._mount, self._looks, self._meshes = mount, looks, meshes
        rgb = np.zeros((*shape, 3), np.uint8)
        depth, seen = np.zeros(shape, np.float32), np.zeros(shape, np.int32)
        work = Work.of(k)
        self._canvas = ImageBuffers(work, rgb, depth, seen)

    def render(
        self,
        fleet: Fleet | FramePoses,
        arenas: ArenaBatch,
        who: NDArray[np.bool_],
        out: NDArray[Any],
    ) -> None:
        """Write the images (n, h, w, 3), or (n, h, w, 1) in grey, of the vehicles in `who` (n,)."""
        looks, meshes = self._looks, self._meshes.batch
        camera = (self._mount, self._lens, self._canvas, atlas(looks.images))
        _render(fleet, arenas, looks.batch, looks.gloss, meshes, who, *camera, out)


@kernel
def _gloss_in(gloss: GlossBatch | None, i: int, surfaces: int) -> Gloss | None:
    """Return the surface properties of arena i."""
    if gloss is None:
        return None
    return Gloss(gloss.surface[i, :surfaces], gloss.alpha[i, :surfaces], gloss.lets[i, :surfaces])


@kernel
def _render(
    fleet: Fleet | FramePoses,
    arenas: ArenaBatch,
    looks: LookBatch,
    gloss: GlossBatch | None,
    meshes: MeshBatch | None,
    who: NDArray[np.bool_],
    mount: Mount,
    lens: LensConstants,
    canvas: ImageBuffers,
    patterns: NDArray[np.float32],
    out: NDArray[np.uint8],
) -> None:
    """Render the colour image of every vehicle in `who` at its present pose.

    Moving obstacles are moved to its time. `out` (n, h, w, channels) is written: sRGB, or grey for
    one channel.
    """
    grey, rgb = out.shape[3] == 1, canvas.rgb
    for i in range(len(who)):
        if not who[i]:
            continue
        move_obstacles(arenas, i, fleet.time_us[i])
        count = arenas.n_obstacles[i]
        surfaces = OBSTACLE + count
        position, quaternion = camera_pose(fleet.position[i], fleet.quaternion[i], mount)
        colours = ColourArrays(
            looks.texture[i, :surfaces],
            looks.per_m[i, :surfaces],
            looks.offset[i, :surfaces],
            looks.albedo[i, :surfaces],
            _gloss_in(gloss, i, surfaces),
            looks.lights[i],
        )
        render_colour(
            # Grey is computed from a buffer; RGB is rendered into the output.
            rgb if grey else out[i],
            canvas.depth,
            canvas.seen,
            canvas.work,
            position,
            quaternion,
            lens,
            scene_in(arenas, i),
            meshes_in(meshes, i, count, relief_of(arenas, i)),
            colours,
            patterns,
        )
        if grey:
            pixels = rgb.shape[0] * rgb.shape[1]
            write_grey(out[i].reshape(pixels), rgb.reshape(pixels, 3))
