"""Flight modes of external firmware, from its heartbeat to the built-in commander's modes."""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.commander import Flight, Phase
from firmware_sim.autopilot.mode_numbers import custom_mode
from firmware_sim.mavlink.codec import dialect

# PX4 reports Descend as Land.
_PX4_MODES = {custom_mode(mode): mode for mode in Mode if mode is not Mode.DESCEND}

# ArduCopter's mode numbers: ArduCopter/mode.h, enum class Number.
GUIDED = 4
_ARDUCOPTER_MODES = {
    3: Mode.TAKEOFF,  # AUTO: a mission
    GUIDED: Mode.OFFBOARD,
    5: Mode.HOLD,  # LOITER
    6: Mode.RETURN,
    9: Mode.LAND,
    17: Mode.HOLD,  # BRAKE
}

_IN_AIR = (
    dialect.MAV_LANDED_STATE_IN_AIR,
    dialect.MAV_LANDED_STATE_TAKEOFF,
    dialect.MAV_LANDED_STATE_LANDING,
)


def flight_of(
    autopilot: int, custom_mode: int, landed_state: int, *, armed: bool, ready: bool
) -> Flight:
    """Return phase and mode by the fields of HEARTBEAT and EXTENDED_SYS_STATE.

    `armed`: motors may turn; `ready`: it may be armed.
    """
    if autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA:
        mode = _ARDUCOPTER_MODES.get(custom_mode, Mode.POSITION)
        # GUIDED takes off as well: coming from the ground is no flight by setpoints.
        if mode is Mode.OFFBOARD and landed_state == dialect.MAV_LANDED_STATE_TAKEOFF:
            mode = Mode.TAKEOFF
    else:
        mode = _PX4_MODES.get(custom_mode, Mode.POSITION)
    if not armed:
        phase = Phase.STANDBY if ready else Phase.BOOT
    else:
        phase = Phase.AIR if landed_state in _IN_AIR else Phase.GROUND
    return Flight(phase=phase, mode=mode, intended=mode, after_disarm=mode)
