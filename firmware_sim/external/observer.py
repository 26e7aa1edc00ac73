"""Observer of external firmware on a separate MAVLink link: state, texts and parameters.

Companion and ground station command the firmware directly.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.commander import CommanderState, FlightPhase
from firmware_sim.autopilot.flight_modes import BY_CUSTOM_MODE, Mode
from firmware_sim.external.parameters import _FLOAT, Value, same
from firmware_sim.mavlink.codec import Decoder, Encoder, WireMessage, dialect, message_id, payload
from firmware_sim.mavlink.endpoint import Endpoint
from firmware_sim.mavlink.link import LinkCounters
from firmware_sim.mavlink.streams import units
from firmware_sim.mavlink.traffic import TlogWriter

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
) -> CommanderState:
    """Return phase and mode from HEARTBEAT and EXTENDED_SYS_STATE; `ready` = ready to arm."""
    if autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA:
        mode = _ARDUCOPTER_MODES.get(custom_mode, Mode.POSITION)
        # GUIDED includes the take-off, which is not flown by setpoints.
        if mode is Mode.OFFBOARD and landed_state == dialect.MAV_LANDED_STATE_TAKEOFF:
            mode = Mode.TAKEOFF
    else:
        mode = BY_CUSTOM_MODE.get(custom_mode, Mode.POSITION)
    if not armed:
        phase = FlightPhase.STANDBY if ready else FlightPhase.BOOT
    else:
        phase = FlightPhase.AIR if landed_state in _IN_AIR else FlightPhase.GROUND
    return CommanderState(phase=phase, mode=mode, intended=mode, after_disarm=mode)


SYSTEM_ID = 254
"""MAVLink system id of the observer, different from the vehicle's and a ground station's (255)."""

INTERVALS_US: Mapping[str, int] = {
    "SYS_STATUS": 500_000,
    "EXTENDED_SYS_STATE": 200_000,
    "LOCAL_POSITION_NED": 100_000,
    "ATTITUDE": 100_000,
    "GLOBAL_POSITION_INT": 200_000,
    "GPS_RAW_INT": 200_000,
}
"""Requested messages and their intervals [µs]; few, as the link may be slow."""

WITHOUT_GPS: Mapping[str, int] = {
    **{name: us for name, us in INTERVALS_US.items() if name != "GPS_RAW_INT"},
    "ESTIMATOR_STATUS": 500_000,
}

ASK_EVERY_US = 1_000_000
"""Interval of repeated requests for missing messages [µs]."""

BEAT_EVERY_US = 1_000_000
"""Interval of the observer's heartbeat [µs]."""

FORCE = 21196
"""Second parameter of COMPONENT_ARM_DISARM: disarm in any state (MAVLink, common.xml)."""


def _origin_message(origin: Geodetic, system_id: int) -> Any:
    return dialect.MAVLink_set_gps_global_origin_message(
        system_id,
        units.deg_e7(origin.latitude_deg),
        units.deg_e7(origin.longitude_deg),
        units.mm(origin.altitude_m),
    )


_PREARM = dialect.MAV_SYS_STATUS_PREARM_CHECK


class FirmwareObserver:
    """Link to external firmware. Non-blocking; no received message raises."""

    intervals_us: Mapping[str, int] = INTERVALS_US

    def __init__(self, endpoint: Endpoint, name: str, origin: Geodetic | None = None) -> None:
        """Observe a named link; `origin` is sent to firmware without GPS."""
        self._endpoint = endpoint
        self._name = name
        self._origin = origin
        self._decoder = Decoder(datagrams=endpoint.datagrams)
        self._encoder = Encoder(SYSTEM_ID, dialect.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._tlog: TlogWriter | None = None
        self._rx = self._tx = self._ignored = 0
        self.on_message: Callable[[OperatorText], None] | None = None
        """Callback for every operator text; None = no callback."""
        self.restart()

    def restart(self) -> None:
        """Reset all state before another firmware starts."""
        self._now_us = 0
        self._heard: WireMessage | None = None
        self.version: int | None = None
        """AUTOPILOT_VERSION.flight_sw_version; None before it is known."""
        self._landed = int(dialect.MAV_LANDED_STATE_UNDEFINED)
        self._ready = False
        self._located = False
        """True if firmware without GPS reports a valid position."""
        self._asked_us = -ASK_EVERY_US
        self._came: set[str] = set()
        self._text = ""
        self.last_text = ""
        self._beat_us = -BEAT_EVERY_US
        self.acts_as_ground_station = True
        """True to send a ground station's heartbeat, which PX4 requires to send texts."""
        self.parameters = ParameterClient(self._send)

    @property
    def heard(self) -> bool:
        """True once a heartbeat was received."""
        return self._heard is not None

    @property
    def autopilot(self) -> int | None:
        """MAV_AUTOPILOT of the heartbeat; None before the first heartbeat."""
        return None if self._heard is None else int(self._heard.autopilot)

    @property
    def ready(self) -> bool:
        """True if ready to arm and sending a position, which flying ArduPilot requires."""
        return self._ready and "LOCAL_POSITION_NED" in self._came

    def flight(self, *, armed: bool) -> CommanderState:
        """Return phase and mode; `armed` = the motors may turn."""
        beat = self._heard
        if beat is None:
            return CommanderState()
        return flight_of(
            beat.autopilot, beat.custom_mode, self._landed, armed=armed, ready=self._ready
        )

    # --- MAVLink side of the firmware process

    def filenos(self) -> list[int]:
        """Return the descriptors that become readable when data arrive."""
        number = self._endpoint.fileno()
        return [] if number is None else [number]

    def receive(self, now_us: int) -> int:
        """Handle messages received by simulated `now_us` [µs]; return the number accepted."""
        self._now_us = now_us
        counted = 0
        for chunk in self._endpoint.receive():
            for message in self._decoder.feed(chunk):
                self._rx += 1
                self._write(bytes(message.get_msgbuf()))
                if self._take(message):
                    counted += 1
                else:
                    self._ignored += 1
        return counted

    def send(self, now_us: int, flown: object = None) -> None:
        """Send the heartbeat and pending requests; once per tick, at simulated `now_us` [µs]."""
        del flown  # external firmware sends its telemetry
        self._now_us = now_us
        if self._heard is None:
            return
        if self.acts_as_ground_station and now_us - self._beat_us >= BEAT_EVERY_US:
            self._beat_us = now_us
            self._send(
                dialect.MAVLink_heartbeat_message(
                    dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3
                )
            )
        if now_us - self._asked_us < ASK_EVERY_US:
            return
        self._asked_us = now_us
        if self.version is None:
            self._command(dialect.MAV_CMD_REQUEST_MESSAGE, message_id("AUTOPILOT_VERSION"))
        if self._origin is not None and self._located and not self._ready:
            # PX4 boots into Hold and cannot arm there without an origin. An origin sent before PX4
            # has estimated a position would shift that position.
            self._send(_origin_message(self._origin, self._heard.get_srcSystem()))
        wanted = self.intervals_us if self._origin is None else WITHOUT_GPS
        for name, interval_us in wanted.items():
            if name not in self._came:
                self._command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, message_id(name), interval_us)

    def end(self, action: int) -> None:
        """Command the firmware to stop the motors, then to reboot or shut down (`launcher`)."""
        self._command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0, FORCE)
        self._command(dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, action)

    def log_to(self, tlog: TlogWriter | None) -> None:
        """Start to log both directions to a tlog; None stops logging."""
        self._tlog = tlog

    def counters(self) -> dict[str, LinkCounters]:
        """Return the traffic counters."""
        decoder, errors = self._decoder, self._endpoint.send_errors
        ignored = self._ignored + decoder.unknown
        return {self._name: LinkCounters(self._rx, self._tx, decoder.malformed, ignored, errors)}

    def close(self) -> None:
        """Close the endpoint."""
        self._endpoint.close()

    # --- messages

    def _take(self, message: WireMessage) -> bool:
        if message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
            return False  # forwarded from the companion or a ground station
        name = message.get_type()
        self._came.add(name)
        if name == "HEARTBEAT":
            self._heard = message
            self.parameters.address(
                message.get_srcSystem(), message.get_srcComponent(), message.autopilot
            )
        elif name == "EXTENDED_SYS_STATE":
            self._landed = int(message.landed_state)
        elif name == "ESTIMATOR_STATUS":
            self._located = bool(message.flags & dialect.ESTIMATOR_POS_HORIZ_REL)
        elif name == "SYS_STATUS":
            self._ready = bool(message.onboard_control_sensors_health & _PREARM)
        elif name == "STATUSTEXT":
            self._say(message)
        elif name == "PARAM_VALUE":
            self.parameters.take(message)
        elif name == "PARAM_ERROR" and message.error == dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST:
            self.parameters.absent.add(str(message.param_id))
        elif name == "AUTOPILOT_VERSION":
            self.version = int(message.flight_sw_version)
        else:
            return False
        return True

    def _say(self, message: WireMessage) -> None:
        """Pass on a text; a text in chunks (`id` not 0) is passed on after the last chunk."""
        number, chunk = getattr(message, "id", 0), getattr(message, "chunk_seq", 0)
        text = str(message.text)
        # A full chunk is followed by another chunk.
        whole = number == 0 or len(text) < TEXT_LENGTH
        self._text = text if number == 0 or chunk == 0 else self._text + text
        if not whole:
            return
        self.last_text = self._text
        if self.on_message is not None:
            self.on_message(OperatorText(Severity(min(int(message.severity), 7)), self._text))

    def _command(self, number: int, *parameters: float) -> None:
        """Send a COMMAND_LONG to the firmware, if its heartbeat was received."""
        beat = self._heard
        if beat is None:
            return
        p = (*parameters, *([0.0] * (7 - len(parameters))))
        self._send(
            dialect.MAVLink_command_long_message(
                beat.get_srcSystem(), beat.get_srcComponent(), number, 0, *p
            )
        )

    def _send(self, message: WireMessage) -> None:
        frame = self._encoder.pack(message)
        self._tx += 1
        self._write(frame)
        self._endpoint.send(frame)

    def _write(self, frame: bytes) -> None:
        if self._tlog is not None:
            self._tlog.write(self._now_us, frame)


TEXT_LENGTH = 50


BURST = 10
"""Maximum number of requests sent at once, as the link may be slow."""


SILENT_REQUESTS = 12
"""Requests without an answer after which firmware that has answered others lacks a parameter."""


_INTEGERS = {
    dialect.MAV_PARAM_TYPE_INT8: "<b3x",
    dialect.MAV_PARAM_TYPE_UINT8: "<B3x",
    dialect.MAV_PARAM_TYPE_INT16: "<h2x",
    dialect.MAV_PARAM_TYPE_UINT16: "<H2x",
    dialect.MAV_PARAM_TYPE_INT32: "<i",
    dialect.MAV_PARAM_TYPE_UINT32: "<I",
}
"""Struct formats of integers in the value field (bytewise encoding)."""

_VALUE_BYTES = 4


class ParameterClient:
    """Known parameters of a vehicle. The caller repeats requests."""

    def __init__(self, send: Callable[[WireMessage], None]) -> None:
        """Set the function that sends a message."""
        self._send = send
        self._target: tuple[int, int] | None = None
        self._bytewise = True
        self._values: dict[str, Value] = {}
        self._kinds: dict[str, int] = {}
        self._unanswered = 0
        self.absent: set[str] = set()
        """Parameters that the firmware lacks."""

    values = property(lambda self: self._values)
    """Values received so far, by name."""

    def address(self, system: int, component: int, autopilot: int) -> None:
        """Set the target. PX4 encodes integers bytewise, ArduPilot casts them to a float."""
        self._target = system, component
        self._bytewise = autopilot != dialect.MAV_AUTOPILOT_ARDUPILOTMEGA

    def take(self, message: WireMessage) -> None:
        """Store the value of a PARAM_VALUE message."""
        name, kind, self._unanswered = str(message.param_id), int(message.param_type), 0
        self._kinds[name] = kind
        if kind not in _INTEGERS:
            self._values[name] = float(message.param_value)
        elif self._bytewise:
            raw = payload(message).ljust(_VALUE_BYTES, b"\0")[:_VALUE_BYTES]
            (self._values[name],) = struct.unpack(_INTEGERS[kind], raw)
        else:
            self._values[name] = int(message.param_value)

    def ask(self, names: Iterable[str]) -> list[str]:
        """Request up to `BURST` unknown parameters; return the names of all unknown ones."""
        missing = [name for name in names if name not in {*self._values, *self.absent}]
        self._unanswered += 1
        if self._values and self._unanswered > SILENT_REQUESTS:
            # PX4 before 1.18 does not answer a request for a parameter that it lacks.
            self.absent.update(missing[:BURST])
            self._unanswered, missing = 0, missing[BURST:]
        if self._target is not None:
            for name in missing[:BURST]:
                self._send(
                    dialect.MAVLink_param_request_read_message(
                        *self._target, name.encode("ascii"), -1
                    )
                )
        return missing

    def set(self, wanted: Mapping[str, Value]) -> list[str]:
        """Set differing parameters and return their names; known types determine the encoding."""
        differing = [name for name in wanted if not same(self._values[name], wanted[name])]
        if self._target is not None:
            for name in differing[:BURST]:
                kind = self._kinds[name]
                self._send(
                    dialect.MAVLink_param_set_message(
                        *self._target, name.encode("ascii"), self._encoded(kind, wanted[name]), kind
                    )
                )
        return differing

    def _encoded(self, kind: int, value: Value) -> float:
        if self._bytewise and kind in _INTEGERS:
            (number,) = _FLOAT.unpack(struct.pack(_INTEGERS[kind], int(value)))
            return float(number)
        return float(value)
