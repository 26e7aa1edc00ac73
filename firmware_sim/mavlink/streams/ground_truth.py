"""HIL_STATE_QUATERNION: the simulator's true state, for those who compare with it.

Sent on request only, as PX4 SITL sends the state of its simulator. Real firmware gets it by the
same function. No flight code reads it. Source: PX4 1.16, streams/HIL_STATE_QUATERNION.hpp.
"""

from __future__ import annotations

from airl_mav.core.frames import HOME, local_to_geodetic
from firmware_sim.interfaces import Truth
from firmware_sim.mavlink.codec import Values
from firmware_sim.mavlink.streams import units

_NO_AIRSPEEDS = (0, 0)
_NO_ACCELERATION = (0, 0, 0)
"""`Truth` has none; PX4 only logs it."""


def hil_state_quaternion(truth: Truth, time_us: int) -> Values:
    """Return attitude (w, x, y, z, body -> NED), rates [rad/s], place and velocity [cm/s].

    Args:
        truth: The true state.
        time_us: Time stamp, of the receiver's clock [µs].
    """
    place = local_to_geodetic(truth.position, HOME)
    return (
        time_us,
        *truth.quaternion.tolist(),
        *truth.angular_velocity.tolist(),
        units.deg_e7(place.latitude_deg),
        units.deg_e7(place.longitude_deg),
        units.mm(place.altitude_m),
        *(units.cm_s(v) for v in truth.velocity.tolist()),
        *_NO_AIRSPEEDS,
        *_NO_ACCELERATION,
    )
