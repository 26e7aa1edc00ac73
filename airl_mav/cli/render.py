"""`airl render`: a still of an arena as a colour camera sees it."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field
from rich.console import Console

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.picture import antialiased, grey, render_picture
from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.core.files import replace_file
from airl_mav.core.frames import quat_from_euler
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.projection import Projection, check_fov
from airl_mav.report.depth_colours import coloured
from airl_mav.report.segmentation_colours import coloured_segmentation
from airl_mav.scenario.model import DEFAULT_ARENA, GREATEST_SEED, ArenaName

Shown = Literal["rgb", "grey", "depth", "segmentation"]

SAMPLES = {"raycast": 16, "mitsuba": 64}


class RenderOptions(ProfileModel):
    """Render an arena from a pose, by the ray caster of the cameras or by Mitsuba's path tracer.

    Without a pose the camera is where the vehicle begins to fly, and looks north.

    Examples:
        airl render static-obstacles --seed 7
        airl render forest.toml --north-m 10 --height-m 3 --yaw-deg 30 --out forest.png
        airl render dense-obstacles --show segmentation --out seen.png
        airl render dense-obstacles --renderer mitsuba --samples 256
    """

    arena: Annotated[ArenaName, POSITIONAL] = DEFAULT_ARENA
    seed: int | None = quantity(
        "seed of the arena; by default the profile's", "1", ge=0, le=GREATEST_SEED, default=None
    )
    show: Shown = Field(
        default="rgb", description="colour, its luma, depth (near is bright), or what is seen"
    )
    renderer: Literal["raycast", "mitsuba"] = Field(
        default="raycast", description="what draws; mitsuba draws rgb alone, without fog"
    )
    samples: int | None = quantity(
        "rays or paths a pixel; by default 16 of raycast, 64 of mitsuba; a camera has one",
        "1",
        ge=1,
        le=4096,
        default=None,
    )
    out: Path = Field(default=Path("render.png"), description="the .png file to write")
    north_m: float = quantity(
        "of the camera: distance north of the start", "m", ge=-1000, le=1000, default=0.0
    )
    east_m: float = quantity(
        "of the camera: distance east of the start", "m", ge=-1000, le=1000, default=0.0
    )
    height_m: float | None = quantity(
        "of the camera: height above the floor; by default the arena's flight altitude",
        "m",
        ge=0,
        le=1000,
        default=None,
    )
    yaw_deg: float = quantity(
        "heading of the camera, clockwise from north", "deg", ge=-360, le=360, default=0.0
    )
    pitch_up_deg: float = quantity("how far the camera looks up", "deg", ge=-90, le=90, default=0.0)
    projection: Projection = Field(default="pinhole", description="of the camera")
    width_px: int = quantity("width of the picture", "px", ge=8, le=4096, default=960)
    height_px: int = quantity("height of the picture", "px", ge=6, le=4096, default=640)
    fov_deg: float = quantity(
        "horizontal field of view, less than 170 with a pinhole", "deg", gt=10, le=360, default=90.0
    )
    range_m: float = quantity(
        "depth at which --show depth is darkest", "m", gt=0.5, le=65, default=20.0
    )
    time_s: float = quantity(
        "where the moving obstacles are: time after the start", "s", ge=0, le=1e6, default=0.0
    )
    vehicle_width_m: float = quantity(
        "width of the vehicle that the arena is made for", "m", gt=0, le=100, default=0.55
    )


OPTIONS = RenderOptions


def run(options: RenderOptions, console: Console | None = None) -> int:
    """Write the picture. Returns exit status 0.

    Raises:
        UsageError: The arena cannot be made, the renderer cannot draw it, or the picture not be
            written there.
    """
    console = console or Console()
    if options.out.suffix.lower() != ".png":
        raise FieldError("out", f"{options.out}", "a file name that ends in .png")
    check_fov("fov_deg", options.projection, options.fov_deg)
    if options.renderer == "mitsuba":
        check_installed("render")
        if options.show != "rgb":
            raise FieldError("show", options.show, "rgb with --renderer mitsuba")
    spec = load_profile("arenas", options.arena, ArenaSpec)
    arena = generate(
        spec,
        spec.default_seed if options.seed is None else options.seed,
        name=Path(options.arena).stem,
        vehicle_width_m=options.vehicle_width_m,
    )
    height = spec.flight_altitude_m if options.height_m is None else options.height_m
    pixels = _picture(arena, options, np.array([options.north_m, options.east_m, -height]))
    written = io.BytesIO()
    Image.fromarray(pixels).save(written, "PNG")
    try:
        replace_file(options.out, written.getvalue())
    except OSError as error:
        problem = f"cannot write: {error.strerror}"
        raise FieldError("out", f"{options.out}", problem=problem) from None
    console.print(f"picture: {options.out}", soft_wrap=True, highlight=False)
    return 0


def _picture(
    arena: Arena, options: RenderOptions, position: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return the picture, (h, w) or (h, w, 3), from a position (3,) NED [m]."""
    attitude = quat_from_euler(
        0.0, math.radians(options.pitch_up_deg), math.radians(options.yaw_deg)
    )
    camera = Intrinsics.from_fov(
        options.width_px, options.height_px, math.radians(options.fov_deg), options.projection
    )
    pose = (arena, arena.centers_at(round(options.time_s * US_PER_S)), camera, position, attitude)
    samples = options.samples or SAMPLES[options.renderer]
    if options.renderer == "mitsuba":
        # Imported here: what it draws with is an extra.
        from airl_mav.camera.mitsuba import path_traced

        return path_traced(*pose, samples=samples)
    if options.show in ("rgb", "grey"):
        rgb = antialiased(*pose, math.ceil(math.sqrt(samples)))
        return rgb if options.show == "rgb" else grey(rgb)
    picture = render_picture(*pose)
    if options.show == "depth":
        return coloured(depth_to_z16(picture.depth_m), options.range_m)
    return coloured_segmentation(picture.seen)
