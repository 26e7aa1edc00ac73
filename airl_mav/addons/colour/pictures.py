"""Camera pictures for display, films of recorded flights, and ground truth of pixels.

Optical flow is the image velocity of the point that each pixel shows, in closed form. A point p in
the camera's axes moves by p' = R^T (v_point - v_camera) - w x p, where R are these axes, and w is
their angular velocity. Its image moves by the derivative of the projection along p'
(Longuet-Higgins and Prazdny, "The interpretation of a moving retinal image", 1980). Infinitely
distant points move by the rotation only.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image

from airl_mav.addons.colour.image_sensor import ImageFormation
from airl_mav.addons.colour.picture import Picture, antialiased, grey, render_picture
from airl_mav.addons.view.replayed_flight import ReplayedFlight
from airl_mav.arena.geometry import Arena
from airl_mav.camera import intrinsics, primitives, render
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.primitives import OBSTACLE
from airl_mav.core import constants, errors, files, frames
from airl_mav.flight.trajectory import pose_at
from airl_mav.profiles.camera import Camera
from airl_mav.report.policy_view import PolicyCamera
from airl_mav.report.theme import coloured

ROOM = {
    primitives.CEILING: (236, 238, 240),
    primitives.SKY: (38, 42, 48),
    primitives.FLOOR: (120, 124, 130),
    primitives.WALL_NORTH_SOUTH: (178, 184, 192),
    primitives.WALL_EAST_WEST: (208, 212, 218),
}
"""Colours of floor, walls, ceiling and sky; obstacles are never grey."""


def coloured_segmentation(seen: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return `Picture.seen` (h, w) as RGB (h, w, 3); obstacles use tab20 without its greys."""
    tab20 = colormaps["tab20"](np.arange(20), bytes=True)[:, :3]
    own = np.delete(tab20, (14, 15), axis=0)
    most = max(int(seen.max(initial=0)) + 1, primitives.OBSTACLE)
    # The ceiling's number -1 indexes the last row.
    table = np.empty((most + 1, 3), np.uint8)
    table[primitives.OBSTACLE : most] = own[np.arange(most - primitives.OBSTACLE) % len(own)]
    for number, colour in ROOM.items():
        table[number] = colour
    coloured: NDArray[np.uint8] = table[seen]
    return coloured


Shown = Literal["rgb", "grey", "depth", "segmentation", "flow"]
Pixels = NDArray[np.uint8]
"""Picture (h, w) or (h, w, 3)."""

Drawn = Callable[
    [Arena, NDArray[np.float64], intrinsics.Intrinsics, NDArray[np.float64], NDArray[np.float64]],
    Pixels,
]
"""Renderer: arena, obstacle centres, camera, camera position and attitude -> picture."""

VIDEO = ".mp4"
"""Suffix of H.264 videos in MP4."""

FILMS = (".gif", VIDEO, ".webp")
"""Supported suffixes of films."""

VIDEO_CRF = 18
"""Constant rate factor of x264, visually lossless (x264's documentation)."""

STEP_MS = 10
"""Time resolution of a GIF [ms]."""


def still(
    arena: Arena,
    centers: NDArray[np.float64],
    camera: intrinsics.Intrinsics,
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    show: Shown,
    *,
    rays: int,
    range_m: float,
) -> Pixels:
    """Return a ray-cast picture of any kind except flow; colours use `rays` per pixel."""
    if show in ("rgb", "grey"):
        rgb = antialiased(arena, centers, camera, position, quaternion, rays)
        return rgb if show == "rgb" else grey(rgb)
    picture = render_picture(arena, centers, camera, position, quaternion)
    if show == "depth":
        return coloured(depth_to_z16(picture.depth_m), range_m)
    return coloured_segmentation(picture.seen)


def moments(flight: ReplayedFlight, rate_hz: float) -> range:
    """Return the picture times [µs] of a film from the start of navigation to the end."""
    path, record = flight.path, flight.record
    begin, end = max(record.zero_us, int(path.time_us[0])), int(path.time_us[-1])
    return range(begin, end + 1, period_ms(rate_hz) * constants.US_PER_MS)


def _replayed(
    flight: ReplayedFlight, moments: Iterable[int]
) -> Iterator[tuple[Arena, int, render.Motion]]:
    """Yield arena, time since the start and the vehicle's motion; UsageError without the arena."""
    if flight.arena is None:
        raise errors.UsageError(f"flight {flight.label}: its arena cannot be made any more")
    for time_us in moments:
        yield flight.arena, time_us - flight.record.started_us, recorded_motion(flight, time_us)


def film(
    flight: ReplayedFlight, camera: intrinsics.Intrinsics, drawn: Drawn, moments: Iterable[int]
) -> Iterator[Pixels]:
    """Yield pictures at the vehicle's camera pose; raise UsageError without the arena."""
    mount = PolicyCamera.of(flight.vehicle.camera).mount
    for arena, elapsed_us, motion in _replayed(flight, moments):
        at, attitude = render.camera_pose(motion.position, motion.quaternion, mount)
        yield drawn(arena, arena.centers_at(elapsed_us), camera, np.array(at), np.array(attitude))


def period_ms(rate_hz: float) -> int:
    """Return the frame period of a film [ms], a multiple of `STEP_MS`."""
    return STEP_MS * max(round(1000.0 / (STEP_MS * rate_hz)), 1)


def write_png(path: Path, pixels: Pixels) -> None:
    """Write a picture. Raises OSError."""
    with files.replacing(path) as partial:
        Image.fromarray(pixels).save(partial, "PNG")


def write_film(path: Path, pictures: Iterator[Pixels], rate_hz: float) -> int:
    """Write an animated GIF or WebP, or a video; return the number of pictures.

    A video requires even width and height (UsageError) and the extra `film` (ImportError).
    """
    if path.suffix.lower() == VIDEO:
        written, count = _video(pictures, period_ms(rate_hz))
    else:
        written, count = _animation(path.suffix[1:].upper(), pictures, period_ms(rate_hz))
    files.replace_file(path, written)
    return count


def _animation(kind: str, pictures: Iterator[Pixels], each_ms: int) -> tuple[bytes, int]:
    images = [Image.fromarray(pixels) for pixels in pictures]
    written = io.BytesIO()
    images[0].save(written, kind, save_all=True, append_images=images[1:], duration=each_ms, loop=0)
    return written.getvalue(), len(images)


def _video(pictures: Iterator[Pixels], each_ms: int) -> tuple[bytes, int]:
    """Encode pictures one at a time, with memory independent of the video's length."""
    import av

    first = next(pictures)
    height, width = first.shape[:2]
    if height % 2 or width % 2:
        raise errors.UsageError(f"{width} x {height} px: accepted: even numbers in an {VIDEO}")
    written, count = io.BytesIO(), 0
    with av.open(written, "w", format="mp4") as container:
        stream: Any = container.add_stream("libx264", Fraction(1000, each_ms))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": f"{VIDEO_CRF}"}
        for pixels in chain([first], pictures):
            count += 1
            kind = "rgb24" if pixels.ndim == 3 else "gray"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format=kind)))
        container.mux(stream.encode())
    return written.getvalue(), count


TURNED_OVER_US = 20_000
"""Half-width of the difference for angular rates of a recorded flight [µs]."""


class TakingCamera:
    """Camera with one ray per pixel, and image formation if its profile has `imaging`."""

    def __init__(self, camera: Camera, name: str = "") -> None:
        """Prepare a profile's camera at its mount; `name` identifies an additional camera."""
        self._camera, self._intrinsics = camera, intrinsics.Intrinsics.of(camera)
        self._forming = None if camera.imaging is None else ImageFormation(camera, name)
        self._mount = render.Mount.of(camera)

    def __call__(self, arena: Arena, elapsed_us: int, motion: render.Motion, seed: int) -> Pixels:
        """Return a picture (h, w, 3), grey (h, w) or coloured depth, at a time of the episode."""
        image: NDArray[Any]
        if self._forming is not None:
            frame = elapsed_us // self._camera.period_us
            image = self._forming.take(arena, elapsed_us, motion, seed, frame).image
        else:
            at, attitude = render.camera_pose(motion.position, motion.quaternion, self._mount)
            range_m, centers = self._camera.range_m, arena.centers_at(elapsed_us)
            image = render.expose(arena, centers, self._intrinsics, range_m, at, attitude)
        if self._camera.kind == "depth":
            return coloured(image, self._camera.range_m)
        return image if self._camera.kind == "rgb" else image[..., 0]


def taken_film(
    flight: ReplayedFlight, camera: TakingCamera, moments: Iterable[int]
) -> Iterator[Pixels]:
    """Yield a camera's pictures along a recorded flight; raise UsageError without its arena."""
    for arena, elapsed_us, motion in _replayed(flight, moments):
        yield camera(arena, elapsed_us, motion, flight.record.seed)


def recorded_motion(flight: ReplayedFlight, time_us: int) -> render.Motion:
    """Return the motion of a recorded flight's vehicle at a time [µs]."""
    position, velocity, quaternion = pose_at(flight.path, time_us)
    return render.Motion(position, quaternion, velocity, _rates(flight, time_us))


def _rates(flight: ReplayedFlight, time_us: int) -> NDArray[np.float64]:
    """Return the angular velocity FRD (3,) [rad/s] of a recorded flight from its attitudes."""
    *_, before = pose_at(flight.path, time_us - TURNED_OVER_US)
    *_, after = pose_at(flight.path, time_us + TURNED_OVER_US)
    turn = frames.quat_to_matrix(before).T @ frames.quat_to_matrix(after)
    # For a small rotation, the skew part of its matrix is the rotation vector.
    skew = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    rates: NDArray[np.float64] = skew * (constants.US_PER_S / (2.0 * TURNED_OVER_US))
    return rates


ARRAY: Final = ".npy"
"""Suffix of numpy arrays."""

TRUTHS: Final = tuple(name for name in get_args(Shown) if name not in ("rgb", "grey"))
"""Kinds of pictures other than colour and grey."""


def truth_of(
    show: Shown, arena: Arena, elapsed_us: int, camera: intrinsics.Intrinsics, motion: render.Motion
) -> NDArray[Any]:
    """Return the ground truth of each pixel at a time after the episode's start [µs].

    `depth` is float32 (h, w) [m] in the camera's projection, without a range limit; 0 = no surface.
    `segmentation` is int32 (h, w): 0 sky, 1 floor, 2 wall across north, 3 wall across east, 4 + i
    obstacle i. `flow` is float32 (h, w, 2), columns and rows per second [px/s]; NaN outside a
    fisheye's image.
    """
    centers = arena.centers_at(elapsed_us)
    picture = render_picture(arena, centers, camera, motion.position, motion.quaternion)
    if show == "depth":
        return picture.depth_m
    if show == "segmentation":
        return picture.seen
    return optical_flow(picture, camera, motion, velocities_of(arena, elapsed_us))


def truth_film(
    show: Shown, flight: ReplayedFlight, camera: intrinsics.Intrinsics, moments: Iterable[int]
) -> Iterator[NDArray[Any]]:
    """Yield `truth_of` along a recorded flight for a camera at the vehicle's camera mount."""
    mount = PolicyCamera.of(flight.vehicle.camera).mount
    for arena, elapsed_us, vehicle in _replayed(flight, moments):
        yield truth_of(show, arena, elapsed_us, camera, motion_of_camera(vehicle, mount))


def coloured_flow(flow: NDArray[np.float32]) -> Pixels:
    """Return flow (h, w, 2) as a picture: hue = direction, saturation = speed.

    Red moves right, then clockwise. Saturation is full at the 99th percentile.
    """
    across, down = np.nan_to_num(flow[..., 0]), np.nan_to_num(flow[..., 1])
    speed = np.hypot(across, down)
    most = max(float(np.quantile(speed, 0.99)), 1e-6)
    share = np.minimum(speed / most, 1.0)
    turns = np.arctan2(down, across) / (2.0 * np.pi)
    # In the colour wheel, each channel fades with the angle from its hue.
    angle = np.stack([turns, turns - 1.0 / 3.0, turns - 2.0 / 3.0], axis=-1) % 1.0
    wheel = np.clip(2.0 - 6.0 * np.minimum(angle, 1.0 - angle), 0.0, 1.0)
    colours = 255.0 * (1.0 - share[..., None] * (1.0 - wheel))
    colours[np.isnan(flow[..., 0])] = 0.0
    pixels: Pixels = np.rint(colours).astype(np.uint8)
    return pixels


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array in numpy's format. Raises OSError."""
    with files.replacing(path) as partial, partial.open("wb") as file:
        np.save(file, array)


Floats = NDArray[np.float64]

MOVED_OVER_US = 1_000
"""Half interval of the central difference for velocities of moving obstacles [µs]."""


def motion_of_camera(vehicle: render.Motion, mount: render.Mount) -> render.Motion:
    """Return the motion of a camera mounted on a vehicle; rates are about the camera's axes."""
    at, attitude = render.camera_pose(vehicle.position, vehicle.quaternion, mount)
    body = frames.quat_to_matrix(vehicle.quaternion)
    lever = np.cross(vehicle.rates, np.array(mount.offset))
    axes = frames.quat_to_matrix(np.array(attitude))
    rates = axes.T @ body @ vehicle.rates
    return render.Motion(np.array(at), np.array(attitude), vehicle.velocity + body @ lever, rates)


def velocities_of(arena: Arena, elapsed_us: int) -> Floats:
    """Return the velocities (n, 3) NED [m/s] of all obstacles, `elapsed_us` after the start."""
    before, after = (
        arena.centers_at(elapsed_us + step) for step in (-MOVED_OVER_US, MOVED_OVER_US)
    )
    found: Floats = (after - before) * (constants.US_PER_S / (2.0 * MOVED_OVER_US))
    return found


def optical_flow(
    picture: Picture, camera: intrinsics.Intrinsics, motion: render.Motion, velocities: Floats
) -> NDArray[np.float32]:
    """Return the flow (h, w, 2) of a picture [px/s]; NaN outside a fisheye's field of view."""
    rays = camera.rays
    axes = frames.quat_to_matrix(motion.quaternion)
    depth = picture.depth_m.astype(np.float64)
    # Depth 0 is infinitely distant. Such points only turn, for which any depth will do.
    far = depth <= 0.0
    points = rays * np.where(far, 1.0, depth)
    number = picture.seen - OBSTACLE
    moves = np.zeros((*depth.shape, 3))
    if len(velocities):
        # Only obstacles move; room and sky have numbers below OBSTACLE.
        moves = np.where((number >= 0)[..., None], velocities[np.maximum(number, 0)], 0.0)
    apart = (moves - motion.velocity) @ axes
    apart[far] = 0.0
    turning = np.cross(motion.rates, np.moveaxis(points, 0, -1))
    flow = np.stack(camera.model.flow(camera, points, np.moveaxis(apart - turning, -1, 0)), axis=-1)
    flow[~rays.any(axis=0)] = np.nan
    return flow.astype(np.float32)
