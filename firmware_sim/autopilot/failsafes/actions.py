"""The vocabulary of failsafes: actions, what ends them, who may take over.

Source: PX4 1.16, commander/failsafe/framework.h.
"""

from __future__ import annotations

from enum import Enum, IntEnum, auto
from typing import NamedTuple


class Action(IntEnum):
    """Action of a failsafe. The greatest of several counts."""

    NONE = 0
    WARN = 1
    FALLBACK_POSITION = 2
    """Fall back to Position mode, which a pilot flies."""
    FALLBACK_ALTITUDE = 3
    FALLBACK_STABILIZED = 4
    HOLD = 5
    RETURN = 6
    LAND = 7
    DESCEND = 8
    """Come down level, without knowing where."""
    DISARM = 9
    TERMINATE = 10
    """Stop the motors for good: only a restart ends it."""


class Clear(Enum):
    """When an action ends after what caused it is over."""

    WITH_CONDITION = auto()
    """At once."""
    ON_MODE_CHANGE = auto()
    """When the user chooses a mode, or at disarming."""
    NEVER = auto()


class Takeover(IntEnum):
    """Who may end an action by flying on. The strictest of several counts."""

    ALWAYS = 0
    MODE_SWITCH = 1
    """By choosing a mode, not with the sticks."""
    AUTO = 2
    """As ALWAYS after COM_FAIL_ACT_T in Hold; MODE_SWITCH where that time is zero."""
    NEVER = 3


class Cause(Enum):
    """Cause, as texts name it."""

    GENERIC = auto()
    MANUAL_CONTROL_LOSS = auto()
    GCS_LOSS = auto()
    BATTERY_LOW = auto()
    BATTERY_CRITICAL = auto()
    BATTERY_EMERGENCY = auto()
    FLIGHT_TIME_LOW = auto()


class Options(NamedTuple):
    """One failsafe's answer to its condition."""

    action: Action
    clear: Clear = Clear.WITH_CONDITION
    takeover: Takeover = Takeover.AUTO
    cause: Cause = Cause.GENERIC
