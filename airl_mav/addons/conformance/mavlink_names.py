"""Numbers of MAVLink's common dialect, and their names in the transcript."""

from __future__ import annotations

from enum import IntEnum


class MavCommand(IntEnum):
    """MAV_CMD."""

    NAV_WAYPOINT = 16
    NAV_RETURN_TO_LAUNCH = 20
    NAV_LAND = 21
    NAV_TAKEOFF = 22
    DO_SET_MODE = 176
    COMPONENT_ARM_DISARM = 400
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512
    REQUEST_AUTOPILOT_CAPABILITIES = 520


MavResult = IntEnum(
    "MavResult",
    "ACCEPTED TEMPORARILY_REJECTED DENIED UNSUPPORTED FAILED IN_PROGRESS CANCELLED",
    start=0,
)
LandedState = IntEnum("LandedState", "UNDEFINED ON_GROUND IN_AIR TAKEOFF LANDING", start=0)


class MavFrame(IntEnum):
    """MAV_FRAME values valid in SET_POSITION_TARGET_LOCAL_NED."""

    LOCAL_NED = 1
    LOCAL_OFFSET_NED = 7
    BODY_NED = 8
    BODY_OFFSET_NED = 9
    BODY_FRD = 12


UNKNOWN_COMMAND = 29_999  # Undefined in all dialects
VEHICLE_TYPES = {
    2: "quadrotor", 3: "coaxial", 4: "helicopter", 13: "hexarotor", 14: "octorotor", 15: "tricopter"
}  # fmt: skip

ARMED_FLAG = 128  # MAV_MODE_FLAG_SAFETY_ARMED
CUSTOM_MODE_FLAG = 1  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
PREARM_CHECK = 0x1000_0000  # MAV_SYS_STATUS_PREARM_CHECK: the vehicle may be armed


def command_long(number: int, *params: float) -> dict[str, float]:
    """Return the fields of a COMMAND_LONG; missing parameters are 0."""
    padded = (*params, *[0.0] * 7)[:7]
    numbered = {f"param{index}": value for index, value in enumerate(padded, 1)}
    return {"command": int(number), "confirmation": 0, **numbered}


def name_of(kind: type[IntEnum], number: int) -> str:
    """Return the name of a number, or the number itself without a name."""
    try:
        return kind(number).name
    except ValueError:
        return str(number)


def version_name(flight_sw_version: int) -> str:
    """Return AUTOPILOT_VERSION.flight_sw_version as 1.16.0 alpha; its last byte is the stage."""
    major, minor, patch, stage = flight_sw_version.to_bytes(4, "big")
    stages = ((255, ""), (192, " rc"), (128, " beta"), (64, " alpha"), (0, " dev"))
    return f"{major}.{minor}.{patch}" + next(name for least, name in stages if stage >= least)
