"""Companion's link to the flight controller: MAVSDK's synchronous API, without a thread hop."""

from __future__ import annotations

import json
import math
import struct
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from mavsdk import ComponentType
from mavsdk.plugins.action import Action, ActionError
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkDirectError, MavlinkMessage
from mavsdk.plugins.offboard import Attitude as OffboardAttitude
from mavsdk.plugins.offboard import AttitudeRate, Offboard, OffboardError, VelocityBodyYawspeed
from mavsdk.plugins.server_utility import ServerUtility, StatusTextType
from mavsdk.plugins.telemetry import FlightMode, Telemetry, TelemetryError, TelemetryResult

from airl_mav.core import constants, errors
from airl_mav.core.clock import Clock, WallClock
from airl_mav.policy import actions, observation
from companion import link_interface, mavsdk_connection

POLL_S = 0.1
"""Interval of checks while waiting for a condition [s]."""

HEALTH_SETTLE_S = 0.5
"""Required time of good health before arming [s]; more than two of PX4's 5 Hz reports."""

OFFBOARD_SETTLE_S = 0.1
"""Wait after the switch to offboard [s]. PX4 acknowledges the switch before all modules apply it. A
setpoint sent within about 10 ms is dropped, and MAVSDK repeats it only 50 ms later."""

OFFBOARD_REPEAT_S = 0.05
"""Interval of zero setpoints while waiting for a switch to offboard [s]: MAVSDK's 20 Hz; PX4
requires more than 2 Hz."""

TEXT_CHARACTERS = 50

ARM_RETRY_S = 0.5
"""Interval of arm requests [s]."""

ORIGIN_RETRY_S = 2.0
"""Interval of origin messages [s]."""

STREAM_TIMEOUT_S = 10.0
"""Timeout of stream requests to a flight controller that is still booting [wall s]."""

STREAM_RETRY_S = 0.2
"""Interval of requests for a stream [wall s]."""

Watch: TypeAlias = "Callable[[observation.Kinematics], None]"

_HEADER = 10
"""Length of a MAVLink 2 header [bytes]."""

_HEARTBEAT, _LOCAL_POSITION_NED = b"\x00\x00\x00", b"\x20\x00\x00"
"""Message numbers as encoded in a frame."""

_BASE_MODE, _ARMED = 6, 0x80
"""Offset of the base mode in a HEARTBEAT, and the armed bit."""

_DOWN = struct.Struct("<12xf8xf")
"""Payload of LOCAL_POSITION_NED: z [m] and vz [m/s]."""


class MavsdkLink:
    """MAVSDK connection over UDP, serial or raw bytes. Implements `Link`."""

    def __init__(
        self,
        url: str,
        clock: Clock,
        abandon: threading.Event | None = None,
        heard: Callable[[], bool] | None = None,
        poll: Callable[[int, link_interface.Due, link_interface.Quiet], None] | None = None,
        *,
        signing_key: Path | None = None,
        system_id: int | None = None,
    ) -> None:
        """Open a connection, see `open_connection`; `connect` waits for the vehicle.

        `abandon`, set from another thread, ends any wait. `heard` returns True if the flight
        controller is received, independent of wall time; None = MAVSDK decides. `poll` sleeps for
        an interval [µs], and repeats while a condition need not be checked; None = check after
        every interval. `signing_key` is the key file that signs frames; None = unsigned.
        `system_id` is the system id of the vehicle; None = the first flight controller.
        """
        self.url = url
        self._clock = clock
        self._poll = poll
        self._abandon = abandon or threading.Event()
        self._heard = heard
        self.setpoints_sent = 0
        """Number of setpoints passed to MAVSDK, without MAVSDK's repetitions."""
        self._system_id = system_id
        self._proxy: mavsdk_connection.SigningProxy | None = None
        if signing_key is not None:
            self._proxy, url = (
                mavsdk_connection.SigningProxy(url, signing_key, system_id),
                mavsdk_connection.RAW_URL,
            )
        try:
            self._mavsdk = mavsdk_connection.open_connection(
                url, ComponentType.COMPANION_COMPUTER, system_id
            )
        except errors.UsageError:
            self._close_proxy()
            raise
        if self._proxy is not None:
            self._proxy.start(self._mavsdk)
        self._met = WallClock()
        self._system: Any = None
        self._telemetry: Any = None
        self._action: Any = None
        self._offboard: Any = None
        self._texts: Any = None
        self._direct: Any = None
        self.dialect: mavsdk_connection.Dialect = mavsdk_connection.PX4
        """Dialect of the flight controller; PX4 before `connect`."""
        self._asked = False
        """True if the streams were requested since the last mission."""

    def connect(self, timeout_s: float, stop: threading.Event | None = None) -> None:
        """Wait for a flight controller; LinkError after a timeout [wall s] or on `stop`."""
        system = mavsdk_connection.find_autopilot(self._mavsdk, timeout_s, stop, self._system_id)
        if system is None:
            raise self._unheard(timeout_s)
        self._met = WallClock()
        # A second `connect` replaces the plugins of an earlier system.
        self._release_plugins()
        self._system = system
        self._telemetry = Telemetry(system)
        self._action = Action(system)
        self._offboard = Offboard(system)
        self._ask_for_streams(stop)
        self._asked = True

    def check_alone(self, listen_s: float = 0.0) -> None:
        """Raise LinkError if several flight controllers are heard and no system id selects one.

        `listen_s` is the minimum time since `connect` [wall s]. In lockstep there is one vehicle.
        """
        if self._system_id is not None or self._heard is not None:
            return
        self._met.sleep_until(int(listen_s * constants.US_PER_S), self._abandon)
        if len(found := sorted(mavsdk_connection.autopilots(self._mavsdk))) > 1:
            raise link_interface.LinkError(
                f"several flight controllers are heard on {self.url}: systems"
                f" {', '.join(map(str, found))}; choose one with airl-companion --system-id"
            )

    def prepare(self, timeout_s: float, stop: threading.Event | None = None) -> None:
        """Prepare a connection that may have been used by earlier missions.

        The flight controller may have been replaced or restarted. Cached state is dropped and
        streams are requested again, unless right after `connect`. Raises LinkError after a timeout
        [wall s], without streams, or on `stop`.
        """
        # Streams requested by `connect` a moment ago are not requested twice.
        if self._asked:
            self._asked = False
            return
        stopwatch = WallClock()
        while not self.connected:
            if stopwatch.time_us() > timeout_s * constants.US_PER_S:
                raise self._unheard(timeout_s)
            self._pause_wall(stop)
        # `release` has destroyed the offboard plugin.
        if self._offboard is None:
            self._offboard = Offboard(self._system)
        # A new Telemetry plugin has no cached values.
        self._telemetry.destroy()
        self._telemetry = Telemetry(self._system)
        self._ask_for_streams(stop)

    def _ask_for_streams(self, stop: threading.Event | None) -> None:
        self.dialect = mavsdk_connection.dialect_of(self._system.autopilot_type())
        stopwatch = WallClock()
        # The flight controller may reject requests while it boots, so each is repeated.
        for name, rate_hz in self.dialect.streams:
            while True:
                try:
                    getattr(self._telemetry, f"set_rate_{name}")(rate_hz)
                    break
                except TelemetryError as error:
                    if stopwatch.time_us() > STREAM_TIMEOUT_S * constants.US_PER_S:
                        raise link_interface.LinkError(f"no telemetry: {_refusal(error)}") from None
                self._pause_wall(stop)

    def _unheard(self, timeout_s: float) -> link_interface.LinkError:
        who = "flight controller" if self._system_id is None else f"system {self._system_id}"
        refused = 0 if self._proxy is None else self._proxy.refused
        hint = f" ({refused} frames refused: bad signature)" if refused else ""
        return link_interface.LinkError(f"no {who} heard on {self.url} in {timeout_s:g} s{hint}")

    def _pause_wall(self, stop: threading.Event | None) -> None:
        if self._abandon.is_set() or (stop is not None and stop.is_set()):
            raise link_interface.LinkError("stopped")
        WallClock().sleep_until(int(STREAM_RETRY_S * constants.US_PER_S), self._abandon)

    def exchange_raw(self, sent: Callable[[bytes], None]) -> Callable[[bytes], None]:
        """Exchange the bytes of a `raw://` connection; see `mavsdk_connection.exchange_raw`."""
        self.set_timeout(mavsdk_connection.RAW_TIMEOUT_S)
        return mavsdk_connection.exchange_raw(self._mavsdk, sent)

    def set_timeout(self, seconds: float) -> None:
        """Set the timeout until MAVSDK repeats a request [wall s]; MAVSDK's default is 0.5 s."""
        mavsdk_connection.set_timeout(self._mavsdk, seconds)

    def exchange_texts(self, heard: Callable[[str], None]) -> Callable[[str], None]:
        """Exchange STATUSTEXTs with the connected flight controller; return the send function.

        `heard` receives every text in an MAVSDK thread, after all earlier telemetry, and must not
        block. The send function accepts up to 50 characters and keeps the order of messages.
        """
        self._texts = texts = ServerUtility(self._system)
        self.hear_texts(heard)
        return lambda text: texts.send_status_text(StatusTextType.DEBUG, text)

    def close(self) -> None:
        """Release MAVSDK."""
        self._release_plugins()
        self._close_proxy()  # ends the feed before MAVSDK
        self._mavsdk.destroy()

    def _close_proxy(self) -> None:
        if self._proxy is not None:
            self._proxy.close()

    def _release_plugins(self) -> None:
        own = self._direct, self._texts, self._offboard, self._action, self._telemetry
        for plugin in own:
            if plugin is not None:
                plugin.destroy()
        self._direct = self._texts = self._offboard = self._action = self._telemetry = None

    @property
    def connected(self) -> bool:
        """True while heartbeats of the flight controller arrive (MAVSDK allows gaps of 3 s)."""
        if self._system is None:
            return False
        return bool(self._system.is_connected()) if self._heard is None else self._heard()

    def missing_health(self, *, by_gps: bool = True) -> list[str]:
        """Return the names of the health flags not reported as good.

        Without GPS, MAVSDK's position flags are meaningless: the global flag stays false, the local
        flag alternates with contradicting messages (PX4 1.16). Armability is a separate flag.
        """
        health = self._telemetry.health()
        needed = [
            flag for flag in self.dialect.health if by_gps or flag not in mavsdk_connection.POSITION
        ]
        flags = [flag for flag in needed if not getattr(health, flag)]
        return [flag.removeprefix("is_").removesuffix("_ok").replace("_", " ") for flag in flags]

    @property
    def armed(self) -> bool:
        """True if the heartbeat reports armed (latency up to 1 s)."""
        return bool(self._telemetry.armed())

    def kinematics(self) -> observation.Kinematics:
        """Return the newest position, velocity, attitude and body rates."""
        # MAVSDK caches the newest values, so these calls do not wait.
        pv = self._telemetry.position_velocity_ned()
        q = self._telemetry.attitude_quaternion()
        w = self._telemetry.attitude_angular_velocity_body()
        p, v = pv.position, pv.velocity
        return observation.Kinematics(
            np.array([p.north_m, p.east_m, p.down_m]),
            np.array([v.north_m_s, v.east_m_s, v.down_m_s]),
            np.array([q.w, q.x, q.y, q.z]),
            np.array([w.roll_rad_s, w.pitch_rad_s, w.yaw_rad_s]),
            int(q.timestamp_us) or None,
        )

    def status(self) -> link_interface.VehicleStatus:
        """Return armed state, flight mode and charge."""
        mode = FlightMode(self._telemetry.flight_mode())
        words = mode.name.lower().replace("_", " ")
        return link_interface.VehicleStatus(
            self.armed, mode is FlightMode.OFFBOARD, words, self.battery().remaining
        )

    def battery(self) -> link_interface.BatteryState:
        """Return the newest state of the battery."""
        told = self._telemetry.battery()
        percent, current_a = _known(told.remaining_percent), _known(told.current_battery_a)
        return link_interface.BatteryState(
            # 0 V means that no battery report was received yet.
            _known(told.voltage_v) or None,
            None if current_a == constants.UNMEASURED_A else current_a,
            None if percent is None else percent / 100.0,
        )

    def hear_texts(self, heard: Callable[[str], None]) -> None:
        """Call a function with the flight controller's texts, in an MAVSDK thread."""
        self._telemetry.subscribe_status_text(lambda status, _: heard(status.text))

    def arm(
        self,
        timeout_s: float,
        stop: threading.Event,
        origin: tuple[float, float, float] | None = None,
        watch: Watch = lambda _: None,
    ) -> None:
        """Wait until the flight controller reports good health, then arm; `stop` ends the wait.

        After a reboot, a health report may be out of date. Health must be good for
        `HEALTH_SETTLE_S`, and a rejected request is repeated. `origin` (latitude, longitude [deg],
        altitude [m]) is sent to a flight controller without a position. `watch` receives the
        telemetry of good health and may raise LinkError.
        """
        # The timeout covers health and arming together.
        deadline_us = self._deadline(timeout_s)
        good_since_us, tell_us = self._clock.time_us(), self._clock.time_us()
        missing: list[str] = []
        while self._clock.time_us() < good_since_us + int(HEALTH_SETTLE_S * constants.US_PER_S):
            lacking = f" ({', '.join(missing)})" if missing else ""
            late = f"not healthy after {timeout_s:g} s: it refuses to arm{lacking}"
            self._check(deadline_us, late, stop)
            self._pause()
            missing = self.missing_health(by_gps=origin is None)
            # An origin sent before PX4 has a local position would shift that position.
            local = self._telemetry.health().is_local_position_ok
            if origin is not None and "armable" in missing and local:
                tell_us = self._tell_origin(origin, tell_us)
            if missing:
                good_since_us = self._clock.time_us()
            else:
                watch(self.kinematics())
        self.check_alone()
        while True:
            try:
                self._action.arm()
                return
            except ActionError as error:
                self._check(deadline_us, f"arming failed: {_reason(error)}", stop)
                if self.dialect is mavsdk_connection.ARDUPILOT:
                    # After a landing MAVSDK arms in BRAKE, which ArduPilot refuses.
                    target = {"target_system": self._system.get_system_id()}
                    self.send_message("COMMAND_LONG", target | mavsdk_connection.SET_GUIDED)
                self._pause(ARM_RETRY_S)

    def _tell_origin(self, origin: tuple[float, float, float], due_us: int) -> int:
        """Send the origin if due; return the next due time [µs]. There is no acknowledgement."""
        now_us = self._clock.time_us()
        # The origin is repeated, because SET_GPS_GLOBAL_ORIGIN has no acknowledgement.
        if now_us < due_us:
            return due_us
        self._call("origin", lambda: self._action.set_gps_global_origin(*origin))
        return now_us + int(ORIGIN_RETRY_S * constants.US_PER_S)

    def takeoff(
        self,
        altitude_m: float,
        timeout_s: float,
        stop: threading.Event,
        watch: Watch = lambda _: None,
    ) -> None:
        """Take off and wait until an altitude above the start is reached, or `stop` is set.

        `watch` receives telemetry and may raise LinkError.
        """
        # Height counts from the start, since the local origin need not be at the ground.
        start_down = float(self.kinematics().position[2])
        self._call("take-off", lambda: self._action.set_takeoff_altitude(altitude_m))
        self._call("take-off", self._action.takeoff)
        deadline_us, least_m = self._deadline(timeout_s), altitude_m - constants.TAKEOFF_REACHED_M

        def left(frames: Sequence[bytes]) -> tuple[float, float]:
            """Return the remaining climb [m] and the climb speed [m/s]; NaN = unknown."""
            position = _newest(frames, _LOCAL_POSITION_NED)
            if position is None:
                return math.nan, math.nan
            # MAVLink 2 truncates trailing zeros of a payload.
            payload = position[_HEADER : _HEADER + position[1]].ljust(_DOWN.size, b"\0")
            down_m, down_m_s = _DOWN.unpack(payload)
            return least_m - (start_down - down_m), max(0.0, -down_m_s)

        def high(frames: Sequence[bytes]) -> bool:
            return left(frames)[0] < 0.0

        def lasts_us(frames: Sequence[bytes]) -> float:
            """Return the minimum remaining climb time [µs], for an acceleration of 1 g."""
            left_m, speed = left(frames)
            g = constants.GRAVITY_M_S2
            least_s = (math.sqrt(speed**2 + 2.0 * g * max(0.0, left_m)) - speed) / g
            return 0.0 if math.isnan(left_m) else least_s * constants.US_PER_S

        while True:
            watch(state := self.kinematics())
            height, speed = start_down - float(state.position[2]), abs(float(state.velocity[2]))
            # Height and speed must both settle before offboard.
            if height > least_m and speed < constants.TAKEOFF_REACHED_M_S:
                return
            self._check(deadline_us, f"take-off: {height:.1f} m after {timeout_s:g} s", stop)
            self._pause_until(high, lasts_us, deadline_us, stop)

    def enter_offboard(self) -> None:
        """Send a zero setpoint, switch to offboard and wait until setpoints take effect."""
        self.send_setpoint(link_interface.STOP)
        self._call("offboard", self._offboard.start)
        self._pause(OFFBOARD_SETTLE_S)

    def await_hover(self, altitude_m: float, timeout_s: float, stop: threading.Event) -> None:
        """Wait until telemetry, possibly at 1 Hz, shows the vehicle above half of an altitude."""
        deadline_us = self._deadline(timeout_s)
        while not -float(self.kinematics().position[2]) > altitude_m / 2:  # NaN without telemetry
            self._check(deadline_us, f"not in the air after {timeout_s:g} s", stop)
            self._pause()

    def await_offboard(self, stop: threading.Event) -> None:
        """Send zero velocity until a pilot switches the vehicle to offboard, or `stop` is set.

        PX4 rejects offboard without setpoints, and MAVSDK stops them at heartbeats of other modes.
        """
        while not self._flies_offboard():
            self._check(None, stop=stop)
            self.send_setpoint(link_interface.STOP)
            self._pause(OFFBOARD_REPEAT_S)
        self.check_alone()

    def _flies_offboard(self) -> bool:
        status = self.status()
        return status.armed and status.offboard and bool(self._telemetry.in_air())

    def tell(self, text: str) -> None:
        """Send a text of up to 50 characters, which may be forwarded to the ground station."""
        self._texts = self._texts or ServerUtility(self._system)
        self._texts.send_status_text(StatusTextType.INFO, text[:TEXT_CHARACTERS])

    def send_message(self, name: str, fields: Mapping[str, Any]) -> bool:
        """Send a MAVLink message by name and fields; return True if sent."""
        self._direct = self._direct or MavlinkDirect(self._system)
        try:
            self._direct.send_message(MavlinkMessage(name, fields_json=json.dumps(dict(fields))))
        except MavlinkDirectError:
            return False
        return True

    def _hear_messages(self, name: str, heard: Callable[[Any, Any], None]) -> None:
        """Call a function with every message of a name, in an MAVSDK thread."""
        self._direct = self._direct or MavlinkDirect(self._system)
        self._direct.subscribe_message(name, heard)

    def send_setpoint(self, setpoint: link_interface.Setpoint) -> None:
        """Send a setpoint; MAVSDK repeats it at 20 Hz until the next setpoint of any kind."""
        self.setpoints_sent += 1
        offboard = self._offboard
        try:
            # MAVSDK uses degrees.
            if isinstance(setpoint, link_interface.BodyVelocity):
                *velocity, yaw_rate = setpoint
                offboard.set_velocity_body(VelocityBodyYawspeed(*velocity, math.degrees(yaw_rate)))
                return
            # Three angles or rates in radians, and a thrust that needs no conversion.
            *angles, thrust = setpoint
            degrees = map(math.degrees, angles)
            if isinstance(setpoint, actions.Attitude):
                offboard.set_attitude(OffboardAttitude(*degrees, thrust))
            else:
                offboard.set_attitude_rate(AttitudeRate(*degrees, thrust))
        except OffboardError as error:
            raise link_interface.LinkError(f"setpoint refused: {_reason(error)}") from None

    def leave_offboard(self) -> None:
        """Switch to Hold; MAVSDK stops repeating setpoints."""
        self._call("leaving offboard", self._offboard.stop)

    def release(self) -> None:
        """Stop sending setpoints without a mode change: the pilot has control."""
        # MAVSDK's offboard stop requests Hold; destroying the plugin only stops repetitions.
        if self._offboard is not None:
            self._offboard.destroy()
            self._offboard = None

    def land(self, timeout_s: float) -> None:
        """Land and wait until disarmed."""
        self._call("landing", self._action.land)
        deadline_us = self._deadline(timeout_s)
        while self.armed:
            self._check(deadline_us, f"landing: still armed after {timeout_s:g} s")
            self._pause_until(_disarmed, lambda _: math.inf, deadline_us)

    def _call(self, what: str, call: Any) -> None:
        try:
            call()
        except (ActionError, OffboardError, TelemetryError) as error:
            raise link_interface.LinkError(f"{what} failed: {_reason(error)}") from None

    def _deadline(self, timeout_s: float) -> int:
        return self._clock.time_us() + int(timeout_s * constants.US_PER_S)

    def _check(
        self, deadline_us: int | None, message: str = "", stop: threading.Event | None = None
    ) -> None:
        if (why := self._over(deadline_us, message, stop)) is not None:
            raise link_interface.LinkError(why)

    def _over(
        self, deadline_us: int | None, message: str = "", stop: threading.Event | None = None
    ) -> str | None:
        """Return the reason to end a wait; None = continue."""
        # Order matters: a lost link explains the other conditions.
        if not self.connected:
            return "the flight controller is no longer heard"
        if self._abandon.is_set():
            return "abandoned"
        if stop is not None and stop.is_set():
            return "stopped"
        if deadline_us is not None and self._clock.time_us() >= deadline_us:
            return message
        return None

    def _pause(self, seconds: float = POLL_S) -> None:
        self._clock.sleep_until(self._clock.time_us() + int(seconds * constants.US_PER_S))

    def _pause_until(
        self,
        due: link_interface.Due,
        quiet_us: link_interface.Quiet,
        deadline_us: int,
        stop: threading.Event | None = None,
    ) -> None:
        """Wait for one `POLL_S`, or for several if `due` reports that the condition still fails."""
        if self._poll is None:
            self._pause()
        else:
            self._poll(
                int(POLL_S * constants.US_PER_S),
                lambda frames: due(frames) or self._over(deadline_us, stop=stop) is not None,
                quiet_us,
            )


def _newest(frames: Sequence[bytes], number: bytes) -> bytes | None:
    """Return the newest frame of a message; None without one."""
    return next((frame for frame in reversed(frames) if frame[7:10] == number), None)


def _disarmed(frames: Sequence[bytes]) -> bool:
    heartbeat = _newest(frames, _HEARTBEAT)
    return heartbeat is not None and not heartbeat[_HEADER + _BASE_MODE] & _ARMED


def _known(value: float) -> float | None:
    """Return a value of MAVSDK; None for NaN."""
    return float(value) if math.isfinite(value) else None


def _refusal(error: TelemetryError) -> str:
    if error.args[0] != TelemetryResult.TIMEOUT:
        return _reason(error)
    return (
        "the flight controller is heard, but answers nothing: it wants signed messages"
        " (--signing-key), or hears nothing"
    )


def _reason(error: Exception) -> str:
    result = error.args[0] if error.args else error
    return str(getattr(result, "name", result)).lower().replace("_", " ")
