"""Event definitions with texts, and events in wire format.

Source: https://mavlink.io/en/services/events.html, and PX4 1.16,
platforms/common/include/px4_platform_common/events.h.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from enum import IntEnum, IntFlag
from functools import partial
from typing import NamedTuple


class ModeGroup(IntEnum):
    """Flight modes affected by a check, as bits: 1 << PX4's navigation state."""

    MANUAL = 1 << 0
    ALTCTL = 1 << 1
    POSCTL = 1 << 2
    MISSION = 1 << 3
    LOITER = 1 << 4
    RTL = 1 << 5
    ACRO = 1 << 10
    OFFBOARD = 1 << 14
    STAB = 1 << 15
    TAKEOFF = 1 << 17
    LAND = 1 << 18
    FOLLOW_TARGET = 1 << 19
    PRECLAND = 1 << 20
    ORBIT = 1 << 21
    VTOL_TAKEOFF = 1 << 22


Component = IntFlag(
    "Component",
    "NONE ABSOLUTE_PRESSURE DIFFERENTIAL_PRESSURE GPS OPTICAL_FLOW VISION_POSITION "
    "DISTANCE_SENSOR REMOTE_CONTROL MOTORS_ESCS UTM LOGGING BATTERY COMMUNICATION_LINKS "
    "RATE_CONTROLLER ATTITUDE_CONTROLLER POSITION_CONTROLLER ATTITUDE_ESTIMATE "
    "LOCAL_POSITION_ESTIMATE MISSION AVOIDANCE SYSTEM CAMERA GIMBAL PAYLOAD "
    "GLOBAL_POSITION_ESTIMATE STORAGE PARACHUTE MAGNETOMETER ACCEL GYRO OPEN_DRONE_ID",
)
"""Components of the vehicle; the argument of a check is the index of the bit."""

ArmingReason = IntEnum(
    "ArmingReason",
    "TRANSITION_TO_STANDBY STICK_GESTURE RC_SWITCH COMMAND_INTERNAL COMMAND_EXTERNAL "
    "MISSION_START AUTO_DISARM_LAND AUTO_DISARM_PREFLIGHT KILL_SWITCH LOCKDOWN "
    "FAILURE_DETECTOR SHUTDOWN UNIT_TEST RC_BUTTON FAILSAFE",
    start=0,
)
"""Reason of arming or disarming."""


class NavigationMode(IntEnum):
    """Flight modes in texts."""

    MANUAL = 0
    ALTCTL = 1
    POSCTL = 2
    AUTO_MISSION = 3
    AUTO_LOITER = 4
    AUTO_RTL = 5
    ACRO = 6
    OFFBOARD = 7
    STAB = 8
    POSITION_SLOW = 9
    AUTO_TAKEOFF = 10
    AUTO_LAND = 11
    AUTO_FOLLOW_TARGET = 12
    AUTO_PRECLAND = 13
    ORBIT = 14
    AUTO_VTOL_TAKEOFF = 15
    EXTERNAL1 = 16
    EXTERNAL2 = 17
    EXTERNAL3 = 18
    EXTERNAL4 = 19
    EXTERNAL5 = 20
    EXTERNAL6 = 21
    EXTERNAL7 = 22
    EXTERNAL8 = 23
    UNKNOWN = 255


class FailsafeAction(IntEnum):
    """Action of a failsafe. The highest of several takes effect."""

    NONE = 0
    WARN = 1
    FALLBACK_POSCTRL = 2
    """Fall back to Position mode, flown by the pilot."""
    FALLBACK_ALTCTRL = 3
    FALLBACK_STABILIZED = 4
    HOLD = 5
    RTL = 6
    LAND = 7
    DESCEND = 8
    """Descend level without a position estimate."""
    DISARM = 9
    TERMINATE = 10
    """Stop the motors permanently: only a restart ends it."""


SensorType = IntEnum("SensorType", "ACCEL GYRO MAG", start=0)
"""Inertial sensors in texts."""


SensorFailure = IntFlag(
    "SensorFailure", "NO_DATA STALE_DATA TIMEOUT HIGH_ERROR_COUNT HIGH_ERROR_DENSITY"
)
"""Reasons of a sensor failure, as bits."""


FailsafeCause = IntEnum(
    "FailsafeCause",
    "GENERIC MANUAL_CONTROL_LOSS GCS_CONNECTION_LOSS LOW_BATTERY_LEVEL CRITICAL_BATTERY_LEVEL "
    "EMERGENCY_BATTERY_LEVEL LOW_REMAINING_FLIGHT_TIME",
    start=0,
)
"""Cause of a failsafe, named in texts."""


class Enumeration(NamedTuple):
    """Enumeration of the event metadata."""

    base: str
    """Type on the wire."""
    members: type[IntEnum] | type[IntFlag]
    meaning: str
    bitfield: bool = False


ENUMERATIONS: Mapping[str, Enumeration] = {
    "navigation_mode_group_t": Enumeration("uint32_t", ModeGroup, "Flight modes", bitfield=True),
    "health_component_t": Enumeration("uint32_t", Component, "Parts of the vehicle", bitfield=True),
    "sensor_type_t": Enumeration("uint8_t", SensorType, "Sensors"),
    "sensor_failover_reason_t": Enumeration(
        "uint16_t", SensorFailure, "Why a sensor has failed", bitfield=True
    ),
    "arm_disarm_reason_t": Enumeration("uint8_t", ArmingReason, "Why it was armed or disarmed"),
    "navigation_mode_t": Enumeration("uint8_t", NavigationMode, "Flight mode"),
    "failsafe_action_t": Enumeration("uint8_t", FailsafeAction, "What a failsafe does"),
    "failsafe_cause_t": Enumeration("uint8_t", FailsafeCause, "Why a failsafe acts"),
}

_WORDS: Mapping[str, str] = {
    "ACCEL": "Accelerometer",
    "ALTCTL": "Altitude",
    "AUTO_DISARM_LAND": "landing",
    "AUTO_DISARM_PREFLIGHT": "auto preflight disarming",
    "AUTO_FOLLOW_TARGET": "Follow Target",
    "AUTO_LAND": "Land",
    "AUTO_LOITER": "Hold",
    "AUTO_MISSION": "Mission",
    "AUTO_PRECLAND": "Precision Landing",
    "AUTO_RTL": "Return",
    "AUTO_TAKEOFF": "Takeoff",
    "AUTO_VTOL_TAKEOFF": "VTOL Takeoff",
    "COMMAND_EXTERNAL": "external command",
    "COMMAND_INTERNAL": "internal command",
    "DISARM": "disarming",
    "FAILSAFE": "failsafe",
    "FALLBACK_ALTCTRL": "Altitude mode",
    "FALLBACK_POSCTRL": "Position mode",
    "FALLBACK_STABILIZED": "Stabilized mode",
    "GCS_CONNECTION_LOSS": "GCS connection loss",
    "GPS": "GPS",
    "GYRO": "Gyroscope",
    "LOCKDOWN": "lockdown",
    "LOITER": "Hold",
    "MAG": "Magnetometer",
    "MOTORS_ESCS": "Motors and ESCs",
    "POSCTL": "Position",
    "PRECLAND": "Precision land",
    "RTL": "Return",
    "STAB": "Stabilized",
    "TERMINATE": "termination",
    "UTM": "UTM",
    "VTOL_TAKEOFF": "VTOL takeoff",
    "WARN": "warning",
    **{f"EXTERNAL{n}": f"External {n}" for n in range(1, 9)},
}
"""Texts that differ from the member's name."""


def words(member: IntEnum | IntFlag) -> str:
    """Return the operator text of an enumeration member."""
    name = member.name or ""
    return _WORDS.get(name, name.replace("_", " ").capitalize())


_AUTOPILOT = 1
"""Component id in the most significant byte of an event's id."""
_FNV_BASIS, _FNV_PRIME = 0x811C9DC5, 0x01000193
"""Constants of the 32-bit FNV-1a hash (http://www.isthe.com/chongo/tech/comp/fnv/)."""

_FLOAT_MAX = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]

FORMATS = {
    "uint8_t": "B",
    "int8_t": "b",
    "uint16_t": "H",
    "int16_t": "h",
    "uint32_t": "I",
    "int32_t": "i",
    "uint64_t": "Q",
    "int64_t": "q",
    "float": "f",
}
"""Argument types and their `struct` formats."""


Level = IntEnum(
    "Level",
    "EMERGENCY ALERT CRITICAL ERROR WARNING NOTICE INFO DEBUG PROTOCOL DISABLED",
    start=0,
)
"""Severity of an event, to DEBUG as in MAV_SEVERITY. PROTOCOL: internal use of ground stations."""


class Argument(NamedTuple):
    """Argument of an event definition."""

    kind: str
    """Key of `FORMATS` or `ENUMERATIONS`."""
    name: str


class MavlinkEvent(NamedTuple):
    """Event instance in wire format."""

    number: int
    """MAVLink event id: component and hash of the name."""
    levels: int
    """Internal level << 4 | external level."""
    arguments: bytes


class Definition(NamedTuple):
    """Definition of an event type."""

    name: str
    message: str
    """`{1}` is the first argument; `{1:.1m}` has one decimal and a unit."""
    arguments: tuple[Argument, ...] = ()
    level: Level = Level.INFO
    internal: Level | None = None
    """Level in PX4's log; None = same as `level`."""
    description: str = ""
    group: str = "default"
    kind: str = ""
    """Handling by ground stations beyond display; "" = none."""

    @property
    def number(self) -> int:
        """MAVLink id of the event."""
        return _AUTOPILOT << 24 | sub_id(self.name)

    def of_release(self, change: Mapping[str, str]) -> Definition:
        """Return the definition of a PX4 release, with its changed name, message or level."""
        name, message = (change.get(key, getattr(self, key)) for key in ("name", "message"))
        level = Level[change["level"]] if "level" in change else self.level
        return self._replace(name=name, message=message, level=level)

    def event(self, *values: float, level: Level | None = None) -> MavlinkEvent:
        """Return an event of this type; `level` overrides its levels.

        Values outside the range of an argument are clipped, so that a home 3e38 m high causes no
        error. Raises struct.error if the number of values differs from the number of arguments.
        """
        external = self.level if level is None else level
        internal = external if self.internal is None or level is not None else self.internal
        formats = [_format(argument.kind) for argument in self.arguments]
        fitted = [_fitted(value, of) for value, of in zip(values, formats, strict=False)]
        packed = struct.pack("<" + "".join(formats), *fitted, *values[len(formats) :])
        return MavlinkEvent(self.number, internal << 4 | external, packed)


def sub_id(name: str) -> int:
    """Return the name-dependent part of an event id: 24 bits of FNV-1a."""
    value = _FNV_BASIS
    for byte in name.encode("ascii"):
        value = (value ^ byte) * _FNV_PRIME & 0xFFFFFFFF
    return value & 0xFFFFFF


def arguments(listed: str) -> tuple[Argument, ...]:
    """Return the arguments of a "type name, type name" list."""
    return tuple(Argument(*text.split()) for text in listed.split(", ") if text)


def define(
    name: str,
    message: str,
    listed: str = "",
    level: Level = Level.INFO,
    internal: Level | None = None,
    description: str = "",
    kind: str = "",
) -> Definition:
    """Return a definition with the arguments of a "type name, type name" list."""
    return Definition(
        name, message, arguments(listed), level, internal, description=description, kind=kind
    )


wrong = partial(define, level=Level.ERROR)
critical = partial(define, level=Level.CRITICAL, internal=Level.INFO)
error = partial(define, level=Level.ERROR, internal=Level.INFO)
warning = partial(define, level=Level.WARNING, internal=Level.INFO)


def _fitted(value: float, of: str) -> float:
    """Return a value clipped to a field of a `struct` format; NaN becomes 0 in integer fields."""
    if of == "f":
        # As a cast in C: infinite beyond its range.
        return math.copysign(math.inf, value) if abs(value) > _FLOAT_MAX else value
    bits = 8 * struct.calcsize(of)
    low, high = (0, 2**bits - 1) if of.isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return 0 if value != value else int(min(high, max(low, value)))


def _format(kind: str) -> str:
    return FORMATS[ENUMERATIONS[kind].base if kind in ENUMERATIONS else kind]
