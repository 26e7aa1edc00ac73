"""`airl asset`: build an arena from your own mesh."""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tomli_w
from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL
from airl_mav.core import errors, fields, progress
from airl_mav.core.files import replace_file
from airl_mav.profiles.arena import ASSET_NAME, SHAPES, ArenaSpec
from airl_mav.profiles.assets import MOST_PARTS, MOST_TRIANGLES, MeshFile
from airl_mav.profiles.loading import load_profile
from airl_mav.scenario.model import DEFAULT_ARENA, ArenaName

if TYPE_CHECKING:
    from airl_mav.addons.meshes.mesh_boxes import MeshBoxes

EXTRAS = ("mesh",)


class AssetOptions(fields.ProfileModel):
    """Make an arena profile whose obstacles are a mesh, and boxes that cover the mesh.

    Cameras see the mesh; plants and planners use the boxes. The mesh is divided into cells as fine
    as the number of boxes allows. The command prints how far the boxes extend beyond the mesh. The
    triangles are written to an .npz file with the profile's name.

    Examples:
        airl asset pillar.stl --out pillars.toml
        airl asset shelf.glb --most 64 --arena dense-obstacles --out shelves.toml
        airl asset scan.ply --seen boxes --out scans.toml
        airl render pillars.toml --seed 3 --out pillars.png
    """

    mesh: Annotated[Path, POSITIONAL] = Field(
        description="the mesh: .stl, .obj, .glb, .gltf, .ply or .off"
    )
    out: Path = Field(description="arena profile to write (.toml)")
    name: str | None = Field(
        default=None, description="name of the asset; by default that of the file"
    )
    arena: ArenaName = Field(
        default=DEFAULT_ARENA, description="arena profile whose obstacles become the mesh"
    )
    most: int = fields.quantity("greatest number of boxes", "1", ge=1, le=MOST_PARTS, default=64)
    scale: float = fields.quantity("metres per unit of the file", "m", gt=0, le=1e6, default=1.0)
    up: Literal["auto", "y", "z"] = Field(
        default="auto", description="axis of the file that points up; auto: y for .glb, else z"
    )
    seen: Literal["mesh", "boxes"] = Field(
        default="mesh",
        description=f"what cameras see: the mesh, of at most {MOST_TRIANGLES:,} triangles, or the"
        " boxes",
    )


OPTIONS = AssetOptions
READS_FILES = True


def run(options: AssetOptions, console: Console | None = None) -> int:
    """Write the asset's profile; return 0."""
    # Imported here: trimesh is an extra.
    from airl_mav.addons.meshes.mesh_boxes import boxes_of_mesh

    console = console or progress.new_console()
    if options.out.suffix.lower() != ".toml":
        raise errors.FieldError("out", f"{options.out}", "a file name that ends in .toml")
    name = _name(options)
    made = boxes_of_mesh(options.mesh, most=options.most, scale=options.scale, up=options.up)
    surface = options.out.with_suffix(".npz") if options.seen == "mesh" else None
    files = _files(options, name, made, surface)
    with tempfile.TemporaryDirectory() as folder:
        for path, data in files.items():
            (Path(folder) / path.name).write_bytes(data)
        # Validate before writing the files.
        load_profile("arenas", str(Path(folder) / options.out.name), ArenaSpec)
    with errors.usage_errors(f"--out {options.out}: cannot write"):
        for path, data in files.items():
            replace_file(path, data)
    seen = "the boxes" if surface is None else f"its {len(made.surface):,} triangles"
    console.print(
        f"{name}: {_told(made)}; cameras see {seen}",
        f"written: {' and '.join(str(path) for path in files)}",
        sep="\n",
        soft_wrap=True,
        highlight=False,
    )
    return 0


def _name(options: AssetOptions) -> str:
    name = options.name or options.mesh.stem.lower().replace("_", "-").replace(" ", "-")
    if name in SHAPES or ASSET_NAME.fullmatch(name) is None:
        raise errors.FieldError(
            "name", name, "small letters, with dashes between words, and no name of a shape"
        )
    return name


def _told(made: MeshBoxes) -> str:
    """Return a description of the boxes of a mesh."""
    forward, right, height = made.size_m
    inside = "closed, filled" if made.closed else "not closed: its surface alone"
    return (
        f"{len(made.asset.parts)} boxes for {forward:.3g} x {right:.3g} x {height:.3g} m (forward,"
        f" right, up; {inside}), which cover all of it and reach at most {made.beyond_m:.3g} m"
        f" beyond (cells of {made.cell_m:.3g} m)"
    )


def _files(
    options: AssetOptions, name: str, made: MeshBoxes, surface: Path | None
) -> dict[Path, bytes]:
    """Return file contents, the triangles before the profile; FieldError for too many triangles."""
    from airl_mav.arena.triangles import encoded

    if surface is None:
        return {options.out: _profile(options, name, made, None).encode()}
    if len(made.surface) > MOST_TRIANGLES:
        raise errors.FieldError(
            "mesh",
            f"{options.mesh}",
            f"at most {MOST_TRIANGLES:,} triangles, not {len(made.surface):,}, unless cameras shall"
            " see its boxes (--seen boxes)",
        )
    data = encoded(made.surface)
    held = MeshFile(file=surface.name, sha256=hashlib.sha256(data).hexdigest())
    return {surface: data, options.out: _profile(options, name, made, held).encode()}


def _profile(options: AssetOptions, name: str, made: MeshBoxes, held: MeshFile | None) -> str:
    arena = options.arena
    base = str(Path(arena).absolute()) if arena.endswith(".toml") else arena
    asset: dict[str, Any] = {} if held is None else {"mesh": held.model_dump()}
    asset["parts"] = [
        part.model_dump(exclude_defaults=True) | {"shape": part.shape} for part in made.asset.parts
    ]
    data = {
        "base": base,
        "description": f"{name}, from {options.mesh.name}",
        "static": {"shapes": [name]},
        "assets": {name: asset},
    }
    return f"# airl asset {options.mesh.name}: {_told(made)}\n" + tomli_w.dumps(data)
