"""How the ground moves below, by the optical flow sensor.

Source: PX4 1.16, streams/OPTICAL_FLOW_RAD.hpp.
"""

from __future__ import annotations

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.mavlink.codec import Values

NEW_US = 200_000
"""PX4 sends a measurement once. Here it is sent while it is not older than this [µs]."""

_FIRST, _TEMPERATURE, _NO_DISTANCE_US, _NO_DISTANCE_M = 0, 0, 0, -1.0


def optical_flow_rad(state: AutopilotState) -> Values | None:
    """The newest flow and turn [rad]. Nothing where none comes."""
    told = state.flow
    if told is None or state.time_us - state.flow_us > NEW_US:
        return None
    return (
        state.flow_us,
        _FIRST,
        round(told.interval_s * US_PER_S),
        *told.flow.tolist(),
        *told.turned.tolist(),
        _TEMPERATURE,
        told.quality,
        _NO_DISTANCE_US,
        _NO_DISTANCE_M,
    )
