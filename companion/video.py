"""Video of a camera for ground stations: H.264 over RTP."""

from __future__ import annotations

import math
from contextlib import suppress
from fractions import Fraction
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import Frame, FurtherImage, nearness, rgb_of
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import US_PER_S

GIMBAL_PORT: Final = 13_280
"""Port to which PX4 SITL's instance 0 forwards MAVLink for a gimbal (px4-rc.mavlink), like the
built-in flight controller of `airl-firmware`. This link is fast enough and otherwise unused."""

LEAST_PX: Final = 320
"""Minimum width of the video [px]; smaller images are enlarged by an integer factor."""

DARKEST: Final = 32.0
"""Grey value of the maximum range, 0 to 255; pixels without a return are darker."""

KEYFRAME_S: Final = 1.0
"""Interval of keyframes [s], and so the maximum wait of a new viewer."""

CRF: Final = 23
"""Quality of x264, its default: 0 = lossless, 51 = worst."""

_CLOCK_HZ: Final = 90_000
"""Clock rate of H.264 time stamps in RTP (RFC 6184)."""


class VideoReceiver(NamedTuple):
    """Receiver of the video."""

    host: str
    port: int


def picture_of(frame: Frame | FurtherImage, range_m: float) -> NDArray[np.uint8]:
    """Return an image as a picture (h, w, 3) with even sides; near = bright, no return = black."""
    if frame.intrinsics.kind == "depth":
        # The shade is linear in nearness from DARKEST to white.
        shade = DARKEST + (255.0 - DARKEST) * nearness(frame.image, range_m)
        grey = np.where(frame.image == 0, 0.0, shade).astype(np.uint8)
        picture = rgb_of(grey[..., None])
    else:
        picture = rgb_of(frame.image)
    # Small images are enlarged by repetition, which keeps pixels visible.
    times = enlargement(frame.intrinsics)
    larger = picture.repeat(times, axis=0).repeat(times, axis=1)
    # H.264 with subsampled colour requires even sides.
    width, height = picture_size(frame.intrinsics)
    return np.ascontiguousarray(larger[:height, :width])


def enlargement(lens: Intrinsics) -> int:
    """Return the integer enlargement factor of a picture."""
    least = max(LEAST_PX / lens.width, 2.0 / lens.height)
    return max(1, math.ceil(least))


def picture_size(lens: Intrinsics) -> tuple[int, int]:
    """Return width and height of the pictures of a camera [px]."""
    times = enlargement(lens)
    return lens.width * times // 2 * 2, lens.height * times // 2 * 2


class RtpVideo:
    """Encoder that sends each picture immediately to one address."""

    def __init__(self, host: str, port: int, size: tuple[int, int], rate_hz: float) -> None:
        """Open a stream of pictures (width, height) to a UDP port; ImportError without PyAV."""
        import av

        self._av = av
        self._container = av.open(f"rtp://{host}:{port}", "w", format="rtp")
        self._stream: Any = self._container.add_stream("libx264", Fraction(round(rate_hz)))
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._stream.codec_context.time_base = Fraction(1, _CLOCK_HZ)
        # A viewer that joins late waits for the next keyframe.
        self._stream.codec_context.gop_size = max(1, round(KEYFRAME_S * rate_hz))
        # One slice per picture and no buffering, so that each picture is sent at once.
        self._stream.options = {"preset": "ultrafast", "tune": "zerolatency", "crf": f"{CRF}"}
        self._stream.codec_context.thread_count = 1
        self._first_us: int | None = None
        self._last_pts = -1

    def show(self, picture: NDArray[np.uint8], time_us: int) -> None:
        """Send a picture (h, w, 3) at a time [µs], unless older than the last; raises OSError."""
        if self._first_us is None:
            self._first_us = time_us
        # The stream starts at 0 and uses RTP's 90 kHz clock.
        pts = (time_us - self._first_us) * _CLOCK_HZ // US_PER_S
        if pts <= self._last_pts:
            return
        self._last_pts = pts
        image = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
        image.pts, image.time_base = pts, Fraction(1, _CLOCK_HZ)
        self._container.mux(self._stream.encode(image))

    def close(self) -> None:
        """End the stream."""
        with suppress(OSError):
            self._container.close()
