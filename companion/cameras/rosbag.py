"""Depth images of a recording by `ros2 bag record`, at the recorded rate."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore

from airl_mav.core.clock import NS_PER_US, Clock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from companion.cameras.driver import DepthImage
from companion.cameras.fitting import Lens
from companion.cameras.ros_images import CAMERA_INFO, IMAGE, age_us, depth_mm, info_topic, lens_of


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

    def _described(self, name: str) -> Lens:
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

    def read(self, timeout_s: float) -> DepthImage | None:
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
        return DepthImage(depth_mm(message), age_us(message, arrived_us))

    def close(self) -> None:
        """Close the recording."""
        self._bag.close()
