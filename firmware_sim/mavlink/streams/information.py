"""Flight times, return time, protocol version, and PX4's modes (names and numbers).

Source: PX4 src/lib/modes, src/modules/mavlink/streams/{AVAILABLE_MODES,CURRENT_MODE}.hpp, and the
messages of a running PX4 1.16.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from airl_mav.core.frames import geodetic_to_local
from firmware_sim.autopilot.autopilot_state import AutopilotState, Landed
from firmware_sim.autopilot.flight_modes import BY_CUSTOM_MODE, ModeSpec
from firmware_sim.autopilot.modes.return_to_launch import return_time_s
from firmware_sim.mavlink.codec import Values, dialect
from firmware_sim.mavlink.streams.units import boot_ms

_VERSION, _LEAST_VERSION, _GREATEST_VERSION = 200, 100, 200
"""Sent, minimum and maximum version: MAVLink 2.0 is sent, 1.0 is accepted, as in PX4."""

_NO_HASH = (0,) * 8


def flight_information(state: AutopilotState) -> Values:
    """Return the times of arming and takeoff [µs since boot]; 0 while disarmed."""
    flight_uuid = landing_time = 0
    armed, took_off = state.armed_us, state.takeoff_us
    return boot_ms(state.time_us), armed, took_off, flight_uuid, landing_time


def protocol_version(state: AutopilotState) -> Values:  # noqa: ARG001 - a builder
    """Return the supported MAVLink versions."""
    return _VERSION, _LEAST_VERSION, _GREATEST_VERSION, *_NO_HASH, *_NO_HASH


_UNKNOWN_TIME = -1
"""Value of unknown times: PX4 estimates only the return time."""


def time_estimate_to_target(state: AutopilotState, value: Callable[[str], float]) -> Values | None:
    """Return the duration of a safe return [s]; 0 on the ground, None without home.

    `value` returns the current value of a PX4 parameter by name.
    """
    home, origin = state.home, state.origin
    if home is None or origin is None:
        return None
    took = 0.0
    # On the ground the return takes no time.
    if state.status.landed is not Landed.ON_GROUND:
        target = geodetic_to_local(home, origin).tolist()
        north, east, down = (
            b - a for a, b in zip(target, state.estimate.position.tolist(), strict=True)
        )
        took = return_time_s(value, -down, math.hypot(north, east))
    unknown = (_UNKNOWN_TIME,) * 4
    return int(took) if math.isfinite(took) else _UNKNOWN_TIME, *unknown


AVAILABLE = tuple(sorted(BY_CUSTOM_MODE.values(), key=lambda mode: mode.spec.state))
"""Modes as clients distinguish them, in the order of AVAILABLE_MODES."""


def available_modes() -> list[tuple[int, int, int, int, int, bytes]]:
    """Return the fields of AVAILABLE_MODES for each mode, in order."""
    # The count and the number of each mode, starting at 1, in every message.
    return [
        (len(AVAILABLE), number, spec.standard, spec.custom_mode, _properties(spec), name)
        for number, spec in enumerate((mode.spec for mode in AVAILABLE), start=1)
        # A standard mode implies its name.
        for name in (b"" if spec.standard else spec.title.encode("ascii"),)
    ]


def _properties(spec: ModeSpec) -> int:
    """Return the bits of MAV_MODE_PROPERTY."""
    advanced: int = dialect.MAV_MODE_PROPERTY_ADVANCED if spec.advanced else 0
    hidden: int = 0 if spec.requestable else dialect.MAV_MODE_PROPERTY_NOT_USER_SELECTABLE
    return advanced | hidden


def current_mode(state: AutopilotState) -> Values:
    """Return the active mode and the mode requested by the user."""
    active, intended = state.status.mode.spec, state.status.intended_mode.spec
    return intended.standard, active.custom_mode, intended.custom_mode
