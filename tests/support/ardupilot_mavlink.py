"""ArduCopter's MAVLink, as measured on 4.7: default streams and responses."""

from __future__ import annotations

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from airl_mav.core.frames import heading_to_ned, quat_yaw
from airl_mav.core.signing import Signing
from firmware_sim.autopilot.autopilot_state import Landed, OperatorText, Result, Setpoint, Severity
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.mavlink.codec import Values, WireMessage, dialect
from firmware_sim.mavlink.endpoint import UdpEndpoint
from firmware_sim.mavlink.link import Link
from firmware_sim.mavlink.px4_links import LinkConfig
from firmware_sim.mavlink.services import (
    Context,
    VehicleCommand,
    for_vehicle,
    handle,
    sender,
    table,
)
from firmware_sim.mavlink.streams import BUILDERS, Builder, status
from firmware_sim.mavlink.telemetry import PARTS, TickContext, flown_of
from firmware_sim.mavlink.texts_and_events import EventBuffer, TextEncoder
from tests.support.ardupilot_copter import LAND, STABILIZE, Copter

ARDUPILOTMEGA, QUADROTOR = 3, 2
CAPABILITIES, VERSION = 64_495, 67_567_616
"""AUTOPILOT_VERSION of ArduCopter 4.7.0-dev."""

_RATES_HZ = {"HEARTBEAT": 1.0, "TIMESYNC": 0.1}
"""All that comes unasked."""

_LANDED = {Landed.ON_GROUND: 1, Landed.IN_AIR: 2, Landed.TAKEOFF: 3, Landed.LANDING: 4}
_BODY_FRAMES, _WORLD_FRAMES = (8, 9), (1, 7)
_VELOCITY_BITS, _YAW_RATE_BIT, _YAW_BIT = 0x38, 0x800, 0x400
_INT8, _REAL32 = 2, 9
_EKF_STATUS_REPORT = 193
"""Not in the common dialect; MAVSDK's health of an ArduPilot is made of it."""

_EKF_ON_GROUND, _EKF_POSITION = 165, 831
"""Its flags: attitude, height and a constant position; everything of GPS."""

_PREARM = dialect.MAV_SYS_STATUS_PREARM_CHECK
_AHRS = dialect.MAV_SYS_STATUS_AHRS


class Manners:
    """ArduCopter's MAVLink on some links."""

    def __init__(self, copter: Copter, endpoints: list[UdpEndpoint]) -> None:
        self.copter = copter
        builders: dict[str, Builder | None] = {
            **BUILDERS,
            "TIMESYNC": None,
            "HEARTBEAT": self._heartbeat,
            "EXTENDED_SYS_STATE": lambda state: (3, _LANDED[state.status.landed]),
            "AUTOPILOT_VERSION": _version,
        }
        self._endpoints = endpoints
        self._links = [
            Link(LinkConfig(f"serial{n}", endpoint, _RATES_HZ), builders)
            for n, endpoint in enumerate(endpoints)
        ]
        self._ekf_us: dict[Link, tuple[int, int]] = {}
        """Next time and interval of EKF_STATUS_REPORT."""
        self._texts = TextEncoder()
        copter.say = self._say
        copter.on_mode = self._beat

    def run(self) -> None:
        """Take what has come and send what is due."""
        copter = self.copter
        if copter.inner.sample is None:
            return
        for link, endpoint in zip(self._links, self._endpoints, strict=True):
            for chunk in endpoint.receive():
                for message in link.decode(chunk):
                    self._take(message, link)
            due, state = link.scheduler.due(copter.time_us), copter.inner.state()
            flown, context = flown_of(state), TickContext().of(state)
            healthy = int(context[PARTS + 2])
            if not copter.position_ok:
                flown["healthy"], context[:3] = 0, np.nan
                context[PARTS + 2] = healthy & ~(_PREARM | _AHRS)
            else:
                context[PARTS + 2] = healthy | _PREARM | _AHRS
            link.stream_fast(flown, copter.time_us - state.time_us, context, 16)
            if due:
                link.stream_due(due, state, {})
            self._report_ekf(link)
            link.flush()

    def close(self) -> None:
        for endpoint in self._endpoints:
            endpoint.close()

    def _say(self, severity: int, text: str) -> None:
        for link in self._links:
            for chunk in self._texts.encode(OperatorText(Severity(severity), text)):
                link.send(chunk)

    def _beat(self) -> None:
        """A heartbeat goes out at once when the mode changes."""
        for link in self._links:
            link.send_stream("HEARTBEAT", self.copter.inner.state())

    # --- what is sent

    def _heartbeat(self, _state: AutopilotState) -> Values:
        copter = self.copter
        base = 81 if copter.mode in (STABILIZE, LAND) else 89
        base |= 128 if copter.armed else 0
        return QUADROTOR, ARDUPILOTMEGA, base, copter.mode, 4 if copter.armed else 3, 3

    def _report_ekf(self, link: Link) -> None:
        due_us, interval_us = self._ekf_us.get(link, (0, 0))
        if interval_us > 0 and self.copter.time_us >= due_us:
            self._ekf_us[link] = (self.copter.time_us + interval_us, interval_us)
            flags = _EKF_POSITION if self.copter.position_ok else _EKF_ON_GROUND
            link.stream(
                ardupilotmega.MAVLink_ekf_status_report_message(flags, 0.0, 0.0, 0.0, 0.0, 0.0)
            )

    # --- what is taken

    def _take(self, message: WireMessage, link: Link) -> None:
        context = Context(
            link,
            self.copter.inner,
            self.copter.time_us,
            lambda _: None,
            lambda *_: None,
            EventBuffer(),
            Signing(lambda: 0),
        )
        kind = message.get_type()
        if kind == "COMMAND_LONG" and for_vehicle(message, context):
            params = [getattr(message, f"param{n}") for n in range(1, 8)]
            result = self._command(message.command, params, context)
            link.send(
                dialect.MAVLink_command_ack_message(message.command, result, 0, 0, *sender(message))
            )
        elif kind == "SET_POSITION_TARGET_LOCAL_NED":
            self._setpoint(message)
        elif kind in ("PARAM_REQUEST_READ", "PARAM_REQUEST_LIST", "PARAM_SET"):
            self._parameter(kind, message, context)
        elif kind in ("TIMESYNC", "PING", "REQUEST_DATA_STREAM"):
            handle(message, message.get_type(), context)

    def _command(self, number: int, params: list[float], context: Context) -> int:
        copter = self.copter
        if number == dialect.MAV_CMD_COMPONENT_ARM_DISARM:
            return copter.arm() if params[0] == 1 else copter.disarm()
        if number == dialect.MAV_CMD_NAV_TAKEOFF:
            return copter.takeoff(params[6])
        if number == dialect.MAV_CMD_NAV_LAND:
            return copter.set_mode(LAND)
        if number == dialect.MAV_CMD_DO_SET_MODE:
            return copter.set_mode(int(params[1])) if int(params[0]) & 1 else Result.FAILED
        if number == dialect.MAV_CMD_SET_MESSAGE_INTERVAL and params[0] == _EKF_STATUS_REPORT:
            self._ekf_us[context.link] = (copter.time_us, int(params[1]))
            return Result.ACCEPTED
        if number in (
            dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
            dialect.MAV_CMD_REQUEST_MESSAGE,
            dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
        ):
            a, b, c, d, e, f, g = params
            result = table("ACTIONS")[number](
                VehicleCommand(number, (a, b, c, d, e, f, g)), context
            )
            assert result is not None
            return result
        return Result.UNSUPPORTED

    def _setpoint(self, message: WireMessage) -> None:
        """Accept velocities only; silently drop unsupported setpoints."""
        velocity = np.array([message.vx, message.vy, message.vz])
        if message.type_mask & _VELOCITY_BITS or not np.isfinite(velocity).all():
            return
        if message.coordinate_frame in _BODY_FRAMES:
            yaw = quat_yaw(self.copter.inner.state().estimate.quaternion)
            velocity = heading_to_ned(velocity, yaw)
        elif message.coordinate_frame not in _WORLD_FRAMES:
            return
        nan = math.nan
        yaw_rate = nan if message.type_mask & _YAW_RATE_BIT else message.yaw_rate
        heading = nan if message.type_mask & _YAW_BIT else message.yaw
        self.copter.velocity(Setpoint(np.full(3, nan), velocity, heading, yaw_rate))

    def _parameter(self, kind: str, message: WireMessage, context: Context) -> None:
        """Send values as floats, not as reinterpreted bits; ignore unknown names."""
        if not for_vehicle(message, context):
            return
        link = context.link
        values = self.copter.parameters
        names = sorted(values)
        if kind == "PARAM_REQUEST_LIST":
            wanted = names
        elif kind == "PARAM_REQUEST_READ" and message.param_index >= 0:
            wanted = names[message.param_index : message.param_index + 1]
        else:
            wanted = [message.param_id] if message.param_id in values else []
        for name in wanted:
            if kind == "PARAM_SET":
                values[name] = message.param_value
            whole = name.startswith(("FRAME_", "SERVO"))
            link.send(
                dialect.MAVLink_param_value_message(
                    name.encode(),
                    float(values[name]),
                    _INT8 if whole else _REAL32,
                    len(names),
                    names.index(name),
                )
            )


def _version(_: AutopilotState) -> Values:
    return CAPABILITIES, VERSION, *status.autopilot_version(VERSION)[2:]
