"""Vehicle under test: MAVSDK's calls, and raw messages through MAVSDK.

Timeouts follow the vehicle's clock, at any simulation speed. Silence uses the wall clock.
"""

from __future__ import annotations

import json
import math
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, NamedTuple

from mavsdk import ComponentType
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.action import Action
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkDirectError, MavlinkMessage
from mavsdk.plugins.offboard import Offboard, VelocityBodyYawspeed, VelocityNedYaw

from airl_mav.addons.conformance import checklist, telemetry
from airl_mav.addons.conformance.checklist import (
    AUTOPILOTS,
    PX4,
    Autopilot,
    MavCommand,
    Transcript,
    command_long,
)
from airl_mav.addons.conformance.telemetry import AUTOPILOT_COMPONENT, StepSetpoint, TelemetryBuffer
from airl_mav.core import constants, errors
from airl_mav.core.clock import NS_PER_US, WallClock
from companion import link_interface, mavsdk_connection

POLL_S = 0.02  # Polling interval of a condition [wall s]
SILENT_S = 5.0
"""Silence after which a vehicle counts as lost; heartbeats come each second [wall s]."""

SLOWEST, SLACK_S = 20.0, 10.0
"""Wall-clock limit of a wait: this factor of its duration, plus this margin [1, wall s]."""

# MAVSDK repeats a command within 2 s of wall time; simulators have been seen to stall longer.
COMMAND_ATTEMPTS = 5
MODE_S = 3.0  # Timeout of a mode change; heartbeats come each second [s]
ANOTHER_ACK_S = 0.1  # Maximum delay of a second acknowledgement [s]
STREAM_PERIOD_S = 0.05  # Period of raw setpoints: 20 Hz, as in MAVSDK [s]

# SET_POSITION_TARGET_LOCAL_NED.type_mask: each bit ignores a field.
VELOCITY_AND_YAW = 0x9C7
VELOCITY = 0xDC7
VELOCITY_FORCE_BIT = 0xFC7
IGNORE_ALL = 0xDFF


class VehicleConnection:
    """Vehicle connection with telemetry and commands."""

    def __init__(self, url: str, speed: float, transcript: Transcript) -> None:
        """Open a MAVSDK connection to a vehicle of some speed. Raises UsageError."""
        self.url, self.speed = url, speed
        self.transcript = transcript
        self.telemetry = telemetry.TelemetryBuffer(transcript)
        self.clock = VehicleClock(self.telemetry, self.send, speed)
        self.autopilot: Autopilot = PX4
        self.unasked_hz: Mapping[str, float] = {}
        """Expected default messages [Hz]."""
        # PX4 sends STATUSTEXT only to ground stations.
        self._mavsdk = mavsdk_connection.open_connection(url, ComponentType.GROUND_STATION)
        self._direct: Any = None
        self.action: Any = None
        self.offboard: Any = None
        self._target = 0
        self.may_be_armed = False
        """True from an arming request until the vehicle is known to be disarmed."""

    def connect(self, timeout_s: float) -> None:
        """Wait for a flight controller. Raises UsageError on timeout [wall s]."""
        system = mavsdk_connection.find_autopilot(self._mavsdk, timeout_s)
        if system is None:
            heard = f"no flight controller heard in {timeout_s:g} s (connect_timeout_s)"
            raise errors.FieldError("connect", self.url, problem=heard)
        self._target = system.get_system_id()
        self._direct = MavlinkDirect(system)
        for name in telemetry.MESSAGES:
            self._direct.subscribe_message(name, self.telemetry.receive)
        for name in MESSAGES:
            self._direct.subscribe_message(name, self.clock.receive)
        self.action, self.offboard = Action(system), Offboard(system)

    def expect_autopilot(self, number: int) -> None:
        """Expect the behaviour of a HEARTBEAT.autopilot. Raises UsageError if unknown."""
        if number not in AUTOPILOTS:
            known = ", ".join(f"{key} {each.title}" for key, each in AUTOPILOTS.items())
            problem = f"HEARTBEAT.autopilot = {number}; accepted: {known}"
            raise errors.FieldError("connect", self.url, problem=problem)
        self.autopilot = AUTOPILOTS[number]
        self.telemetry.mode_name = self.autopilot.mode_name

    def close(self) -> None:
        """Release MAVSDK."""
        for plugin in (self.offboard, self.action, self._direct):
            if plugin is not None:
                plugin.destroy()
        self._mavsdk.destroy()

    # --- commands

    def call(self, what: str, call: Callable[[], Any], *, must_succeed: bool = False) -> str:
        """Call MAVSDK; return "" or the result's name; LinkError if it fails and `must_succeed`."""
        self.transcript.add("sent", what)
        try:
            call()
        except MavsdkError as error:
            result = getattr(error, "result", None) or error.args[0]
            name = str(getattr(result, "name", result))
            self.transcript.add("heard", f"{what}: {name}")
            if must_succeed:
                raise link_interface.LinkError(f"{what}: {name}") from None
            return name
        return ""

    def command(self, number: int, *params: float, note: str = "") -> int:
        """Send a COMMAND_LONG until answered and return its MAV_RESULT. Raises LinkError."""
        values = " ".join(f"{value:g}" for value in params)
        what = f"{checklist.name_of(checklist.MavCommand, number)} {values}".strip()
        self.transcript.add("sent", f"COMMAND_LONG {what}{note and f': {note}'}")
        message = self._message("COMMAND_LONG", checklist.command_long(number, *params))
        for left in reversed(range(COMMAND_ATTEMPTS)):
            try:
                answer = self._direct.send_command(message)
                return int(json.loads(answer.fields_json)["result"])
            except MavlinkDirectError as error:
                problem = f"{what}: {error.result.name.lower()}"
                self.transcript.add("note", f"{problem}, {left} more attempts")
        raise link_interface.LinkError(problem)

    def set_mode(self, mode: tuple[int, int], note: str) -> int:
        """Request a mode, by DO_SET_MODE's parameters 2 and 3, and return the MAV_RESULT."""
        flags = checklist.CUSTOM_MODE_FLAG | (checklist.ARMED_FLAG if self.armed else 0)
        result = self.command(checklist.MavCommand.DO_SET_MODE, flags, *mode, note=note)
        # PX4 1.16 and 1.17 accept the message first; the commander's answer follows.
        self.wait(ANOTHER_ACK_S)
        answer = self.telemetry.latest("COMMAND_ACK") or {}
        again = answer.get("command") == checklist.MavCommand.DO_SET_MODE
        return int(answer["result"]) if again else result

    def fly(self, setpoint: StepSetpoint) -> float:
        """Send a setpoint, repeated by MAVSDK at 20 Hz; return its arrival [s, vehicle time]."""
        reached: list[float] = []

        def send() -> None:
            reached.append(self.clock.sending_time())
            if setpoint.frame == "ned":
                self.offboard.set_velocity_ned(VelocityNedYaw(*setpoint[1:]))
            else:
                self.offboard.set_velocity_body(VelocityBodyYawspeed(*setpoint[1:]))

        values = ", ".join(f"{value:g}" for value in setpoint[1:])
        self.call(f"set_velocity_{setpoint.frame}({values})", send, must_succeed=True)
        latest = self.clock.exchange()
        # A simulation may have stalled: the arrival precedes this second exchange.
        return reached[0] if latest is None else min(reached[0], latest.boot_s)

    def send(self, name: str, fields: dict[str, Any]) -> None:
        """Send a raw message; None in a field is NaN. Raises LinkError."""
        try:
            self._direct.send_message(self._message(name, fields))
        except MavlinkDirectError as error:
            raise link_interface.LinkError(f"{name}: {error.result.name.lower()}") from None

    def _message(self, name: str, fields: dict[str, Any]) -> MavlinkMessage:
        target = {"target_system": self._target, "target_component": telemetry.AUTOPILOT_COMPONENT}
        return MavlinkMessage(name, fields_json=json.dumps({**target, **fields}))

    # --- waiting

    def poll(self) -> None:
        """Wait for one polling interval. Raises LinkError when the vehicle is silent."""
        threading.Event().wait(POLL_S)
        if self.telemetry.silence_s > SILENT_S:
            raise link_interface.LinkError(f"nothing heard for {SILENT_S:g} s")

    def wait_for(self, condition: Callable[[], Any], timeout_s: float) -> Any:
        """Wait by the vehicle's clock for a condition and return its value; LinkError if silent."""
        start_s, wall = self.telemetry.boot_s, WallClock()
        while not (value := condition()):
            elapsed_s = self.telemetry.boot_s - start_s
            if elapsed_s >= timeout_s:
                return value
            if wall.time_us() / constants.US_PER_S > SLOWEST * timeout_s / self.speed + SLACK_S:
                raise link_interface.LinkError(f"its clock advanced by only {elapsed_s:.1f} s")
            self.poll()
        return value

    def wait(self, seconds: float) -> None:
        """Wait for a time by the vehicle's clock [s]. Raises as `wait_for`."""
        self.wait_for(lambda: False, seconds)

    def reaches_mode(self, *modes: int) -> bool:
        """Wait for any of these custom_modes; return False on timeout (`MODE_S`)."""
        return bool(self.wait_for(lambda: self.mode in modes, MODE_S))

    def count_messages(self, seconds: float) -> tuple[Counter[str], float]:
        """Count all messages for a while; return the counts and the vehicle's time [s]."""
        counts: Counter[str] = Counter()

        def count(message: Any, _: object) -> None:
            if message.component_id == telemetry.AUTOPILOT_COMPONENT:
                counts[message.message_name] += 1

        stopwatch, start_s = WallClock(self.speed), self.clock.now()
        every = self._direct.subscribe_message("", count)  # Too costly to keep
        try:
            stopwatch.sleep_until(int(seconds * constants.US_PER_S))
            elapsed_s = self.clock.now() - start_s or stopwatch.time_us() / constants.US_PER_S
        finally:
            self._direct.unsubscribe_message(every)
        return counts, elapsed_s

    # --- state

    @property
    def armed(self) -> bool:
        """True if the newest heartbeat reports armed."""
        return bool(self._newest("HEARTBEAT", "base_mode") & checklist.ARMED_FLAG)

    @property
    def mode(self) -> int:
        """custom_mode of the newest heartbeat, -1 before the first."""
        return int(self._newest("HEARTBEAT", "custom_mode", -1))

    @property
    def mode_name(self) -> str:
        """Name of the current mode."""
        return self.autopilot.mode_name(self.mode)

    @property
    def landed_state(self) -> int:
        """Newest landed_state, 0 if unknown."""
        return int(self._newest("EXTENDED_SYS_STATE", "landed_state"))

    @property
    def height_m(self) -> float:
        """Estimated height above the origin [m]."""
        return -float(self._newest("LOCAL_POSITION_NED", "z"))

    @property
    def velocity_m_s(self) -> tuple[float, float, float]:
        """Estimated velocity, north, east, down [m/s]."""
        north, east, down = (
            self._newest("LOCAL_POSITION_NED", name) or 0.0 for name in ("vx", "vy", "vz")
        )
        return north, east, down

    @property
    def speed_m_s(self) -> float:
        """Estimated speed [m/s]."""
        return math.hypot(*self.velocity_m_s)

    def _newest(self, name: str, field: str, default: int = 0) -> Any:
        """Return a field of the newest message of a name."""
        fields = self.telemetry.latest(name)
        return default if fields is None else fields[field]


class RawSetpoint(NamedTuple):
    """SET_POSITION_TARGET_LOCAL_NED; None is NaN."""

    frame: checklist.MavFrame = checklist.MavFrame.LOCAL_NED
    mask: int = VELOCITY_AND_YAW
    vx: float | None = 0.0
    yaw_rad: float = 0.0


class SetpointStream:
    """Repeats the newest raw setpoint until stopped, independent of heartbeats, unlike MAVSDK."""

    def __init__(self, vehicle: VehicleConnection, setpoint: RawSetpoint) -> None:
        self._vehicle, self._setpoint = vehicle, setpoint
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="setpoints", daemon=True)

    def __enter__(self) -> SetpointStream:
        """Start sending."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        self.stop()

    def send(self, setpoint: RawSetpoint) -> None:
        """Send another setpoint now, and repeat it."""
        self._setpoint = setpoint
        self._send()

    def stop(self) -> None:
        """Stop; no setpoint is sent after it returns."""
        self._stop.set()
        self._thread.join()

    def _send(self) -> None:
        frame, mask, vx, yaw_rad = self._setpoint
        zeros = dict.fromkeys(("x", "y", "z", "vy", "vz", "afx", "afy", "afz", "yaw_rate"), 0.0)
        fields = {"time_boot_ms": 0, "coordinate_frame": int(frame), "type_mask": mask, **zeros}
        self._vehicle.send("SET_POSITION_TARGET_LOCAL_NED", {**fields, "vx": vx, "yaw": yaw_rad})

    def _run(self) -> None:
        clock = WallClock(self._vehicle.speed)
        due_us = clock.time_us()
        while not self._stop.is_set():
            try:
                self._send()
            except link_interface.LinkError:
                return  # The main thread detects the silence.
            # Missed setpoints are skipped.
            due_us = max(due_us + int(STREAM_PERIOD_S * constants.US_PER_S), clock.time_us())
            clock.sleep_until(due_us, self._stop)


MESSAGES = ("SYSTEM_TIME", "TIMESYNC")  # Messages that `VehicleClock.receive` takes
ANSWER_S = 2.0  # Answer timeout [wall s]
SAME_CLOCK_S = 1.0  # Maximum difference between an answer and telemetry of the same clock [s]
ATTEMPTS = 8  # Maximum exchanges in a row
SHORT_US = 2000  # Maximum age of an exchange's middle [wall µs]
SYSTEM_TIME_ID = 2


class Method(Enum):
    """Method to request the vehicle's time."""

    TIMESYNC = "TIMESYNC"
    SYSTEM_TIME = "REQUEST_MESSAGE(SYSTEM_TIME)"
    """Needed for PX4 1.16, whose TIMESYNC answer lacks a target, so that MAVSDK drops it."""
    TELEMETRY = "the newest telemetry"
    """No request: up to one message early."""


class Exchange(NamedTuple):
    """Request and answer."""

    boot_s: float
    """Vehicle time since boot at the answer [s]."""
    middle_us: float
    """Midpoint between request and answer [wall µs]."""
    round_trip_us: int
    """Time from request to answer [wall µs]."""


class VehicleClock:
    """Requests the vehicle's time, by the first supported method."""

    def __init__(
        self, telemetry: TelemetryBuffer, send: Callable[[str, dict[str, Any]], None], speed: float
    ) -> None:
        self._telemetry, self._send, self._speed = telemetry, send, speed
        self.wall = WallClock()
        self._question = 0
        """ts1 of the newest TIMESYNC [ns]."""
        self._answer: tuple[float, int] | None = None
        """Time since boot [s], and its reception time [wall µs]."""
        self._answered = threading.Event()
        self.method = Method.TIMESYNC
        self.inexact = 0
        """Number of sending times taken from telemetry because an answer was missing."""

    def receive(self, message: Any, _: object) -> None:
        """Process a SYSTEM_TIME or TIMESYNC of MAVSDK's mavlink_direct."""
        if message.component_id != AUTOPILOT_COMPONENT or self._answered.is_set():
            return
        received_us, fields = self.wall.time_us(), json.loads(message.fields_json)
        if message.message_name != self.method.name:
            return
        if self.method is Method.SYSTEM_TIME:
            boot_s = fields["time_boot_ms"] / constants.MS_PER_S
        elif fields["tc1"] and fields["ts1"] == self._question:
            boot_s = fields["tc1"] / (constants.US_PER_S * NS_PER_US)
        else:
            return
        self._answer = boot_s, received_us
        self._answered.set()

    def choose_method(self) -> Method:
        """Select the first method that the vehicle answers."""
        for self.method in Method:
            if self._ask() is not None:
                break
        return self.method

    def exchange(self) -> Exchange | None:
        """Return the first exchange that is short enough, or the shortest of several."""
        best: Exchange | None = None
        for _ in range(ATTEMPTS):
            found = self._ask()
            if found is None:
                break
            if self.wall.time_us() - found.middle_us <= SHORT_US:
                return found
            if best is None or found.round_trip_us < best.round_trip_us:
                best = found
        return best

    def now(self) -> float:
        """Return the vehicle's time since boot [s], from the newest telemetry without an answer."""
        found = self.exchange()
        return self._telemetry.boot_s if found is None else found.boot_s

    def sending_time(self) -> float:
        """Return the arrival time of a message that is sent right after this call [s]."""
        newest_s, found = self._telemetry.boot_s, self.exchange()
        if found is None:
            self.inexact += 1
            return newest_s
        since_us = self.wall.time_us() - found.middle_us
        return found.boot_s + since_us * self._speed / constants.US_PER_S

    def _ask(self) -> Exchange | None:
        """Exchange once; None without an answer, or for an answer by another clock."""
        if self.method is Method.TELEMETRY:
            return None
        newest_s = self._telemetry.boot_s
        self._answer = None
        # Set before an answer can come.
        self._question += 1
        self._answered.clear()
        asked_us = self.wall.time_us()
        if self.method is Method.TIMESYNC:
            self._send("TIMESYNC", {"tc1": 0, "ts1": self._question})
        else:
            self._telemetry.unlogged_acks[MavCommand.REQUEST_MESSAGE] += 1
            question = command_long(MavCommand.REQUEST_MESSAGE, SYSTEM_TIME_ID)
            self._send("COMMAND_LONG", question)
        if not self._answered.wait(ANSWER_S) or self._answer is None:
            return None
        boot_s, received_us = self._answer
        # Before the first telemetry there is nothing to compare with.
        if newest_s > 0.0 and abs(boot_s - newest_s) > SAME_CLOCK_S:
            return None
        return Exchange(boot_s, (asked_us + received_us) / 2.0, received_us - asked_us)
