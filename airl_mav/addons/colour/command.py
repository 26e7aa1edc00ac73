"""`airl render`: render an arena as a picture, or a recorded flight as a film."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from rich.console import Console

from airl_mav.addons.colour import pictures
from airl_mav.addons.view.replayed_flight import ReplayedRun
from airl_mav.arena.generate import generate
from airl_mav.black_box.messages import SUFFIX
from airl_mav.camera import intrinsics, render
from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.cli.shared_options import folder_of
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError, usage_errors
from airl_mav.core.fields import COMMON, ProfileModel, quantity
from airl_mav.core.frames import quat_from_euler
from airl_mav.core.progress import RichProgress, new_console
from airl_mav.profiles import loading, projections
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.camera import Coefficients
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.run_folder import load, trust_arenas
from airl_mav.scenario.model import DEFAULT_ARENA, GREATEST_SEED

STILL_RAYS, FILM_RAYS = 16, 4

STILL_PX, FILM_PX = (960, 640), (384, 256)

OF_AN_ARENA = (
    *("seed", "north_m", "east_m", "height_m", "yaw_deg", "pitch_up_deg"),
    *("time_s", "vehicle_width_m", "speed_m_s", "yaw_rate_deg_s"),
)
"""Options that are not supported for a flight, which defines them."""

OF_A_FLIGHT = ("flight", "rate_hz", "trust")

OF_NO_VEHICLE = (
    *("show", "samples", "projection", "width_px", "height_px", "fov_deg", "range_m"),
    "distortion",
)
"""Options that are not supported with a vehicle profile's camera, which defines them."""

OF_A_VEHICLE = ("speed_m_s", "yaw_rate_deg_s", "camera_name")
"""Options of a moving camera."""


class RenderOptions(ProfileModel):
    """Render an arena as a picture, or the camera of a recorded flight as a film.

    Without a pose the camera is at the vehicle's start and looks north.

    Examples:
        airl render static-obstacles --seed 7
        airl render forest.toml --north-m 10 --height-m 3 --yaw-deg 30 --out forest.png
        airl render dense-obstacles --show segmentation --out seen.png
        airl render dense-obstacles --show flow --speed-m-s 5 --out flow.npy
        airl render varied-looks --camera my-quad.toml --speed-m-s 5 --yaw-rate-deg-s 60
        airl render varied-looks --camera quad-rig --camera-name down
        airl render runs/A 7 --out flight.gif
    """

    subject: Annotated[str, POSITIONAL] = Field(
        default=DEFAULT_ARENA,
        description="arena, a shipped name or a path to a .toml; or a run folder, or the black box"
        " of a flight (.mcap)",
    )
    flight: Annotated[int | None, POSITIONAL] = Field(
        default=None, description="number of the run's flight; by default the worst"
    )
    seed: Annotated[int | None, COMMON] = quantity(
        "seed of the arena; by default the profile's", "1", ge=0, le=GREATEST_SEED, default=None
    )
    show: Annotated[pictures.Shown, COMMON] = Field(
        default="rgb",
        description="colour, its luma, depth (near is bright), segmentation (what is seen), or flow"
        " (how fast it moves over the image)",
    )
    camera: Annotated[str | None, COMMON] = Field(
        default=None,
        description="vehicle profile, a shipped name or a path to a .toml, whose camera takes the"
        " picture: its size, lens and sensor, one ray a pixel; where and how it looks is then where"
        " and how the vehicle does",
    )
    camera_name: str | None = Field(
        default=None,
        description="with --camera: name of an additional camera in the profile ([cameras.NAME]);"
        " default: the main camera",
    )
    speed_m_s: Annotated[float, COMMON] = quantity(
        "with --camera or --show flow: how fast it flies ahead", "m/s", ge=-100, le=100, default=0.0
    )
    yaw_rate_deg_s: float = quantity(
        "with --camera or --show flow: how fast it turns, clockwise",
        "deg/s",
        ge=-1000,
        le=1000,
        default=0.0,
    )
    samples: int | None = quantity(
        "rays a pixel; by default 16, in a film 4; a camera has one",
        "1",
        ge=1,
        le=4096,
        default=None,
    )
    out: Annotated[Path | None, COMMON] = Field(
        default=None,
        description="the file to write: .png of an arena; .gif, .mp4 or .webp of a flight; .npy of"
        " either, the numbers of depth [m], segmentation or flow [px/s]; by default render.png or"
        " render.gif",
    )
    rate_hz: float = quantity(
        "pictures a second of a film, rounded to steps of 10 ms", "Hz", ge=1, le=50, default=10.0
    )
    trust: bool = Field(
        default=False,
        description="run the arena generators named by the run: code by the author of the folder",
    )
    north_m: Annotated[float, COMMON] = quantity(
        "of the camera: distance north of the start", "m", ge=-1000, le=1000, default=0.0
    )
    east_m: Annotated[float, COMMON] = quantity(
        "of the camera: distance east of the start", "m", ge=-1000, le=1000, default=0.0
    )
    height_m: Annotated[float | None, COMMON] = quantity(
        "of the camera: height above the floor; by default the arena's flight altitude",
        "m",
        ge=0,
        le=1000,
        default=None,
    )
    yaw_deg: Annotated[float, COMMON] = quantity(
        "heading of the camera, clockwise from north", "deg", ge=-360, le=360, default=0.0
    )
    pitch_up_deg: float = quantity("how far the camera looks up", "deg", ge=-90, le=90, default=0.0)
    projection: projections.Projection = Field(default="pinhole", description="of the camera")
    width_px: int | None = quantity(
        "width; by default 960, of a film 384", "px", ge=8, le=4096, default=None
    )
    height_px: int | None = quantity(
        "height; by default 640, of a film 256", "px", ge=6, le=4096, default=None
    )
    fov_deg: float = quantity(
        "horizontal field of view, less than 170 with a pinhole", "deg", gt=10, le=360, default=90.0
    )
    distortion: Coefficients = quantity(
        "coefficients k1 k2 k3 k4 of a fisheye", "1", default=projections.UNDISTORTED
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
    """Write the picture or the film; return 0."""
    console = console or new_console()
    path = Path(options.subject)
    filmed = path.is_dir() or path.suffix == SUFFIX
    _check(options, filmed)
    out = options.out or Path("render.gif" if filmed else "render.png")
    with usage_errors(f"--out {out}: cannot write"):
        told = _film(options, path, out, console) if filmed else _picture(options, out)
    console.print(f"{told}: {out}", soft_wrap=True, highlight=False)
    return 0


def _check(options: RenderOptions, filmed: bool) -> None:
    for name in OF_AN_ARENA if filmed else OF_A_FLIGHT:
        value = getattr(options, name)
        if value != RenderOptions.model_fields[name].default:
            subject = "a flight" if filmed else "an arena"
            raise FieldError(name, value, problem=f"not for the picture of {subject}")
    suffixes = (*(pictures.FILMS if filmed else (".png",)), pictures.ARRAY)
    if options.out is not None and options.out.suffix.lower() not in suffixes:
        names = " or ".join(", ".join(suffixes).rsplit(", ", 1))
        raise FieldError("out", f"{options.out}", f"a file name that ends in {names}")
    numbers = options.out is not None and options.out.suffix.lower() == pictures.ARRAY
    if numbers and (options.camera is not None or options.show not in pictures.TRUTHS):
        accepted = " or ".join(", ".join(pictures.TRUTHS).rsplit(", ", 1))
        accepted += f" in a file {pictures.ARRAY}, without --camera"
        raise FieldError("show", options.show, accepted)
    for name in _not_asked_for(options):
        value = getattr(options, name)
        if value != RenderOptions.model_fields[name].default:
            problem = "with --camera" if options.camera else "without --camera or --show flow"
            raise FieldError(name, value, problem=problem)
    projections.check_lens("fov_deg", options.projection, options.fov_deg, options.distortion)
    if options.out is not None and options.out.suffix.lower() == pictures.VIDEO:
        check_installed("film")


def _not_asked_for(options: RenderOptions) -> tuple[str, ...]:
    """Return the options that the selected camera does not support."""
    if options.camera is not None:
        return OF_NO_VEHICLE
    return OF_A_VEHICLE[-1:] if options.show == "flow" else OF_A_VEHICLE


def _taking(vehicle: str, name: str | None) -> pictures.TakingCamera:
    """Return a camera of a vehicle profile, the main one or an additional one by name."""
    profile = load_vehicle(vehicle)
    if name is None:
        return pictures.TakingCamera(profile.camera)
    if name not in profile.cameras:
        known = ", ".join(profile.cameras) or f"none: vehicle {vehicle} has its main camera alone"
        raise FieldError("camera_name", name, known)
    return pictures.TakingCamera(profile.cameras[name], name)


def _is_truth(options: RenderOptions, out: Path) -> bool:
    """Return True for ground truth as numbers, or as a drawing of optical flow."""
    return options.show == "flow" or out.suffix.lower() == pictures.ARRAY


def _camera(options: RenderOptions, size: tuple[int, int]) -> intrinsics.Intrinsics:
    width, height = options.width_px or size[0], options.height_px or size[1]
    return intrinsics.Intrinsics.from_fov(
        width,
        height,
        math.radians(options.fov_deg),
        options.projection,
        distortion=options.distortion,
    )


def _drawn(options: RenderOptions, samples: int) -> pictures.Drawn:
    """Return the renderer, by default with `samples` rays per pixel."""
    rays = math.ceil(math.sqrt(options.samples or samples))
    return partial(pictures.still, show=options.show, rays=rays, range_m=options.range_m)


def _picture(options: RenderOptions, out: Path) -> str:
    spec = loading.load_profile("arenas", options.subject, ArenaSpec)
    arena = generate(
        spec,
        spec.default_seed if options.seed is None else options.seed,
        name=Path(options.subject).stem,
        vehicle_width_m=options.vehicle_width_m,
    )
    height = spec.flight_altitude_m if options.height_m is None else options.height_m
    position = np.array([options.north_m, options.east_m, -height])
    pitch, yaw = math.radians(options.pitch_up_deg), math.radians(options.yaw_deg)
    elapsed_us = round(options.time_s * US_PER_S)
    attitude = quat_from_euler(0.0, pitch, yaw)
    velocity = options.speed_m_s * np.array([math.cos(yaw), math.sin(yaw), 0.0])
    rates = np.array([0.0, 0.0, math.radians(options.yaw_rate_deg_s)])
    motion = render.Motion(position, attitude, velocity, rates)
    if options.camera is not None:
        camera_of = _taking(options.camera, options.camera_name)
        pictures.write_png(out, camera_of(arena, elapsed_us, motion, arena.seed))
        return "picture"
    centers = arena.centers_at(elapsed_us)
    camera = _camera(options, STILL_PX)
    if _is_truth(options, out):
        truth = pictures.truth_of(options.show, arena, elapsed_us, camera, motion)
        if out.suffix.lower() == pictures.ARRAY:
            pictures.write_array(out, truth)
            return options.show
        pictures.write_png(out, pictures.coloured_flow(truth))
        return "picture"
    drawn = _drawn(options, STILL_RAYS)
    pictures.write_png(out, drawn(arena, centers, camera, position, attitude))
    return "picture"


def _film(options: RenderOptions, path: Path, out: Path, console: Console) -> str:
    folder = folder_of(path)
    if options.trust:
        trust_arenas(load(folder))
    run = ReplayedRun(folder)
    record = run.records[0] if options.flight is None else run.record(options.flight)
    drawn = _drawn(options, FILM_RAYS)
    camera = _camera(options, FILM_PX)
    flight = run.flight(record)
    times = pictures.moments(flight, options.rate_hz)
    taking = None if options.camera is None else _taking(options.camera, options.camera_name)
    with RichProgress(console) as progress:
        bar = progress.bar("film", len(times), unit="pictures")

        def told() -> Iterator[int]:
            for time_us in times:
                yield time_us
                bar.advance()

        shown: Iterator[pictures.Pixels]
        if _is_truth(options, out):
            truths = pictures.truth_film(options.show, flight, camera, told())
            if out.suffix.lower() == pictures.ARRAY:
                stack = np.stack(list(truths))
                pictures.write_array(out, stack)
                return f"{options.show} of flight {record.index}, {len(stack)} pictures"
            shown = map(pictures.coloured_flow, truths)
        elif taking is None:
            shown = pictures.film(flight, camera, drawn, told())
        else:
            shown = pictures.taken_film(flight, taking, told())
        count = pictures.write_film(out, shown, options.rate_hz)
    return f"film of flight {record.index}, {count} pictures"
