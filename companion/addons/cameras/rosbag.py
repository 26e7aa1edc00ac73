"""Depth images of a recording by `ros2 bag record`, at the recorded rate."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore

from airl_mav.camera.frame import MAX_MM, MM_PER_M
from airl_mav.core.clock import NS_PER_US, Clock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.profiles.projections import MOST_COEFFICIENT, Distortion
from companion.addons.cameras import drivers, fitting


class RosBag:
    """Depth images of one topic of a recording. Implements `driver.DepthCamera`."""

    def __init__(self, which: str, clock: Clock) -> None:
        """Open a recording by PATH of its folder or file, or PATH:TOPIC; else FieldError."""
        # The separator is ":/", since a topic starts with a slash and a path may contain colons.
        path, separator, topic = which.rpartition(":/")
        if not separator:
            path, topic = which, ""
        name = f"rosbag:{which}"
        if not Path(path).exists():
            raise FieldError("camera", name, problem=f"{path}: no such recording")
        try:
            self._bag = AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._bag.open()
        except (AnyReaderError, OSError) as error:
            raise FieldError("camera", name, problem=" ".join(str(error).split())) from None
        self._clock, self._began_us = clock, 0
        self._first_us: int | None = None
        try:
            self._topic = self._chosen(name, path, f"/{topic}" if separator else None)
            self.lens = self._described(name)
            """Lens described by the first camera_info."""
        except FieldError:
            self._bag.close()
            raise
        self._told = self._messages(self._topic)
        self._next: tuple[int, Any] | None = None

    def _chosen(self, name: str, path: str, topic: str | None) -> str:
        """Return the requested topic, or the only topic with depth images."""
        # Without a topic, exactly one topic with depth images must exist.
        images = sorted(each.topic for each in self._bag.connections if each.msgtype == IMAGE)
        if topic is None:
            images = [each for each in images if self._is_depth(each)]
        if topic in images:
            return topic
        if topic is None and len(images) == 1:
            return images[0]
        accepted = " or ".join(f"rosbag:{path}:{each}" for each in images)
        if not accepted:
            raise FieldError("camera", name, problem="it holds no depth images (sensor_msgs/Image)")
        raise FieldError("camera", name, accepted)

    def _is_depth(self, topic: str) -> bool:
        first = next(self._messages(topic), None)
        try:
            return first is not None and depth_mm(first[1]).size > 0
        except ValueError:
            # Colour images use the same message type; the encoding distinguishes them.
            return False

    def _described(self, name: str) -> fitting.Lens:
        described = info_topic(self._topic)
        kinds = {each.topic: each.msgtype for each in self._bag.connections}
        if kinds.get(described) != CAMERA_INFO:
            raise FieldError(
                "camera", name, problem=f"no sensor_msgs/CameraInfo on {described} in it"
            )
        try:
            return lens_of(next(self._messages(described))[1], self._topic)
        except (StopIteration, ValueError) as error:
            raise FieldError("camera", name, problem=f"{described}: {error or 'empty'}") from None

    def _messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield arrival times at the recorder [µs since 1970] and messages."""
        which = [each for each in self._bag.connections if each.topic == topic]
        for connection, time_ns, data in self._bag.messages(connections=which):
            yield time_ns // NS_PER_US, self._bag.deserialize(data, connection.msgtype)

    def read(self, timeout_s: float) -> drivers.DepthImage | None:
        """Wait until the next image is due; RuntimeError at the end, ValueError without depth."""
        if self._next is None:
            self._next = next(self._told, None)
        if self._next is None:
            raise RuntimeError("the recording is over")
        arrived_us, message = self._next
        # Replay time starts with the first request.
        if self._first_us is None:
            self._first_us, self._began_us = arrived_us, self._clock.time_us()
        due_us = self._began_us + arrived_us - self._first_us
        until_us = self._clock.time_us() + round(timeout_s * US_PER_S)
        # The wait ends at the timeout, and the image stays pending.
        self._clock.sleep_until(min(due_us, until_us))
        if due_us > until_us:
            return None
        self._next = None
        return drivers.DepthImage(depth_mm(message), age_us(message, arrived_us))

    def close(self) -> None:
        """Close the recording."""
        self._bag.close()


def open_rosbag(which: str, clock: Clock) -> RosBag:
    """Open a recording. Raises FieldError."""
    if not which:
        raise FieldError("camera", "rosbag:", "ros2:/TOPIC or rosbag:PATH")
    return RosBag(which, clock)


IMAGE, CAMERA_INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
"""Message types of the two topics of a camera."""

MILLIMETRES, METRES = ("16UC1", "mono16"), ("32FC1",)
"""Encodings of depth images, by unit (ROS Enhancement Proposal 118)."""


def depth_mm(message: Any) -> NDArray[np.uint16]:
    """Return the depth image (height, width) of a sensor_msgs/Image [mm], or raise ValueError.

    0 = no return. In metres, NaN, infinity and non-positive values mean no return (ROS
    Enhancement Proposal 117).
    """
    if message.encoding not in (*MILLIMETRES, *METRES):
        raise ValueError(
            f"encoding {message.encoding!r}; accepted: {', '.join((*MILLIMETRES, *METRES))}"
        )
    order = ">" if message.is_bigendian else "<"
    kind = np.dtype(f"{order}u2" if message.encoding in MILLIMETRES else f"{order}f4")
    height, width, step = message.height, message.width, message.step
    data = np.frombuffer(memoryview(message.data), np.uint8)
    # Rows may be padded, so `step` can exceed the width.
    least = width * kind.itemsize
    if not height or not width or step < least or len(data) != height * step:
        raise ValueError(
            f"{width} x {height} pixels of {kind.itemsize} bytes in rows of {step} bytes are not"
            f" {len(data)} bytes"
        )
    # Padding is cut before the bytes are viewed as pixels.
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :least])
    image = rows.view(kind)
    if message.encoding in MILLIMETRES:
        return image.astype(np.uint16)
    # Conversion of NaN and infinity raises warnings in NumPy; both become 0 below.
    with np.errstate(invalid="ignore", over="ignore"):
        mm = np.rint(image * np.float32(MM_PER_M))
        known = np.isfinite(image) & (mm > 0)
    return np.where(known, np.minimum(mm, MAX_MM), 0).astype(np.uint16)


def stamped_us(message: Any) -> int:
    """Return the stamp of a message: calendar time since 1970 [µs], unless time is simulated."""
    stamp = message.header.stamp
    return int(stamp.sec) * US_PER_S + int(stamp.nanosec) // NS_PER_US


def age_us(message: Any, now_us: int) -> int:
    """Return the age of an image [µs] at a time since 1970 [µs]; 0 for another clock's stamp."""
    return drivers.plausible_age_us(now_us - stamped_us(message))


EQUIDISTANT = "equidistant"
"""Distortion model with the Kannala-Brandt coefficients k1 to k4 in D."""

RECTIFIED = "rect"
"""Mark of rectified images in the last part of a topic name, as used by ROS's image_proc."""


def lens_of(message: Any, image_topic: str = "") -> fitting.Lens:
    """Return the lens described by a sensor_msgs/CameraInfo, or raise ValueError.

    Without distortion, K describes the camera. With distortion, P describes the rectified images
    that drivers subscribe to. Images of the model `equidistant` (fisheye) are used unrectified with
    K and D, unless the last part of their topic marks them as rectified. Binned or cropped images
    are unsupported.
    """
    roi = message.roi
    # An ROI of zeros means the whole image (CameraInfo.msg).
    cropped = (roi.width, roi.height) not in ((0, 0), (message.width, message.height))
    if max(message.binning_x, message.binning_y) > 1 or cropped:
        raise ValueError("binned or cropped images; accepted: whole ones")
    distorts = any(abs(each) > 0.0 for each in message.d)
    # image_proc publishes rectified images under names such as image_rect.
    rectified = RECTIFIED in image_topic.rpartition("/")[2]
    fisheye = message.distortion_model == EQUIDISTANT and not rectified
    coefficients = _coefficients(message) if fisheye else None
    distorts &= not fisheye
    # K describes raw images, P rectified ones.
    fx, cx, fy, cy = (
        (message.p[0], message.p[2], message.p[5], message.p[6])
        if distorts
        else (message.k[0], message.k[2], message.k[4], message.k[5])
    )
    if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy) > 0.0 and message.width):
        raise ValueError(f"a camera of focal lengths {fx:g} and {fy:g} px, which is no pinhole")
    return fitting.Lens(message.width, message.height, fx, fy, cx, cy, coefficients)


def _coefficients(message: Any) -> Distortion:
    """Return the coefficients of a fisheye's description. Raises ValueError if invalid."""
    told = [float(each) for each in message.d]
    if len(told) != 4 or not all(abs(each) <= MOST_COEFFICIENT for each in told):
        raise ValueError(
            f"D {told} of the model {EQUIDISTANT}; accepted: four numbers from"
            f" -{MOST_COEFFICIENT:g} to {MOST_COEFFICIENT:g}"
        )
    k1, k2, k3, k4 = told
    return k1, k2, k3, k4


def info_topic(image_topic: str) -> str:
    """Return the camera_info topic in the namespace of an image topic."""
    return f"{image_topic.rpartition('/')[0]}/camera_info"
