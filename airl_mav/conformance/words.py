"""Names of numbers in MAVLink's common dialect, for the transcript."""

from __future__ import annotations

COMPONENT_ARM_DISARM = 400
DO_SET_MODE = 176
REQUEST_MESSAGE = 512
SET_MESSAGE_INTERVAL = 511
UNKNOWN_COMMAND = 29_999
"""A number that no dialect gives a meaning."""

COMMANDS = {
    16: "NAV_WAYPOINT",
    20: "NAV_RETURN_TO_LAUNCH",
    21: "NAV_LAND",
    22: "NAV_TAKEOFF",
    DO_SET_MODE: "DO_SET_MODE",
    COMPONENT_ARM_DISARM: "COMPONENT_ARM_DISARM",
    SET_MESSAGE_INTERVAL: "SET_MESSAGE_INTERVAL",
    REQUEST_MESSAGE: "REQUEST_MESSAGE",
    520: "REQUEST_AUTOPILOT_CAPABILITIES",
}

RESULTS = (
    "ACCEPTED",
    "TEMPORARILY_REJECTED",
    "DENIED",
    "UNSUPPORTED",
    "FAILED",
    "IN_PROGRESS",
    "CANCELLED",
)
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)

LANDED = ("UNDEFINED", "ON_GROUND", "IN_AIR", "TAKEOFF", "LANDING")
ON_GROUND, IN_AIR, TAKEOFF, LANDING = 1, 2, 3, 4

VEHICLES = {0: "generic", 1: "fixed wing", 2: "quadrotor", 3: "coaxial", 4: "helicopter"} | {
    13: "hexarotor",
    14: "octorotor",
    15: "tricopter",
    29: "dodecarotor",
    35: "decarotor",
}

LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED, BODY_FRD = 1, 7, 8, 9, 12
FRAMES = {
    LOCAL_NED: "LOCAL_NED",
    LOCAL_OFFSET_NED: "LOCAL_OFFSET_NED",
    BODY_NED: "BODY_NED",
    BODY_OFFSET_NED: "BODY_OFFSET_NED",
    BODY_FRD: "BODY_FRD",
}

ARMED_FLAG = 128
"""MAV_MODE_FLAG_SAFETY_ARMED."""

CUSTOM_MODE_FLAG = 1
"""MAV_MODE_FLAG_CUSTOM_MODE_ENABLED."""

PREARM_CHECK = 0x1000_0000
"""MAV_SYS_STATUS_PREARM_CHECK: may be armed."""


def command_name(number: int) -> str:
    """Return a command's name without its MAV_CMD, or its number."""
    return COMMANDS.get(number, f"command {number}")


def result_name(number: int) -> str:
    """Return a MAV_RESULT's name."""
    return RESULTS[number] if 0 <= number < len(RESULTS) else f"result {number}"


def landed_name(number: int) -> str:
    """Return a MAV_LANDED_STATE's name."""
    return LANDED[number] if 0 <= number < len(LANDED) else f"landed_state {number}"


def version_name(flight_sw_version: int) -> str:
    """Return AUTOPILOT_VERSION's flight_sw_version as people write it; its last byte is a stage."""
    major, minor, patch, stage = flight_sw_version.to_bytes(4, "big")
    stages = ((255, ""), (192, " rc"), (128, " beta"), (64, " alpha"), (0, " dev"))
    return f"{major}.{minor}.{patch}" + next(word for least, word in stages if stage >= least)
