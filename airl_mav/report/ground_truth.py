"""What each pixel of a camera truly shows, as arrays and pictures: depth, which thing, its flow."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.flow import CameraMotion, motion_of_camera, optical_flow, velocities_of
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.picture import render_picture
from airl_mav.camera.render import Motion
from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.report.camera_pictures import Pixels, Shown
from airl_mav.report.camera_taken import recorded_motion
from airl_mav.report.forensics.camera_view import PolicyCamera
from airl_mav.report.replay.flight import ReplayedFlight

ARRAY: Final = ".npy"
"""Suffix of an array, as numpy writes it."""

TRUTHS: Final = tuple(name for name in get_args(Shown) if name not in ("rgb", "grey"))
"""What is no colour."""


def truth_of(
    show: Shown, arena: Arena, elapsed_us: int, camera: Intrinsics, motion: CameraMotion
) -> NDArray[Any]:
    """Return what each pixel shows.

    Args:
        show: One of `TRUTHS`.
        arena: What is seen.
        elapsed_us: Time since the episode's start [µs].
        camera: Intrinsics.
        motion: How the camera moves.

    Returns:
        Of `depth` float32 (h, w) [m], as the camera's projection measures it, without a limit of
        range, 0 where there is no surface. Of `segmentation` int32 (h, w): 0 sky, 1 floor, 2 a wall
        across north, 3 one across east, 4 + i obstacle i. Of `flow` float32 (h, w, 2): columns and
        rows a second [px/s], NaN where a fisheye sees nothing.
    """
    centers = arena.centers_at(elapsed_us)
    picture = render_picture(arena, centers, camera, motion.position, motion.quaternion)
    if show == "depth":
        return picture.depth_m
    if show == "segmentation":
        return picture.seen
    return optical_flow(picture, camera, motion, velocities_of(arena, elapsed_us))


def truth_film(
    show: Shown, flight: ReplayedFlight, camera: Intrinsics, moments: Iterable[int]
) -> Iterator[NDArray[Any]]:
    """Yield what each pixel shows along the way of a recorded flight; see `truth_of`.

    The camera sits and looks as that of the vehicle.

    Raises:
        UsageError: The arena of the flight cannot be made any more.
    """
    if flight.arena is None:
        raise UsageError(f"flight {flight.label}: its arena cannot be made any more")
    mount = PolicyCamera.of(flight.vehicle.camera).mount
    for time_us in moments:
        vehicle: Motion = recorded_motion(flight, time_us)
        motion = motion_of_camera(vehicle, mount)
        elapsed_us = time_us - flight.record.started_us
        yield truth_of(show, flight.arena, elapsed_us, camera, motion)


def coloured_flow(flow: NDArray[np.float32]) -> Pixels:
    """Return flow (h, w, 2) as a picture: its direction is the hue, its speed the saturation.

    Red moves to the right, then clockwise; what moves as fast as the fastest hundredth is full.
    """
    across, down = np.nan_to_num(flow[..., 0]), np.nan_to_num(flow[..., 1])
    speed = np.hypot(across, down)
    most = max(float(np.quantile(speed, 0.99)), 1e-6)
    share = np.minimum(speed / most, 1.0)
    turns = np.arctan2(down, across) / (2.0 * np.pi)
    # A colour wheel: each channel fades with the angle from its own hue.
    angle = np.stack([turns, turns - 1.0 / 3.0, turns - 2.0 / 3.0], axis=-1) % 1.0
    wheel = np.clip(2.0 - 6.0 * np.minimum(angle, 1.0 - angle), 0.0, 1.0)
    colours = 255.0 * (1.0 - share[..., None] * (1.0 - wheel))
    colours[np.isnan(flow[..., 0])] = 0.0
    pixels: Pixels = np.rint(colours).astype(np.uint8)
    return pixels


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as numpy does. Raises OSError."""
    written = io.BytesIO()
    np.save(written, array)
    replace_file(path, written.getvalue())
