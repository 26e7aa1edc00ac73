"""OBSTACLE_DISTANCE for the flight controller's collision prevention.

Made of the newest depth image around the camera's height, level at any tilt. Directions without a
return within range are free, those beside the field of view unknown.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector, quats_to_euler
from airl_mav.policy.observation import Kinematics
from airl_mav.policy.scans import NEAREST_M, level_scan, rays_of, tilt_of
from companion.camera import FrameSource
from companion.periodic import every
from companion.presence import Sender

MESSAGE = "OBSTACLE_DISTANCE"

PERIOD_US = US_PER_S // 10
"""Time between two messages [µs]; PX4 forgets distances after 0.5 s."""

OLDEST_US = US_PER_S // 4
"""An older image says nothing [µs]."""

BINS = 72
BIN_RAD = math.radians(5.0)
"""Least width of a bin: that of PX4's map."""

UNKNOWN_CM = 65_535

SENSOR_TYPE_UNKNOWN, FRAME_BODY_FRD = 4, 12
"""MAV_DISTANCE_SENSOR and MAV_FRAME (common.xml)."""


class Vehicle(Sender, Protocol):
    """Attitude of the vehicle, and a way to send messages; `MavsdkLink` is one."""

    def kinematics(self) -> Kinematics:
        """Return the newest position, velocity and attitude."""
        ...


def obstacle_distance(
    depth_mm: NDArray[np.uint16],
    camera: Intrinsics,
    range_m: float,
    quaternion: Vector,
    pitch_up_rad: float,
    now_us: int,
) -> dict[str, Any]:
    """Return the fields of the message.

    `depth_mm` (h, w) is a depth image, 0 = no return, up to `range_m` [m]. `quaternion` (4,) is the
    vehicle's attitude, body to NED, `pitch_up_rad` that of the mount, `now_us` the time since the
    start.
    """
    fov_rad = camera.horizontal_fov_rad
    count = min(BINS, max(1, int(fov_rad / BIN_RAD + 1e-6)))
    width_deg = math.degrees(fov_rad) / count
    roll, pitch, _ = quats_to_euler(quaternion[None])
    tilt = tilt_of(roll, pitch + pitch_up_rad)
    (ranges,) = level_scan(depth_mm[None], rays_of(camera), tilt, count)
    free_cm = round(100.0 * range_m) + 1
    told = [free_cm if r > range_m else round(100.0 * max(r, NEAREST_M)) for r in ranges.tolist()]
    return {
        "time_usec": now_us,
        "sensor_type": SENSOR_TYPE_UNKNOWN,
        "distances": told + [UNKNOWN_CM] * (BINS - count),
        "increment": round(width_deg),
        "min_distance": round(100.0 * NEAREST_M),
        "max_distance": free_cm - 1,
        "increment_f": width_deg,
        "angle_offset": 0.5 * (width_deg - math.degrees(fov_rad)),
        "frame": FRAME_BODY_FRD,
    }


def obstacles_told(
    link: Vehicle, frames: FrameSource, range_m: float, pitch_up_rad: float, clock: Clock
) -> AbstractContextManager[None]:
    """Send the message of a depth camera from a thread while the context lasts."""

    def tell() -> None:
        received, now_us = frames.latest(), clock.time_us()
        if received is None or now_us - received.received_us > OLDEST_US:
            return
        frame, attitude = received.frame, link.kinematics().quaternion
        if frame.intrinsics.kind != "depth" or not np.isfinite(attitude).all():
            return
        fields = obstacle_distance(
            frame.image, frame.intrinsics, range_m, attitude, pitch_up_rad, now_us
        )
        link.send_message(MESSAGE, fields)

    return every(PERIOD_US, tell, clock, "obstacles")
