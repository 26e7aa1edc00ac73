"""Enumerations of failsafes: actions, end conditions, pilot takeover, causes.

Source: PX4 1.16, commander/failsafe/framework.h.
"""

from __future__ import annotations

from enum import Enum, IntEnum, auto
from typing import NamedTuple


class FailsafeAction(IntEnum):
    """Action of a failsafe. The highest of several takes effect."""

    NONE = 0
    WARN = 1
    FALLBACK_POSITION = 2
    """Fall back to Position mode, flown by the pilot."""
    FALLBACK_ALTITUDE = 3
    FALLBACK_STABILIZED = 4
    HOLD = 5
    RETURN = 6
    LAND = 7
    DESCEND = 8
    """Descend level without a position estimate."""
    DISARM = 9
    TERMINATE = 10
    """Stop the motors permanently: only a restart ends it."""


class Clear(Enum):
    """End of an action after its condition has cleared."""

    WITH_CONDITION = auto()
    """Immediately."""
    ON_MODE_CHANGE = auto()
    """Upon a mode selection by the user, or at disarming."""
    NEVER = auto()


class Takeover(IntEnum):
    """Rule for pilot takeover during an action. The strictest of several takes effect."""

    ALWAYS = 0
    MODE_SWITCH = 1
    """Takeover by mode selection, not by sticks."""
    AUTO = 2
    """Like ALWAYS after COM_FAIL_ACT_T in Hold; like MODE_SWITCH if that time is zero."""
    NEVER = 3


class FailsafeReason(Enum):
    """Cause in operator texts."""

    GENERIC = auto()
    MANUAL_CONTROL_LOSS = auto()
    GCS_LOSS = auto()
    BATTERY_LOW = auto()
    BATTERY_CRITICAL = auto()
    BATTERY_EMERGENCY = auto()
    FLIGHT_TIME_LOW = auto()


class Options(NamedTuple):
    """Response of a failsafe to its condition."""

    action: FailsafeAction
    clear: Clear = Clear.WITH_CONDITION
    takeover: Takeover = Takeover.AUTO
    cause: FailsafeReason = FailsafeReason.GENERIC
