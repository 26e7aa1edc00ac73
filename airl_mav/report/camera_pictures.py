"""What a camera sees, as pictures for people: stills, and films of recorded flights."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.picture import antialiased, grey, render_picture
from airl_mav.camera.render import camera_pose
from airl_mav.core.constants import US_PER_MS
from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.report.depth_colours import coloured
from airl_mav.report.forensics.camera_view import PolicyCamera, pose_at
from airl_mav.report.replay.flight import ReplayedFlight
from airl_mav.report.segmentation_colours import coloured_segmentation

Shown = Literal["rgb", "grey", "depth", "segmentation"]
Pixels = NDArray[np.uint8]
"""(h, w) or (h, w, 3)."""

FILMS = (".gif", ".webp")
"""Kinds of films."""

STEP_MS = 10
"""A GIF counts time in these steps [ms]."""


def still(
    arena: Arena,
    centers: NDArray[np.float64],
    camera: Intrinsics,
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    show: Shown,
    *,
    rays: int,
    range_m: float,
) -> Pixels:
    """Return a picture by the ray caster.

    Args:
        arena: What is seen.
        centers: (n, 3) present obstacle centres NED [m].
        camera: Its intrinsics.
        position: (3,) camera NED [m].
        quaternion: (4,) unit [w, x, y, z] camera -> NED.
        show: What to draw.
        rays: Of a pixel of rgb and grey, each way.
        range_m: Depth that is darkest [m].
    """
    if show in ("rgb", "grey"):
        rgb = antialiased(arena, centers, camera, position, quaternion, rays)
        return rgb if show == "rgb" else grey(rgb)
    picture = render_picture(arena, centers, camera, position, quaternion)
    if show == "depth":
        return coloured(depth_to_z16(picture.depth_m), range_m)
    return coloured_segmentation(picture.seen)


def film(
    flight: ReplayedFlight,
    camera: Intrinsics,
    show: Shown,
    *,
    rate_hz: float,
    rays: int,
    range_m: float,
) -> Iterator[Pixels]:
    """Yield what the camera of a recorded flight saw, from the start of navigation to the end.

    Args:
        flight: The flight.
        camera: Intrinsics; it sits and looks as that of the vehicle.
        show: What to draw.
        rate_hz: Pictures a second, as `period_ms` rounds them.
        rays: Of a pixel of rgb and grey, each way.
        range_m: Depth that is darkest [m].

    Raises:
        UsageError: The arena of the flight cannot be made any more.
    """
    if flight.arena is None:
        raise UsageError(f"flight {flight.label}: its arena cannot be made any more")
    path, record = flight.path, flight.record
    begin = record.started_us if record.navigation_us is None else record.navigation_us
    begin, end = max(begin, int(path.time_us[0])), int(path.time_us[-1])
    mount = PolicyCamera.of(flight.vehicle.camera).mount
    for time_us in range(begin, end + 1, period_ms(rate_hz) * US_PER_MS):
        position, _, quaternion = pose_at(path, time_us)
        at, attitude = camera_pose(position, quaternion, mount)
        centers = flight.arena.centers_at(time_us - record.started_us)
        pose = (camera, np.array(at), np.array(attitude))
        yield still(flight.arena, centers, *pose, show, rays=rays, range_m=range_m)


def period_ms(rate_hz: float) -> int:
    """Return the time between two pictures of a film [ms], in whole steps."""
    return STEP_MS * max(round(1000.0 / (STEP_MS * rate_hz)), 1)


def write_png(path: Path, pixels: Pixels) -> None:
    """Write a picture. Raises OSError."""
    written = io.BytesIO()
    Image.fromarray(pixels).save(written, "PNG")
    replace_file(path, written.getvalue())


def write_film(path: Path, pictures: Iterator[Pixels], rate_hz: float) -> int:
    """Write pictures as an animated GIF or WebP, by the suffix; return their number.

    Raises OSError.
    """
    images = [Image.fromarray(pixels) for pixels in pictures]
    written = io.BytesIO()
    images[0].save(
        written,
        path.suffix[1:].upper(),
        save_all=True,
        append_images=images[1:],
        duration=period_ms(rate_hz),
        loop=0,
    )
    replace_file(path, written.getvalue())
    return len(images)
