"""A vehicle as rows see it: MAVSDK's plugins, and single MAVLink messages."""

from __future__ import annotations

import json
import math
import queue
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, TypeVar, cast

from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage
from mavsdk.plugins.telemetry import FlightMode, Telemetry

from airl_mav.core.constants import EARTH_RADIUS_M, US_PER_S
from tests.support.mavlink_clients import Companion

NO_ACK = "no ack"
ACK_S = 6.0
"""Timeout of an acknowledgement, as with MAVSDK's own retries [s of wall time]."""

_RESULTS = (
    *("ACCEPTED", "TEMPORARILY_REJECTED", "DENIED", "UNSUPPORTED", "FAILED"),
    *("IN_PROGRESS", "CANCELLED"),
)

_CLOCK_HZ = 50.0
"""Rate of the vehicle's time and position messages [Hz]."""

_STANDS_STILL_S = 60.0
"""Timeout of a wait while simulated time is stopped [wall s]."""

_LATE_S = 4.0
"""Maximum delay of MAVSDK's messages [wall s]."""

FAST, OFFBOARD = 16.0, 4.0
"""Maximum speed of a wait [simulated s a wall s]; MAVSDK repeats setpoints by the wall clock."""

Plugin = TypeVar("Plugin")
Pace = Callable[[float], AbstractContextManager[Callable[[float], None]]]
"""Runs simulated time at a speed inside the context, where supported; receives the time read."""


def _as_it_is(_speed: float) -> AbstractContextManager[Callable[[float], None]]:
    return nullcontext(lambda _now_s: None)


class RefusedError(Exception):
    """A call that is not one of MAVSDK's was refused, or a wait was in vain."""

    def __init__(self, outcome: str) -> None:
        super().__init__(outcome)
        self.outcome = outcome


class Vehicle:
    """A connected vehicle."""

    def __init__(self, companion: Companion, system_id: int = 1, *, pace: Pace = _as_it_is) -> None:
        self._companion = companion
        self._plugins: dict[type, Any] = {}
        self._pace = pace
        self._clock_set = False
        self.system_id = system_id

    # --- where it is

    @property
    def telemetry(self) -> Telemetry:
        """MAVSDK's telemetry."""
        return self.plugin(Telemetry)

    @property
    def mode(self) -> FlightMode:
        """The mode by its heartbeat."""
        return cast("FlightMode", self.telemetry.flight_mode())

    @property
    def position(self) -> tuple[float, float, float]:
        """North, east, down [m], as estimated."""
        p = self.telemetry.position_velocity_ned().position
        return p.north_m, p.east_m, p.down_m

    @property
    def velocity(self) -> tuple[float, float, float]:
        """North, east, down [m/s], as estimated."""
        v = self.telemetry.position_velocity_ned().velocity
        return v.north_m_s, v.east_m_s, v.down_m_s

    @property
    def yaw_deg(self) -> float:
        """Heading [deg]."""
        return float(self.telemetry.attitude_euler().yaw_deg)

    @property
    def height(self) -> float:
        """Height above home [m]."""
        return float(self.telemetry.position().relative_altitude_m)

    def is_near(self, north: float, east: float, within: float = 1.0) -> bool:
        """Return True if the vehicle is within some metres of a place, horizontally."""
        n, e, _ = self.position
        return math.hypot(n - north, e - east) < within

    def place(self, north: float, east: float) -> tuple[float, float]:
        """Return latitude and longitude [deg] of metres from the local origin."""
        origin = self.telemetry.get_gps_global_origin()
        return (
            origin.latitude_deg + math.degrees(north / EARTH_RADIUS_M),
            origin.longitude_deg
            + math.degrees(east / EARTH_RADIUS_M / math.cos(math.radians(origin.latitude_deg))),
        )

    # --- time

    @property
    def now_s(self) -> float:
        """Simulated time [s]."""
        if not self._clock_set:
            self._clock_set = True
            # PX4's calendar time is the host's; its odometry has the time of the simulation.
            self.telemetry.set_rate_odometry(_CLOCK_HZ)
            self.telemetry.set_rate_position_velocity_ned(_CLOCK_HZ)
        return float(self.telemetry.odometry().time_usec) / US_PER_S

    def until(self, condition: Callable[[], Any], limit_s: float, *, speed: float = FAST) -> None:
        """Wait for a condition. Raises RefusedError after a simulated time.

        On a loaded host, MAVSDK may be late by a wall time that is many times as long in simulated
        time: it is given `_LATE_S`.
        """
        end, late = self.now_s + limit_s, time.monotonic() + _LATE_S
        for _ in self._ticks(speed):
            if condition():
                return
            if self.now_s > end and time.monotonic() > late:
                raise RefusedError(f"not within {limit_s:g} s")

    def wait(
        self,
        seconds: float,
        each: Callable[[], object] | None = None,
        *,
        speed: float = FAST,
    ) -> None:
        """Let simulated time go by; call `each` at some 30 Hz."""
        end, due = self.now_s + seconds, 0.0
        for now in self._ticks(speed):
            if now >= end:
                return
            if each is not None and now >= due:
                each()
                due = now + 0.03

    def _ticks(self, speed: float) -> Any:
        """Yield the simulated time whenever it has moved. RefusedError: it is stopped."""
        before, deadline = 0.0, time.monotonic() + _STANDS_STILL_S
        with self._pace(speed) as seen:
            while True:
                now = self.now_s
                if now != before:
                    before, deadline = now, time.monotonic() + _STANDS_STILL_S
                    seen(now)
                    yield now
                elif time.monotonic() > deadline:
                    raise RefusedError("simulated time stands still")
                time.sleep(0.001)

    # --- requests

    def plugin(self, kind: Callable[..., Plugin]) -> Plugin:
        """Return one of MAVSDK's plugins; each is made once."""
        key = cast("type", kind)
        if key not in self._plugins:
            self._plugins[key] = self._companion.plugin(kind)
        return cast("Plugin", self._plugins[key])

    def send(self, name: str, **fields: Any) -> None:
        """Send a message; it goes to the vehicle where it has a target."""
        target = {"target_system": self.system_id, "target_component": 1}
        body = json.dumps(target | fields)
        self.plugin(MavlinkDirect).send_message(MavlinkMessage(name, 245, 190, 0, 0, body))

    def command(self, number: int, *params: float) -> str:
        """Send a COMMAND_LONG and return its result's name, or `NO_ACK`."""
        return self.command_and_message(number, *params)[0]

    def command_and_message(
        self, number: int, *params: float, message: str = "", wait_s: float = ACK_S
    ) -> tuple[str, dict[str, Any] | None]:
        """Send a COMMAND_LONG; return its result's name, and a message that comes with it."""
        filled = (*params, *(0.0,) * (7 - len(params)))
        fields = {f"param{i}": value for i, value in enumerate(filled, start=1)}
        with self.heard("COMMAND_ACK") as acks, self.heard(message or "COMMAND_ACK") as messages:
            # Once only: a loopback loses nothing, and a second answer would be taken for the next.
            self.send("COMMAND_LONG", command=number, confirmation=0, **fields)
            try:
                # MAVSDK sends requests, too: their answers must not prolong the wait.
                deadline = time.monotonic() + wait_s
                ack = {"command": None}
                while ack["command"] != number:
                    ack = acks.get(timeout=max(0.0, deadline - time.monotonic()))
                result = _RESULTS[ack["result"]]
            except queue.Empty:
                return NO_ACK, None
            if not message or result != "ACCEPTED":
                return result, None
            try:
                return result, messages.get(timeout=wait_s)
            except queue.Empty:
                return result, None

    @contextmanager
    def heard(self, name: str) -> Any:
        """Yield a queue of the messages of a name, as dictionaries."""
        messages: queue.Queue[dict[str, Any]] = queue.Queue()
        direct = self.plugin(MavlinkDirect)
        handle = direct.subscribe_message(
            name, lambda message, _: messages.put(json.loads(message.fields_json))
        )
        try:
            yield messages
        finally:
            direct.unsubscribe_message(handle)
