"""SET_GPS_GLOBAL_ORIGIN: where on the globe local NED is zero.

Source: PX4 1.16, MavlinkReceiver::handle_message_set_gps_global_origin and EKF2's bounds. Whoever
is meant, the answer is GPS_GLOBAL_ORIGIN: what the origin is now.
"""

from __future__ import annotations

from airl_mav.core.frames import Geodetic
from firmware_sim.mavlink.codec import WireMessage
from firmware_sim.mavlink.services.context import Context

_LOWEST_M, _HIGHEST_M = -12_000.0, 100_000.0
"""An origin lies between these altitudes above mean sea level [m]."""


def handle_set(message: WireMessage, context: Context) -> bool:
    """Move the origin, where the message is for this vehicle and names a place on the globe."""
    meant: bool = message.target_system == context.system_id
    place = Geodetic(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)
    if meant and _is_on_the_globe(place):
        context.port.set_origin(place)
    context.link.send_stream("GPS_GLOBAL_ORIGIN", context.port.state())
    return meant


def _is_on_the_globe(place: Geodetic) -> bool:
    return (
        abs(place.latitude_deg) <= 90.0
        and abs(place.longitude_deg) <= 180.0
        and _LOWEST_M < place.altitude_m < _HIGHEST_M
    )
