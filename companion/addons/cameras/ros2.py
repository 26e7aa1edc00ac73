"""Depth images of a ROS 2 node, received without ROS: over DDS, its transport protocol.

ROS 2 sends a message of the topic /a/b and the type p/msg/T as a DDS sample of the topic rt/a/b and
the type p::msg::dds_::T_ (ROS 2 design, "Topic and Service name mapping to DDS"). Cyclone DDS
receives the sample, and rosbags decodes it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import annotations as annotate
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.typesys import Stores, get_typestore

from airl_mav.core.clock import Clock, utc_us
from airl_mav.core.errors import FieldError, UsageError
from companion.addons.cameras import rosbag
from companion.addons.cameras.drivers import DepthImage, Silence

DESCRIBED_S = 5.0
"""Timeout of the camera's description [s]. ROS 2 nodes discover each other within a second."""

MOST_DOMAIN = 232
"""Maximum ROS_DOMAIN_ID; a larger id has no valid ports."""

HERE_ALONE = """<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface name="lo"/></Interfaces>\
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>\
<Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
"""Cyclone DDS configuration for ROS_LOCALHOST_ONLY=1."""

_sequence: Any = sequence
_array: Any = array
"""Not generic to mypy."""

_messages = get_typestore(Stores.ROS2_HUMBLE)

NEWEST = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(1))
"""QoS compatible with every publisher: no retransmission, only the newest image."""


def _message(kind: str, fields: dict[str, Any]) -> Any:
    """Return the DDS type of a ROS 2 message, decoded by rosbags.

    Cyclone DDS's decoder converts every byte to a Python number.
    """
    package, _, name = kind.rpartition("/")
    made: Any = make_idl_struct(name, f"{package.replace('/', '::')}::dds_::{name}_", fields)
    made.deserialize = lambda data, *_, **__: _messages.deserialize_cdr(data, kind)
    return annotate.final(annotate.autoid("sequential")(made))


Time = _message("builtin_interfaces/msg/Time", {"sec": int32, "nanosec": uint32})
Header = _message("std_msgs/msg/Header", {"stamp": Time, "frame_id": str})
RegionOfInterest = _message(
    "sensor_msgs/msg/RegionOfInterest",
    {
        **dict.fromkeys(("x_offset", "y_offset", "height", "width"), uint32),
        "do_rectify": bool,
    },
)
Image = _message(
    rosbag.IMAGE,
    {
        "header": Header,
        "height": uint32,
        "width": uint32,
        "encoding": str,
        "is_bigendian": uint8,
        "step": uint32,
        "data": _sequence[uint8],
    },
)
CameraInfo = _message(
    rosbag.CAMERA_INFO,
    {
        "header": Header,
        "height": uint32,
        "width": uint32,
        "distortion_model": str,
        "d": _sequence[float64],
        "k": _array[float64, 9],
        "r": _array[float64, 9],
        "p": _array[float64, 12],
        "binning_x": uint32,
        "binning_y": uint32,
        "roi": RegionOfInterest,
    },
)


class Ros2Camera:
    """Image topic and its camera_info. Implements `driver.DepthCamera`."""

    def __init__(self, topic: str, utc_now_us: Callable[[], int] = utc_us) -> None:
        """Subscribe to depth images, and wait for the camera's description, or raise FieldError."""
        self._utc_now_us, self._silence = utc_now_us, Silence()
        self._participant = _participant()
        # The camera_info topic stands beside the image topic (ROS convention).
        described = rosbag.info_topic(topic)
        about = self._reader(described, CameraInfo)
        info = _next(about, DESCRIBED_S)
        name = f"ros2:{topic}"
        if info is None:
            raise FieldError(
                "camera",
                name,
                problem=f"no sensor_msgs/CameraInfo on {described} for {DESCRIBED_S:g} s"
                f" (ROS_DOMAIN_ID {_domain()})",
            )
        try:
            self.lens = rosbag.lens_of(info, topic)
            """Lens described by the first camera_info."""
        except ValueError as error:
            raise FieldError("camera", name, problem=f"{described}: {error}") from None
        # Subscribed last: no image arrives before the lens is known.
        self._images = self._reader(topic, Image)

    def _reader(self, topic: str, kind: type[Any]) -> DataReader[Any]:
        return DataReader(
            self._participant, Topic(self._participant, f"rt{topic}", kind), qos=NEWEST
        )

    def read(self, timeout_s: float) -> DepthImage | None:
        """Wait for the next image; RuntimeError after 5 s, ValueError without depth."""
        message = _next(self._images, timeout_s)
        if message is None:
            self._silence.lasted(timeout_s)
            return None
        self._silence.broken()
        return DepthImage(rosbag.depth_mm(message), rosbag.age_us(message, self._utc_now_us()))

    def close(self) -> None:
        """Leave the domain by releasing the participant and its readers."""
        del self._images, self._participant


def _next(reader: DataReader[Any], timeout_s: float) -> Any | None:
    try:
        return reader.take_one(timeout=duration(microseconds=round(timeout_s * 1e6)))
    # An exhausted reader and a timeout both mean no sample yet.
    except StopIteration:
        return None
    except DDSException as error:
        if error.code == DDSException.DDS_RETCODE_TIMEOUT:
            return None
        raise


def _domain() -> int:
    """Return ROS_DOMAIN_ID, or raise UsageError if it is invalid."""
    told = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not told.isdecimal() or int(told) > MOST_DOMAIN:
        raise UsageError(f"ROS_DOMAIN_ID {told}: accepted: a whole number from 0 to {MOST_DOMAIN}")
    return int(told)


_restricted: dict[int, Domain] = {}
"""Domains configured for localhost only; Cyclone DDS can configure a domain only once."""


def _participant() -> DomainParticipant:
    number = _domain()
    # An explicit CYCLONEDDS_URI takes precedence over ROS_LOCALHOST_ONLY.
    alone = os.environ.get("ROS_LOCALHOST_ONLY") == "1"
    if alone and "CYCLONEDDS_URI" not in os.environ and number not in _restricted:
        _restricted[number] = Domain(number, HERE_ALONE)
    return DomainParticipant(number)


def open_ros2(which: str, _clock: Clock) -> Ros2Camera:
    """Open a topic, which is absolute. Raises FieldError."""
    if not which.startswith("/"):
        raise FieldError("camera", f"ros2:{which}", "ros2:/TOPIC or rosbag:PATH")
    return Ros2Camera(which)
