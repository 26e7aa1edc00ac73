"""The companion's link to the flight controller: MAVSDK, as on the real aircraft.

MAVSDK's synchronous API: a call is a plain C call, while the asyncio one adds a thread hop.
MAVSDK sends a setpoint at once and then repeats it at 20 Hz from a thread of its own, also when
this process hangs; `watchdog.py` is there for that.
"""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from mavsdk import ComponentType, Configuration, ConnectionResult, Mavsdk
from mavsdk.logging import log_subscribe
from mavsdk.plugins.action import Action, ActionError
from mavsdk.plugins.offboard import Offboard, OffboardError, VelocityBodyYawspeed
from mavsdk.plugins.server_utility import ServerUtility, StatusTextType
from mavsdk.plugins.telemetry import LandedState, Telemetry, TelemetryError

from airl_mav.clock import Clock, WallClock
from airl_mav.constants import US_PER_S
from airl_mav.errors import UsageError
from airl_mav.policy.observation import Kinematics

RATE_HZ = 50.0
"""Rate asked for position, velocity and attitude [Hz]."""

POLL_S = 0.1
"""How often a condition is looked at while waiting for it [s]."""

CONNECT_SLICE_S = 0.5
"""Longest single wait for a flight controller [wall s]."""

HEALTH_SETTLE_S = 0.5
"""Good health must last so long before arming: more than two of PX4's 5 Hz reports [s]."""

ARM_RETRY_S = 0.5
"""Time between two requests to arm [s]."""

RAW_URL = "raw://"
"""Connection without sockets: the bytes are exchanged with this process, see `exchange_raw`."""

RAW_CHUNK = 65_536
"""Bytes that are fed at a time; MAVSDK's parser puts a divided frame together again."""

RAW_TIMEOUT_S = 3600.0
"""MAVSDK's time-out of a command on a raw connection [wall s]. Its answer is certain, but not when
by the wall clock: a stopped process must not repeat commands when it goes on."""


class LinkError(Exception):
    """The flight controller refused, or is gone."""


@dataclass(frozen=True)
class BodyVelocity:
    """A velocity setpoint in the heading frame, with a yaw rate."""

    forward_m_s: float
    right_m_s: float
    down_m_s: float
    yaw_rate_rad_s: float

    def wire(self) -> tuple[float, float, float, float]:
        """Return the four numbers in the order in which they are sent."""
        return self.forward_m_s, self.right_m_s, self.down_m_s, self.yaw_rate_rad_s


STOP = BodyVelocity(0.0, 0.0, 0.0, 0.0)


class Link(Protocol):
    """What the pilot needs of a flight controller. Calls raise LinkError when refused."""

    @property
    def connected(self) -> bool:
        """Whether the flight controller is heard."""
        ...

    def kinematics(self) -> Kinematics:
        """Return the newest telemetry."""
        ...

    def set_velocity_body(self, setpoint: BodyVelocity) -> None:
        """Send a velocity setpoint; it is repeated until the next one."""
        ...

    def leave_offboard(self) -> None:
        """Switch to Hold."""
        ...


class MavsdkLink:
    """MAVSDK over UDP, serial or raw bytes. Implements `Link`."""

    def __init__(
        self,
        url: str,
        clock: Clock,
        abandon: threading.Event | None = None,
        heard: Callable[[], bool] | None = None,
    ) -> None:
        """Open a connection; `connect` waits for the vehicle.

        Args:
            url: MAVSDK connection, `udpin://127.0.0.1:14540`, `serial:///dev/ttyAMA0:921600` or
                `raw://`.
            clock: For time-outs.
            abandon: Set from another thread to break off whatever is being waited for.
            heard: Whether the flight controller is heard, where the wall clock does not tell;
                None = MAVSDK's word.

        Raises:
            UsageError: The URL is invalid or its port is taken.
        """
        self.url = url
        self._clock = clock
        self._abandon = abandon or threading.Event()
        self._heard = heard
        self.setpoints_sent = 0
        """Setpoints handed to MAVSDK so far, its own repetitions not counted."""
        # MAVSDK's own log goes to standard output; its findings reach us as results.
        log_subscribe(lambda *_: True)
        configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
        self._mavsdk = Mavsdk(configuration)
        result = self._mavsdk.add_any_connection(url)
        if result != ConnectionResult.SUCCESS:
            self._mavsdk.destroy()
            raise UsageError(_connection_problem(url, result))
        self._system: Any = None
        self._telemetry: Any = None
        self._action: Any = None
        self._offboard: Any = None
        self._texts: Any = None

    def connect(self, timeout_s: float, stop: threading.Event | None = None) -> None:
        """Wait for a flight controller. Raises LinkError when none is heard in time [wall s].

        `stop`, set from outside, breaks off the wait.
        """
        stopwatch = WallClock()
        system = None
        while system is None:
            if stop is not None and stop.is_set():
                raise LinkError("stopped")
            left_s = timeout_s - stopwatch.time_us() / US_PER_S
            if left_s <= 0.0:
                raise LinkError(f"no flight controller heard on {self.url} in {timeout_s:g} s")
            # In slices: a signal is only noticed between two calls into MAVSDK.
            system = self._mavsdk.first_autopilot(min(left_s, CONNECT_SLICE_S))
        self._system = system
        self._telemetry = Telemetry(system)
        self._action = Action(system)
        self._offboard = Offboard(system)
        self._call("telemetry", lambda: self._telemetry.set_rate_position_velocity_ned(RATE_HZ))
        self._call("telemetry", lambda: self._telemetry.set_rate_attitude_quaternion(RATE_HZ))

    def exchange_raw(self, sent: Callable[[bytes], None]) -> Callable[[bytes], None]:
        """Take over the bytes of a `raw://` connection.

        Args:
            sent: Called with every MAVLink frame that MAVSDK sends, from MAVSDK's own thread: it
                must return at once and take no lock that somebody who feeds bytes may hold.

        Returns:
            What to feed MAVSDK with, whole frames, from one thread at a time.
        """
        self.set_timeout(RAW_TIMEOUT_S)
        library, handle = self._mavsdk._lib, self._mavsdk._handle
        self._mavsdk.subscribe_raw_bytes_to_be_sent(sent)
        # MAVSDK-Python's own function makes a ctypes array type for every length of `data`: 0.1 ms.
        buffer = (ctypes.c_uint8 * RAW_CHUNK)()
        pass_bytes = library.mavsdk_pass_received_raw_bytes

        def feed(data: bytes) -> None:
            for start in range(0, len(data), RAW_CHUNK):
                chunk = data[start : start + RAW_CHUNK]
                ctypes.memmove(buffer, chunk, len(chunk))
                pass_bytes(handle, buffer, len(chunk))

        return feed

    def set_timeout(self, seconds: float) -> None:
        """Let MAVSDK repeat what has not been answered after so long [wall s], not after 0.5 s."""
        # Exported by the library, not wrapped by MAVSDK-Python 4.1.
        set_timeout = self._mavsdk._lib.mavsdk_set_timeout_s
        set_timeout.argtypes = [ctypes.c_void_p, ctypes.c_double]
        set_timeout(self._mavsdk._handle, seconds)

    def exchange_texts(self, heard: Callable[[str], None]) -> Callable[[str], None]:
        """Exchange STATUSTEXTs with the flight controller; `connect` comes first.

        Args:
            heard: Called with every text, from a thread of MAVSDK's: all telemetry that came before
                has been taken in by then. It must return at once.

        Returns:
            What sends a text of at most 50 characters, behind all that was sent before.
        """
        self._texts = texts = ServerUtility(self._system)
        self._telemetry.subscribe_status_text(lambda status, _: heard(status.text))

        def send(text: str) -> None:
            texts.send_status_text(StatusTextType.DEBUG, text)

        return send

    def close(self) -> None:
        """Release MAVSDK."""
        for plugin in (self._texts, self._offboard, self._action, self._telemetry):
            if plugin is not None:
                plugin.destroy()
        self._mavsdk.destroy()

    @property
    def connected(self) -> bool:
        """Whether heartbeats of the flight controller arrive (MAVSDK allows gaps of 3 s)."""
        if self._system is None:
            return False
        return bool(self._system.is_connected()) if self._heard is None else self._heard()

    @property
    def healthy(self) -> bool:
        """Whether the flight controller reports good sensors and that it may be armed."""
        telemetry = self._telemetry
        return bool(telemetry.health_all_ok() and telemetry.health().is_armable)

    @property
    def armed(self) -> bool:
        """Whether the heartbeat says armed (known up to 1 s late)."""
        return bool(self._telemetry.armed())

    @property
    def on_ground(self) -> bool:
        """Whether the landing detector says on ground."""
        return bool(self._telemetry.landed_state() == LandedState.ON_GROUND)

    @property
    def flight_mode(self) -> str:
        """Flight mode as the heartbeat says it (known up to 1 s late)."""
        return str(self._telemetry.flight_mode().name)

    def kinematics(self) -> Kinematics:
        """Return the newest position, velocity and attitude."""
        pv = self._telemetry.position_velocity_ned()
        q = self._telemetry.attitude_quaternion()
        p, v = pv.position, pv.velocity
        return Kinematics(
            np.array([p.north_m, p.east_m, p.down_m]),
            np.array([v.north_m_s, v.east_m_s, v.down_m_s]),
            np.array([q.w, q.x, q.y, q.z]),
        )

    def arm(self, timeout_s: float, stop: threading.Event) -> None:
        """Wait until the flight controller reports good health, then arm.

        Its health is told a few times a second: right after a reboot, old news may still be good
        news. So it must have been good for a while, and a refused request is repeated. `stop`, set
        from outside, breaks off the wait.
        """
        deadline_us = self._deadline(timeout_s)
        good_since_us = self._clock.time_us()
        while self._clock.time_us() < good_since_us + int(HEALTH_SETTLE_S * US_PER_S):
            self._check(deadline_us, f"not healthy after {timeout_s:g} s: it refuses to arm", stop)
            self._pause()
            if not self.healthy:
                good_since_us = self._clock.time_us()
        while True:
            try:
                self._action.arm()
                return
            except ActionError as error:
                self._check(deadline_us, f"arming failed: {_reason(error)}", stop)
                self._pause(ARM_RETRY_S)

    def takeoff(self, altitude_m: float, timeout_s: float, stop: threading.Event) -> None:
        """Take off and return when the altitude above the start is reached.

        `stop`, set from outside, breaks off the climb.
        """
        start_down = float(self.kinematics().position[2])
        self._call("take-off", lambda: self._action.set_takeoff_altitude(altitude_m))
        self._call("take-off", self._action.takeoff)
        deadline_us = self._deadline(timeout_s)
        while True:
            state = self.kinematics()
            height = start_down - float(state.position[2])
            if height > 0.85 * altitude_m and abs(float(state.velocity[2])) < 0.3:
                return
            self._check(deadline_us, f"take-off: {height:.1f} m after {timeout_s:g} s", stop)
            self._pause()

    def enter_offboard(self) -> None:
        """Send a standing setpoint and switch to offboard."""
        self.set_velocity_body(STOP)
        self._call("offboard", self._offboard.start)

    def set_velocity_body(self, setpoint: BodyVelocity) -> None:
        """Send a velocity setpoint; MAVSDK repeats it at 20 Hz until the next one."""
        s = setpoint
        self.setpoints_sent += 1
        yaw_rate_deg_s = math.degrees(s.yaw_rate_rad_s)
        try:
            self._offboard.set_velocity_body(
                VelocityBodyYawspeed(s.forward_m_s, s.right_m_s, s.down_m_s, yaw_rate_deg_s)
            )
        except OffboardError as error:
            raise LinkError(f"setpoint refused: {_reason(error)}") from None

    def leave_offboard(self) -> None:
        """Switch to Hold; MAVSDK stops repeating setpoints."""
        self._call("leaving offboard", self._offboard.stop)

    def land(self, timeout_s: float) -> None:
        """Land and return when disarmed."""
        self._call("landing", self._action.land)
        deadline_us = self._deadline(timeout_s)
        while self.armed:
            self._check(deadline_us, f"landing: still armed after {timeout_s:g} s")
            self._pause()

    def _call(self, what: str, call: Any) -> None:
        try:
            call()
        except (ActionError, OffboardError, TelemetryError) as error:
            raise LinkError(f"{what} failed: {_reason(error)}") from None

    def _deadline(self, timeout_s: float) -> int:
        return self._clock.time_us() + int(timeout_s * US_PER_S)

    def _check(self, deadline_us: int, message: str, stop: threading.Event | None = None) -> None:
        if not self.connected:
            raise LinkError("the flight controller is no longer heard")
        if self._abandon.is_set():
            raise LinkError("abandoned")
        if stop is not None and stop.is_set():
            raise LinkError("stopped")
        if self._clock.time_us() >= deadline_us:
            raise LinkError(message)

    def _pause(self, seconds: float = POLL_S) -> None:
        self._clock.sleep_until(self._clock.time_us() + int(seconds * US_PER_S))


def _reason(error: Exception) -> str:
    """Return MAVSDK's result name."""
    result = error.args[0] if error.args else error
    return str(getattr(result, "name", result)).lower().replace("_", " ")


def _connection_problem(url: str, result: Any) -> str:
    name = result.name.lower().replace("_", " ")
    if result == ConnectionResult.BIND_ERROR:
        return (
            f"--connect {url}: the port is taken (another companion?): choose another "
            "(airl-sitl: --api-port)"
        )
    return f"--connect {url}: {name}; accepted: udpin://HOST:PORT, serial://DEVICE:BAUD"
