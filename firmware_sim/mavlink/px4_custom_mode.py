"""PX4 flight modes in MAVLink: custom_mode, base_mode and system_status of HEARTBEAT.

Source: PX4 src/modules/commander/px4_custom_mode.h and Commander.cpp (DO_SET_MODE),
src/modules/mavlink/streams/HEARTBEAT.hpp, checked against a running PX4 1.16.
"""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import Arming, CommanderStatus, OperatorText, Severity
from firmware_sim.autopilot.events.definition import NavigationMode
from firmware_sim.autopilot.events.flight_events import AUTO_MODE_UNSUPPORTED, MODE_NOT_AVAILABLE
from firmware_sim.autopilot.flight_modes import MAIN_AUTO, MAIN_POSCTL, WITH_STICKS, Mode
from firmware_sim.mavlink.codec import dialect

_CRITICAL = Severity.CRITICAL
_UNSUPPORTED = OperatorText.of(_CRITICAL, AUTO_MODE_UNSUPPORTED)


def _unavailable(name: str, mode: NavigationMode, main: int, sub: int) -> OperatorText:
    """Return PX4's rejection of a known but unavailable mode."""
    number = sub << 24 | main << 16
    text = f"Switching to {name} is currently not available"
    return OperatorText.of(_CRITICAL, MODE_NOT_AVAILABLE, number, mode, text=text)


# Modes by main and sub mode. Texts stand for modes that a real PX4 knows by name but never makes
# available; a mode of the table replaces them.
_REQUESTABLE: dict[tuple[int, int], Mode | OperatorText] = {
    (MAIN_AUTO, 0): Mode.MISSION,
    (MAIN_POSCTL, 2): _unavailable("Position Slow", NavigationMode.POSITION_SLOW, MAIN_POSCTL, 2),
    # External modes exist in PX4 only after a ROS 2 node registers them.
    **{
        (MAIN_AUTO, 10 + n): _unavailable(
            f"External {n}", NavigationMode(15 + n), MAIN_AUTO, 10 + n
        )
        for n in range(1, 9)
    },
    **{(mode.spec.main, mode.spec.sub): mode for mode in Mode if mode.spec.requestable},
}


def base_mode(status: CommanderStatus) -> int:
    """Return the MAV_MODE_FLAG bits of HEARTBEAT."""
    bits: int = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    if status.mode.spec.stabilized:
        bits |= dialect.MAV_MODE_FLAG_STABILIZE_ENABLED
    if status.mode.spec.main == MAIN_AUTO:
        bits |= dialect.MAV_MODE_FLAG_AUTO_ENABLED | dialect.MAV_MODE_FLAG_GUIDED_ENABLED
    if status.mode in WITH_STICKS:
        bits |= dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
    if status.arming is Arming.ARMED:
        bits |= dialect.MAV_MODE_FLAG_SAFETY_ARMED
    return bits


def system_status(status: CommanderStatus, *, can_arm: bool) -> int:
    """Return the MAV_STATE of HEARTBEAT.

    Armed: ACTIVE, or CRITICAL in a failsafe. Disarmed: STANDBY, or UNINIT if the mode cannot be
    armed. After a termination: FLIGHT_TERMINATION, armed or not.
    """
    if status.mode is Mode.TERMINATION:
        return int(dialect.MAV_STATE_FLIGHT_TERMINATION)
    if status.arming is Arming.ARMED:
        # ACTIVE or CRITICAL applies only to an armed vehicle.
        return int(dialect.MAV_STATE_CRITICAL if status.failsafe else dialect.MAV_STATE_ACTIVE)
    standby = status.arming is Arming.STANDBY and can_arm
    return int(dialect.MAV_STATE_STANDBY if standby else dialect.MAV_STATE_UNINIT)


def requested_mode(base: int, main: int, sub: int) -> Mode | OperatorText | None:
    """Return the mode requested by DO_SET_MODE, given parameters 1 to 3.

    The parameters are MAV_MODE_FLAG bits, main mode and sub mode. A message is PX4's explanation of
    an unavailable mode. None: PX4 accepts the request without effect (unknown main mode).
    """
    if not base & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        # Clients without custom modes describe the mode by bits.
        return _from_base_mode(base)
    # PX4 treats an unknown sub mode of POSCTL as Position.
    other = _UNSUPPORTED if main == MAIN_AUTO else _REQUESTABLE.get((main, 0))
    return _REQUESTABLE.get((main, sub), other)


def _from_base_mode(base: int) -> Mode | None:
    """Return the mode that PX4 derives from the bits of clients without custom modes."""
    if base & dialect.MAV_MODE_FLAG_AUTO_ENABLED:
        return Mode.MISSION
    if not base & dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED:
        return None
    if base & dialect.MAV_MODE_FLAG_GUIDED_ENABLED:
        return Mode.POSITION
    return Mode.STABILIZED if base & dialect.MAV_MODE_FLAG_STABILIZE_ENABLED else Mode.MANUAL
