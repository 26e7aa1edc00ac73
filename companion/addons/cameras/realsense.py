"""Intel RealSense depth cameras and recordings, through librealsense (the extra `realsense`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyrealsense2 as rs

from airl_mav.camera.frame import MAX_MM, MM_PER_M
from airl_mav.core.clock import Clock, utc_us
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import FieldError
from companion.addons.cameras import drivers, fitting

RATE_HZ = 30
WIDTH_PX = 848
"""Preferred image width: D400 stereo modules match best at 848 x 480 (Intel, "Tuning depth cameras
for best performance")."""

RECORDINGS = ".bag", ".db3"
"""File name suffixes of librealsense's recorder versions."""


class RealSense:
    """Depth stream of one device. Implements `driver.DepthCamera`."""

    def __init__(self, device: Any, utc_now_us: Callable[[], int] = utc_us) -> None:
        """Start the depth stream of a `pyrealsense2.device`, or raise FieldError."""
        self._device, self._utc_now_us = device, utc_now_us
        self._sensor, profile = _depth_stream(device)
        k = profile.as_video_stream_profile().intrinsics
        self.lens = fitting.Lens(k.width, k.height, k.fx, k.fy, k.ppx, k.ppy)
        """Lens of the depth stream, which librealsense delivers rectified."""
        # A queue of one keeps the newest frame.
        self._queue = rs.frame_queue(1)
        self._silence = drivers.Silence()
        self._sensor.open(profile)
        self._sensor.start(self._queue)

    def read(self, timeout_s: float) -> drivers.DepthImage | None:
        """Wait for the next image; RuntimeError after 5 s: unplugged, or end of a recording."""
        arrived, frame = self._queue.try_wait_for_frame(int(timeout_s * US_PER_S / US_PER_MS))
        if not arrived:
            self._silence.lasted(timeout_s)
            return None
        self._silence.broken()
        depth = frame.as_depth_frame()
        # Copied, as librealsense reuses the memory after the frame is released.
        image = np.array(depth.get_data(), np.uint16)
        unit_mm = depth.get_units() * MM_PER_M
        # Depth units differ between models; 1 mm is the common case and needs no scaling.
        if abs(unit_mm - 1.0) > 1e-6:
            image = np.clip(np.rint(image * unit_mm), 0, MAX_MM).astype(np.uint16)
        return drivers.DepthImage(image, self._age_us(depth), depth.get_frame_number())

    def close(self) -> None:
        """Stop the stream."""
        self._sensor.stop()
        self._sensor.close()

    def _age_us(self, frame: Any) -> int:
        """Return the age of an image [µs]; 0 for stamps of the camera's clock."""
        if frame.get_frame_timestamp_domain() == rs.timestamp_domain.hardware_clock:
            return 0
        return drivers.plausible_age_us(self._utc_now_us() - int(frame.get_timestamp() * US_PER_MS))


def open_realsense(which: str, _clock: Clock) -> RealSense:
    """Open the first camera, a serial number, or a .bag or .db3 file; FieldError if missing."""
    context = rs.context()
    if which.endswith(RECORDINGS):
        if not Path(which).is_file():
            raise FieldError("camera", f"realsense:{which}", problem="no such file")
        try:
            return RealSense(context.load_device(which))
        except RuntimeError as error:
            raise FieldError("camera", f"realsense:{which}", problem=str(error)) from None
    # Cameras by serial number, in the order of enumeration.
    found = {each.get_info(rs.camera_info.serial_number): each for each in context.query_devices()}
    if not found:
        raise FieldError("camera", _name(which), problem="librealsense finds no camera")
    if which and which not in found:
        raise FieldError("camera", _name(which), f"realsense:{' or realsense:'.join(found)}")
    try:
        return RealSense(found[which] if which else next(iter(found.values())))
    except RuntimeError as error:
        # The camera is in use by another program, or the bus is too slow.
        raise FieldError("camera", _name(which), problem=str(error)) from None


def _name(which: str) -> str:
    return f"realsense:{which}" if which else "realsense"


def _depth_stream(device: Any) -> tuple[Any, Any]:
    """Return the sensor and the profile closest to 848 pixels width and 30 images/s."""
    # Z16 depth profiles of all sensors of the device.
    offered = [
        (sensor, profile)
        for sensor in device.query_sensors()
        for profile in sensor.get_stream_profiles()
        if profile.stream_type() == rs.stream.depth and profile.format() == rs.format.z16
    ]
    if not offered:
        raise FieldError("camera", "realsense", problem="the device has no depth stream")

    def fit(offer: tuple[Any, Any]) -> tuple[int, int]:
        profile = offer[1].as_video_stream_profile()
        return abs(profile.width() - WIDTH_PX), abs(profile.fps() - RATE_HZ)

    return min(offered, key=fit)
