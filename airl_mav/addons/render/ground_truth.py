"""Ground truth of camera pixels as arrays and pictures: depth, segmentation, optical flow."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.render.camera_pictures import Pixels, Shown
from airl_mav.addons.view.replayed_flight import ReplayedFlight
from airl_mav.arena.geometry import Arena
from airl_mav.camera.exposure import expose
from airl_mav.camera.flow import CameraMotion, motion_of_camera, optical_flow, velocities_of
from airl_mav.camera.imaging import ImageFormation
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.picture import render_picture
from airl_mav.camera.render import Motion, Mount, camera_pose
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.core.frames import quat_to_matrix
from airl_mav.flight.trajectory import pose_at
from airl_mav.profiles.camera import Camera
from airl_mav.report.forensics.camera_view import PolicyCamera
from airl_mav.report.theme import coloured

TURNED_OVER_US = 20_000
"""Half-width of the difference for angular rates of a recorded flight [µs]."""


class TakingCamera:
    """Camera with one ray per pixel, and image formation if its profile has `imaging`."""

    def __init__(self, camera: Camera, name: str = "") -> None:
        """Prepare a profile's camera at its mount; `name` identifies an additional camera."""
        self._camera, self._intrinsics = camera, Intrinsics.of(camera)
        self._forming = None if camera.imaging is None else ImageFormation(camera, name)
        self._mount = Mount.of(camera)

    def __call__(self, arena: Arena, elapsed_us: int, motion: Motion, seed: int) -> Pixels:
        """Return a picture (h, w, 3), grey (h, w) or coloured depth, at a time of the episode."""
        image: NDArray[Any]
        if self._forming is not None:
            frame = elapsed_us // self._camera.period_us
            image = self._forming.take(arena, elapsed_us, motion, seed, frame).image
        else:
            at, attitude = camera_pose(motion.position, motion.quaternion, self._mount)
            range_m, centers = self._camera.range_m, arena.centers_at(elapsed_us)
            image = expose(arena, centers, self._intrinsics, range_m, at, attitude)
        if self._camera.kind == "depth":
            return coloured(image, self._camera.range_m)
        return image if self._camera.kind == "rgb" else image[..., 0]


def taken_film(
    flight: ReplayedFlight, camera: TakingCamera, moments: Iterable[int]
) -> Iterator[Pixels]:
    """Yield a camera's pictures along a recorded flight; raise UsageError without its arena."""
    if flight.arena is None:
        raise UsageError(f"flight {flight.label}: its arena cannot be made any more")
    for time_us in moments:
        motion = recorded_motion(flight, time_us)
        elapsed_us = time_us - flight.record.started_us
        yield camera(flight.arena, elapsed_us, motion, flight.record.seed)


def recorded_motion(flight: ReplayedFlight, time_us: int) -> Motion:
    """Return the motion of a recorded flight's vehicle at a time [µs]."""
    position, velocity, quaternion = pose_at(flight.path, time_us)
    return Motion(position, quaternion, velocity, _rates(flight, time_us))


def _rates(flight: ReplayedFlight, time_us: int) -> NDArray[np.float64]:
    """Return the angular velocity FRD (3,) [rad/s] of a recorded flight from its attitudes."""
    *_, before = pose_at(flight.path, time_us - TURNED_OVER_US)
    *_, after = pose_at(flight.path, time_us + TURNED_OVER_US)
    turn = quat_to_matrix(before).T @ quat_to_matrix(after)
    # For a small rotation, the skew part of its matrix is the rotation vector.
    skew = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    rates: NDArray[np.float64] = skew * (US_PER_S / (2.0 * TURNED_OVER_US))
    return rates


ARRAY: Final = ".npy"
"""Suffix of numpy arrays."""

TRUTHS: Final = tuple(name for name in get_args(Shown) if name not in ("rgb", "grey"))
"""Kinds of pictures other than colour and grey."""


def truth_of(
    show: Shown, arena: Arena, elapsed_us: int, camera: Intrinsics, motion: CameraMotion
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
    show: Shown, flight: ReplayedFlight, camera: Intrinsics, moments: Iterable[int]
) -> Iterator[NDArray[Any]]:
    """Yield `truth_of` along a recorded flight for a camera at the vehicle's camera mount."""
    if flight.arena is None:
        raise UsageError(f"flight {flight.label}: its arena cannot be made any more")
    mount = PolicyCamera.of(flight.vehicle.camera).mount
    for time_us in moments:
        vehicle: Motion = recorded_motion(flight, time_us)
        motion = motion_of_camera(vehicle, mount)
        elapsed_us = time_us - flight.record.started_us
        yield truth_of(show, flight.arena, elapsed_us, camera, motion)


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
    written = io.BytesIO()
    np.save(written, array)
    replace_file(path, written.getvalue())
