"""Measured differences of PX4 1.16 and ArduCopter 4.7 SITL; see docs/conformance.md."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import NamedTuple

from airl_mav.addons.conformance.mavlink_names import MavFrame, MavResult


class Reaction(Enum):
    """Reaction of an autopilot to a setpoint."""

    FLOWN = "flown"
    REFUSED = "refused"
    """Rejected with a STATUSTEXT for every message; it does not count as a setpoint."""
    IGNORED = "ignored"
    """Ignored without a STATUSTEXT."""


class ExpectedAnswer(NamedTuple):
    """Expected answer to a command."""

    result: MavResult
    text: str = ""
    """Part of the STATUSTEXT sent with it; "": any or none."""


class ExpectedLoss(NamedTuple):
    """Expected reaction when setpoints stop and heartbeats continue."""

    starts_s: tuple[float, float]
    """Earliest and latest time of the reaction, from the last setpoint [s]."""
    text: str
    """Part of the STATUSTEXT that reports it; "": none, the reaction is detected by speed."""
    mode: int
    """HEARTBEAT.custom_mode during it."""
    descends: bool
    """True if it descends level, slowed by drag alone; False if it brakes and hovers."""


class Autopilot(NamedTuple):
    """Expected behaviour of one autopilot."""

    title: str
    offboard: tuple[int, int]
    """Parameters 2 and 3 of DO_SET_MODE for offboard (ArduPilot: GUIDED)."""
    hold: tuple[int, int]
    offboard_mode: int
    """HEARTBEAT.custom_mode in offboard."""
    hold_modes: tuple[int, ...]
    """custom_mode after MAVSDK's offboard.stop()."""
    land_mode: int
    after_takeoff_mode: int
    mode_names: Mapping[int, str]
    offboard_on_ground: ExpectedAnswer
    """Answer to an offboard request on the ground, without a setpoint."""
    arms_without_setpoint: bool
    """True if it can be armed in that state."""
    offboard_in_air: ExpectedAnswer
    disarm_in_air: ExpectedAnswer
    unknown_mode: ExpectedAnswer
    frames: Mapping[MavFrame, Reaction]
    ignore_all: Reaction
    """Reaction to a type mask that ignores everything."""
    loss: ExpectedLoss

    def mode_name(self, mode: int) -> str:
        """Return the name of a custom_mode."""
        return self.mode_names.get(mode, f"mode {mode}")


def _px4_mode(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


_PX4_HOLD, _PX4_OFFBOARD, _PX4_POSITION = _px4_mode(4, 3), _px4_mode(6), _px4_mode(3)

PX4 = Autopilot(
    title="PX4",
    offboard=(6, 0),
    hold=(4, 3),
    offboard_mode=_PX4_OFFBOARD,
    hold_modes=(_PX4_HOLD,),
    land_mode=_px4_mode(4, 6),
    after_takeoff_mode=_PX4_HOLD,
    mode_names={_px4_mode(1): "MANUAL", _px4_mode(2): "ALTCTL", _PX4_POSITION: "POSCTL"}
    | {_px4_mode(4, 2): "TAKEOFF", _PX4_HOLD: "HOLD", _px4_mode(4, 4): "MISSION"}
    | {_px4_mode(4, 5): "RTL", _px4_mode(4, 6): "LAND"}
    | {_PX4_OFFBOARD: "OFFBOARD", _px4_mode(7): "STABILIZED"},
    offboard_on_ground=ExpectedAnswer(MavResult.ACCEPTED),
    arms_without_setpoint=False,
    offboard_in_air=ExpectedAnswer(
        MavResult.TEMPORARILY_REJECTED, "Switching to Offboard is currently not available"
    ),
    disarm_in_air=ExpectedAnswer(MavResult.TEMPORARILY_REJECTED, "Disarming denied"),
    unknown_mode=ExpectedAnswer(MavResult.ACCEPTED),
    frames=dict.fromkeys(MavFrame, Reaction.REFUSED)
    | dict.fromkeys((MavFrame.LOCAL_NED, MavFrame.BODY_NED), Reaction.FLOWN),
    ignore_all=Reaction.REFUSED,
    # COM_OF_LOSS_T = 1 s; 1.06 to 1.13 s measured.
    loss=ExpectedLoss((1.0, 1.5), "Failsafe activated", _PX4_POSITION, descends=True),
)

_GUIDED, _BRAKE, _LOITER = 4, 17, 5

ARDUPILOT = Autopilot(
    title="ArduPilot",
    offboard=(_GUIDED, 0),
    hold=(_BRAKE, 0),
    offboard_mode=_GUIDED,
    hold_modes=(_BRAKE, _LOITER),
    land_mode=9,
    after_takeoff_mode=_GUIDED,
    mode_names={0: "STABILIZE", 2: "ALT_HOLD", 3: "AUTO", _GUIDED: "GUIDED", _LOITER: "LOITER"}
    | {6: "RTL", 9: "LAND", 16: "POSHOLD", _BRAKE: "BRAKE"},
    offboard_on_ground=ExpectedAnswer(MavResult.ACCEPTED),
    arms_without_setpoint=True,
    offboard_in_air=ExpectedAnswer(MavResult.ACCEPTED),
    disarm_in_air=ExpectedAnswer(MavResult.FAILED),
    unknown_mode=ExpectedAnswer(MavResult.FAILED, "No such mode"),
    frames=dict.fromkeys(MavFrame, Reaction.FLOWN) | {MavFrame.BODY_FRD: Reaction.IGNORED},
    ignore_all=Reaction.IGNORED,
    # GUID_TIMEOUT = 3 s; it began to brake after 3.05 s.
    loss=ExpectedLoss((2.9, 3.6), "", _GUIDED, descends=False),
)

AUTOPILOTS: Mapping[int, Autopilot] = {12: PX4, 3: ARDUPILOT}
