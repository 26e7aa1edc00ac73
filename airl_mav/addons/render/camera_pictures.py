"""Camera pictures for display: stills, and films of recorded flights."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image

from airl_mav.addons.view.replayed_flight import ReplayedFlight
from airl_mav.arena.geometry import Arena
from airl_mav.camera import primitives
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.picture import antialiased, grey, render_picture
from airl_mav.camera.render import camera_pose
from airl_mav.core.constants import US_PER_MS
from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.flight.trajectory import pose_at
from airl_mav.report.forensics.camera_view import PolicyCamera
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
    [Arena, NDArray[np.float64], Intrinsics, NDArray[np.float64], NDArray[np.float64]], Pixels
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
    camera: Intrinsics,
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
    return range(begin, end + 1, period_ms(rate_hz) * US_PER_MS)


def film(
    flight: ReplayedFlight, camera: Intrinsics, drawn: Drawn, moments: Iterable[int]
) -> Iterator[Pixels]:
    """Yield pictures at the vehicle's camera pose; raise UsageError without the arena."""
    if flight.arena is None:
        raise UsageError(f"flight {flight.label}: its arena cannot be made any more")
    mount = PolicyCamera.of(flight.vehicle.camera).mount
    for time_us in moments:
        position, _, quaternion = pose_at(flight.path, time_us)
        at, attitude = camera_pose(position, quaternion, mount)
        centers = flight.arena.centers_at(time_us - flight.record.started_us)
        yield drawn(flight.arena, centers, camera, np.array(at), np.array(attitude))


def period_ms(rate_hz: float) -> int:
    """Return the frame period of a film [ms], a multiple of `STEP_MS`."""
    return STEP_MS * max(round(1000.0 / (STEP_MS * rate_hz)), 1)


def write_png(path: Path, pixels: Pixels) -> None:
    """Write a picture. Raises OSError."""
    written = io.BytesIO()
    Image.fromarray(pixels).save(written, "PNG")
    replace_file(path, written.getvalue())


def write_film(path: Path, pictures: Iterator[Pixels], rate_hz: float) -> int:
    """Write an animated GIF or WebP, or a video; return the number of pictures.

    A video requires even width and height (UsageError) and the extra `film` (ImportError).
    """
    if path.suffix.lower() == VIDEO:
        written, count = _video(pictures, period_ms(rate_hz))
    else:
        written, count = _animation(path.suffix[1:].upper(), pictures, period_ms(rate_hz))
    replace_file(path, written)
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
        raise UsageError(f"{width} x {height} px: accepted: even numbers in an {VIDEO}")
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
