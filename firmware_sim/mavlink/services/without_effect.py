"""Commands that do nothing here and are answered as a running PX4 1.16 SITL answers them.

Some that PX4 accepts need no more than that (there is nothing to switch). Some it hands to a part
of the vehicle that is not there, and so nobody acknowledges them.
"""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import Arming, Message, Result, Severity
from firmware_sim.autopilot.events import command_events as events
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.services.context import Action, Command, Context

ACCEPTED = (
    dialect.MAV_CMD_DO_SET_ACTUATOR,
    dialect.MAV_CMD_DO_GO_AROUND,
    dialect.MAV_CMD_EXTERNAL_WIND_ESTIMATE,
)

NOT_ACKNOWLEDGED = (
    dialect.MAV_CMD_CONFIGURE_ACTUATOR,
    dialect.MAV_CMD_DO_FIGURE_EIGHT,
    dialect.MAV_CMD_DO_SET_CAM_TRIGG_DIST,
    dialect.MAV_CMD_DO_SET_CAM_TRIGG_INTERVAL,
    dialect.MAV_CMD_OBLIQUE_SURVEY,
    dialect.MAV_CMD_SET_CAMERA_ZOOM,
    dialect.MAV_CMD_SET_CAMERA_FOCUS,
    dialect.MAV_CMD_START_RX_PAIR,
    dialect.MAV_CMD_SET_CAMERA_MODE,
    dialect.MAV_CMD_DO_DIGICAM_CONTROL,
    dialect.MAV_CMD_DO_TRIGGER_CONTROL,
    dialect.MAV_CMD_DO_GRIPPER,
    dialect.MAV_CMD_DO_WINCH,
    dialect.MAV_CMD_DO_MOUNT_CONTROL,
    dialect.MAV_CMD_DO_MOUNT_CONFIGURE,
    dialect.MAV_CMD_DO_MOUNT_CONTROL_QUAT,
    dialect.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
    dialect.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE,
    dialect.MAV_CMD_REQUEST_CAMERA_INFORMATION,
    dialect.MAV_CMD_NAV_DELAY,
    dialect.MAV_CMD_DO_VTOL_TRANSITION,
    dialect.MAV_CMD_PREFLIGHT_SET_SENSOR_OFFSETS,
    dialect.MAV_CMD_PREFLIGHT_UAVCAN,
    dialect.MAV_CMD_PAYLOAD_PREPARE_DEPLOY,
    dialect.MAV_CMD_PAYLOAD_CONTROL_DEPLOY,
)


def _answer(result: Result | None) -> Action:
    """Return the action that does nothing and answers so."""
    return lambda _command, _context: result


def _actuator_test(_command: Command, context: Context) -> Result | None:
    """PX4 refuses it while armed; disarmed there is nothing here that could be turned."""
    armed = context.port.state().status.arming is Arming.ARMED
    return Result.DENIED if armed else None


def _high_latency(_command: Command, context: Context) -> Result:
    context.announce(Message.of(Severity.CRITICAL, events.NO_HIGH_LATENCY))
    return Result.FAILED


ACTIONS: dict[int, Action] = {
    **dict.fromkeys(ACCEPTED, _answer(Result.ACCEPTED)),
    **dict.fromkeys(NOT_ACKNOWLEDGED, _answer(None)),
    dialect.MAV_CMD_ACTUATOR_TEST: _actuator_test,
    dialect.MAV_CMD_CONTROL_HIGH_LATENCY: _high_latency,
    # The estimator takes a place from outside only while it has none of its own.
    dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE: _answer(Result.TEMPORARILY_REJECTED),
}
