"""The flight so far and the way home; the protocol's version on request."""

from __future__ import annotations

import math
from collections.abc import Callable

from airl_mav.core.frames import geodetic_to_local
from firmware_sim.autopilot.autopilot_state import AutopilotState, Landed
from firmware_sim.autopilot.navigation.return_path import return_time_s
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


_UNKNOWN_TIME = -1
"""PX4 estimates nothing but the way home."""


def time_estimate_to_target(state: AutopilotState, value: Callable[[str], float]) -> Values | None:
    """How long a safe way home takes [s]; 0 on the ground. Nothing before home is known.

    `value` looks up a PX4 parameter, as it is flown, by its name.
    """
    home, origin = state.home, state.origin
    if home is None or origin is None:
        return None
    took = 0.0
    if state.status.landed is not Landed.ON_GROUND:
        target = geodetic_to_local(home, origin).tolist()
        north, east, down = (
            b - a for a, b in zip(target, state.estimate.position.tolist(), strict=True)
        )
        took = return_time_s(value, -down, math.hypot(north, east))
    unknown = (_UNKNOWN_TIME,) * 4
    return int(took) if math.isfinite(took) else _UNKNOWN_TIME, *unknown
