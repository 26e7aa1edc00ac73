"""What is sent when it is asked for: the flight so far, and the protocol's version."""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.mavlink.codec import Values
from firmware_sim.mavlink.streams.units import boot_ms

_VERSION, _LEAST_VERSION, _GREATEST_VERSION = 200, 100, 200
"""MAVLink 2.0 is spoken, 1.0 is understood, as PX4 says."""

_NO_HASH = (0,) * 8


def flight_information(state: AutopilotState) -> Values:
    """When it was armed and took off [µs since boot], 0 while it is not."""
    flight_uuid = landing_time = 0
    armed, took_off = state.armed_us, state.takeoff_us
    return boot_ms(state.time_us), armed, took_off, flight_uuid, landing_time


def protocol_version(state: AutopilotState) -> Values:  # noqa: ARG001 - a builder
    """The MAVLink versions that are spoken."""
    return _VERSION, _LEAST_VERSION, _GREATEST_VERSION, *_NO_HASH, *_NO_HASH
