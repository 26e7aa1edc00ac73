"""DISTANCE_SENSOR: a rangefinder that a client reads, for the estimator where it looks down.

Source: PX4 1.16, MavlinkReceiver::handle_message_distance_sensor. The sender's time is not used.
"""

from __future__ import annotations

from firmware_sim.interfaces import DistanceReading
from firmware_sim.mavlink.codec import WireMessage
from firmware_sim.mavlink.services.context import Context

_M = 1e-2
_M2 = 1e-4
_UNKNOWN = -1


def handle(message: WireMessage, context: Context) -> bool:
    """Hand the distance over."""
    context.port.measure_distance(
        DistanceReading(
            message.current_distance * _M,
            message.min_distance * _M,
            message.max_distance * _M,
            message.covariance * _M2,
            quality_of(message.signal_quality),
            message.orientation,
            message.type,
        )
    )
    return True


def quality_of(signal_quality: int) -> int:
    """Return a quality [%] of the field's 1 (invalid) to 100, 0 = not told; -1 = not told.

    More than the field's greatest is taken for that; PX4's byte would overflow.
    """
    return _UNKNOWN if signal_quality == 0 else 100 * (min(signal_quality, 100) - 1) // 99
