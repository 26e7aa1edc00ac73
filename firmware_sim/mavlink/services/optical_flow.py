"""OPTICAL_FLOW_RAD: an optical flow sensor that a client reads, for the estimator.

Source: PX4 1.16, MavlinkReceiver::handle_message_optical_flow_rad. The sender's time, its distance
and its temperature are not used.
"""

from __future__ import annotations

import numpy as np

from airl_mav.core.constants import US_PER_S
from firmware_sim.interfaces import FlowReading
from firmware_sim.mavlink.codec import WireMessage
from firmware_sim.mavlink.services.context import Context


def handle(message: WireMessage, context: Context) -> bool:
    """Hand the flow over."""
    turned = (message.integrated_xgyro, message.integrated_ygyro, message.integrated_zgyro)
    context.port.look_down(
        FlowReading(
            np.array([message.integrated_x, message.integrated_y]),
            message.integration_time_us / US_PER_S,
            message.quality,
            np.array(turned),
        )
    )
    return True
