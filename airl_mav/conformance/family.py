"""What PX4 and ArduPilot do differently on the wire.

Measured on PX4 1.16 and ArduCopter 4.7 SITL; docs/conformance.md has the table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from airl_mav.conformance.words import (
    ACCEPTED,
    BODY_FRD,
    BODY_NED,
    BODY_OFFSET_NED,
    FAILED,
    LOCAL_NED,
    LOCAL_OFFSET_NED,
    TEMPORARILY_REJECTED,
)


class Reaction(Enum):
    """What becomes of a setpoint."""

    FLOWN = "flown"
    REFUSED = "refused"
    """With a STATUSTEXT for every message; it does not count as a setpoint."""
    IGNORED = "ignored"
    """Without a word."""


@dataclass(frozen=True)
class Answer:
    """A MAV_RESULT, and what STATUSTEXT says with it; "" for nothing in particular."""

    result: int
    text: str = ""


@dataclass(frozen=True)
class Loss:
    """What happens when setpoints stop and heartbeats go on; times from the last setpoint [s]."""

    starts_s: tuple[float, float]
    """Earliest and latest time at which it reacts."""
    text: str
    """What STATUSTEXT says then; "": nothing, it is seen by the speed."""
    mode: int
    """custom_mode while it lasts."""
    descends: bool
    """Whether it comes down, level, and only drag slows it; otherwise it brakes and stands."""


@dataclass(frozen=True)
class Family:
    """One autopilot's ways."""

    title: str
    offboard: tuple[int, int]
    """Parameters 2 and 3 of DO_SET_MODE for flight by setpoints."""
    hold: tuple[int, int]
    offboard_mode: int
    """HEARTBEAT.custom_mode of flight by setpoints."""
    hold_modes: tuple[int, ...]
    """custom_mode after MAVSDK's offboard.stop()."""
    land_mode: int
    after_takeoff_mode: int
    modes: Mapping[int, str]
    offboard_on_ground: Answer
    """Asked for flight by setpoints on the ground, without any."""
    arms_without_setpoint: bool
    """Whether it can be armed then."""
    offboard_in_air: Answer
    disarm_in_air: Answer
    unknown_mode: Answer
    frames: Mapping[int, Reaction]
    ignore_all: Reaction
    """A type mask that ignores everything."""
    loss: Loss


def _px4_mode(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


_PX4_HOLD, _PX4_OFFBOARD, _PX4_POSITION = _px4_mode(4, 3), _px4_mode(6), _px4_mode(3)

PX4 = Family(
    title="PX4",
    offboard=(6, 0),
    hold=(4, 3),
    offboard_mode=_PX4_OFFBOARD,
    hold_modes=(_PX4_HOLD,),
    land_mode=_px4_mode(4, 6),
    after_takeoff_mode=_PX4_HOLD,
    modes={
        _px4_mode(1): "MANUAL",
        _px4_mode(2): "ALTCTL",
        _PX4_POSITION: "POSCTL",
        _px4_mode(4, 2): "TAKEOFF",
        _PX4_HOLD: "HOLD",
        _px4_mode(4, 4): "MISSION",
        _px4_mode(4, 5): "RTL",
        _px4_mode(4, 6): "LAND",
        _PX4_OFFBOARD: "OFFBOARD",
        _px4_mode(7): "STABILIZED",
    },
    offboard_on_ground=Answer(ACCEPTED),
    arms_without_setpoint=False,
    offboard_in_air=Answer(
        TEMPORARILY_REJECTED, "Switching to Offboard is currently not available"
    ),
    disarm_in_air=Answer(TEMPORARILY_REJECTED, "Disarming denied"),
    unknown_mode=Answer(ACCEPTED),
    frames={
        LOCAL_NED: Reaction.FLOWN,
        LOCAL_OFFSET_NED: Reaction.REFUSED,
        BODY_NED: Reaction.FLOWN,
        BODY_OFFSET_NED: Reaction.REFUSED,
        BODY_FRD: Reaction.REFUSED,
    },
    ignore_all=Reaction.REFUSED,
    # COM_OF_LOSS_T = 1 s; 1.06 to 1.13 s measured.
    loss=Loss((1.0, 1.5), "Failsafe activated", _PX4_POSITION, descends=True),
)

_GUIDED, _BRAKE, _LOITER = 4, 17, 5

ARDUPILOT = Family(
    title="ArduPilot",
    offboard=(_GUIDED, 0),
    hold=(_BRAKE, 0),
    offboard_mode=_GUIDED,
    hold_modes=(_BRAKE, _LOITER),
    land_mode=9,
    after_takeoff_mode=_GUIDED,
    modes={
        0: "STABILIZE",
        2: "ALT_HOLD",
        3: "AUTO",
        _GUIDED: "GUIDED",
        _LOITER: "LOITER",
        6: "RTL",
        9: "LAND",
        16: "POSHOLD",
        _BRAKE: "BRAKE",
    },
    offboard_on_ground=Answer(ACCEPTED),
    arms_without_setpoint=True,
    offboard_in_air=Answer(ACCEPTED),
    disarm_in_air=Answer(FAILED),
    unknown_mode=Answer(FAILED, "No such mode"),
    frames={
        LOCAL_NED: Reaction.FLOWN,
        LOCAL_OFFSET_NED: Reaction.FLOWN,
        BODY_NED: Reaction.FLOWN,
        BODY_OFFSET_NED: Reaction.FLOWN,
        BODY_FRD: Reaction.IGNORED,
    },
    ignore_all=Reaction.IGNORED,
    # GUID_TIMEOUT = 3 s; it began to brake after 3.05 s.
    loss=Loss((2.9, 3.6), "", _GUIDED, descends=False),
)

FAMILIES: Mapping[int, Family] = {12: PX4, 3: ARDUPILOT}
"""By HEARTBEAT.autopilot."""
