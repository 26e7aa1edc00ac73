"""Our numbers in Foxglove's schemas: its own library makes the messages and their bytes.

Foxglove's 3-D panel has z up and x, y level; ours becomes the frame `world`, ENU: x east, y north,
z up. Bodies are FLU: x forward, y left, z up. `core.frames` converts.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from foxglove.messages import Color, Point3, Pose, Quaternion, Timestamp, Vector3
from numpy.typing import NDArray

from airl_mav.black_box.channels import Channel
from airl_mav.core.clock import NS_PER_US
from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import ned_to_enu, quat_ned_frd_to_enu_flu
from airl_mav.view.look import Colour

Floats = NDArray[np.float64]

WORLD, VEHICLE, ESTIMATE, CAMERA = "world", "vehicle", "estimate", "camera"
"""Names of the frames: the arena; the vehicle, truly and as its flight controller believes; the
depth camera, an optical frame (x right, y down, z forward)."""

UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
"""No rotation."""

PROTOBUF = "protobuf"
"""Encoding of the messages."""


_CHANNELS: dict[tuple[str, Any], Channel] = {}


def channel(topic: str, message: Any) -> Channel:
    """Return the channel of a topic with messages such as this one."""
    key = topic, type(message)
    if key not in _CHANNELS:
        schema = message.get_schema()
        data = bytes(schema.data)
        _CHANNELS[key] = Channel(topic, schema.name, schema.encoding, data, PROTOBUF)
    return _CHANNELS[key]


def timestamp(unix_us: int) -> Timestamp:
    """Return a calendar time [µs since 1970]."""
    seconds, rest_us = divmod(unix_us, US_PER_S)
    return Timestamp(seconds, rest_us * NS_PER_US)


def vector(v: Floats) -> Vector3:
    """Return a vector (3,) of any frame."""
    x, y, z = v.tolist()
    return Vector3(x=x, y=y, z=z)


def quaternion(q: Floats) -> Quaternion:
    """Return a rotation (4,) [w, x, y, z] of any frames."""
    w, x, y, z = q.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def place(ned: Floats) -> Vector3:
    """Return a place (3,) NED [m] in `world`."""
    return vector(ned_to_enu(np.asarray(ned, np.float64)))


def attitude(ned_from_frd: Floats) -> Quaternion:
    """Return an attitude (4,) FRD -> NED as FLU -> `world`."""
    return quaternion(quat_ned_frd_to_enu_flu(ned_from_frd))


def pose(ned: Floats, ned_from_frd: Floats = UNTURNED) -> Pose:
    """Return a pose NED [m], FRD -> NED, in `world`."""
    return Pose(position=place(ned), orientation=attitude(ned_from_frd))


def points(ned: Floats) -> list[Point3]:
    """Return places (n, 3) NED [m] in `world`."""
    return [Point3(x=x, y=y, z=z) for x, y, z in ned_to_enu(ned).tolist()]


def colour(rgb: Colour, opacity: float = 1.0) -> Color:
    """Return a colour."""
    red, green, blue = (part / 255.0 for part in rgb)
    return Color(r=red, g=green, b=blue, a=opacity)
