"""What a gimbal is told of the vehicle.

Source: PX4 1.16, streams/AUTOPILOT_STATE_FOR_GIMBAL_DEVICE.hpp.
"""

from __future__ import annotations

import math

from firmware_sim.autopilot.autopilot_state import AutopilotState, Landed
from firmware_sim.mavlink.codec import Values, dialect
from firmware_sim.mavlink.streams.status import estimator_status

_ALL = 0
"""Target of a broadcast."""
_NO_DELAY_US = 0


def autopilot_state_for_gimbal_device(state: AutopilotState) -> Values:
    """Attitude, velocity and yaw rate, so that a gimbal can hold its view.

    As PX4, it knows two landed states, and no delays.
    """
    estimate = state.estimate
    landed = state.status.landed is Landed.ON_GROUND
    yaw_rate = state.setpoint.yaw_rate
    return (
        _ALL,
        _ALL,
        estimate.time_us,
        *estimate.quaternion.tolist(),
        _NO_DELAY_US,
        *estimate.velocity.tolist(),
        _NO_DELAY_US,
        0.0 if math.isnan(yaw_rate) else yaw_rate,
        estimator_status(state)[1],
        dialect.MAV_LANDED_STATE_ON_GROUND if landed else dialect.MAV_LANDED_STATE_IN_AIR,
    )
