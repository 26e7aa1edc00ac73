"""Vehicle that flies elsewhere: its telemetry as the motion of a body in the arena.

A flight starts where the vehicle stands: the arena's origin is there, its north is the heading.
Poses come from the true state, else from the estimate. PX4 sends the true state without a time
(`HIL_STATE_QUATERNION.hpp`): the time of the attitude beside it limits its delay on the link.
"""

from __future__ import annotations

import re
import select
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from airl_mav.core import constants, errors, frames
from airl_mav.core.clock import WallClock
from airl_mav.profiles.vehicle import CORNERS
from airl_mav.scenario.aircraft import RealFirmware
from airl_mav.vehicle.rotation import Vec
from firmware_sim import interfaces
from firmware_sim.addons.kernel_plant.ground_contact import FLOOR_ID
from firmware_sim.addons.kernel_plant.kernel_body import KernelBody
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.external import flight_stack, hil_messages, observer, parameters, programs
from firmware_sim.external.launcher import Launcher
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.endpoint import Address, UdpEndpoint
from firmware_sim.plant.plant import REST_SPEED_M_S

BEHIND_US = 30_000
"""Delay of the ticks [µs], by which a pose of both sides of a tick has arrived: one interval, the
period of PX4's sender (10 ms) and a busy host."""

POSE_US = 10_000
"""Requested interval of poses [µs]."""

AHEAD_US = 200_000
"""Maximum time by which a pose is extrapolated [µs]; then the vehicle stops."""

LATE_US = 12_000
"""Maximum delay of a pose without a time after the newest message with one [µs]."""

SLOWEST = 0.2
"""Maximum share by which the vehicle's clock lags for a moment."""

MEASURED_US = 2 * constants.US_PER_S
"""Time over which the vehicle's clock is measured before a flight [µs]."""

SILENT_TICKS = constants.TICK_HZ
"""Ticks without a pose after which the vehicle is lost."""

PACE = 0.9, 1.1
"""Speed of the vehicle's clock in real time; PX4's SIH runs at 0.97."""

KEPT = 64
"""Poses kept for interpolation."""

HOLD = 4, 3
"""PX4's main and sub mode of Hold (px4_custom_mode.h); ArduPilot is armed in GUIDED."""

_URL = re.compile(r"udpin://([^:/]+):(\d+)")
_LISTEN_S = 0.02

ESTIMATE = "ATTITUDE_QUATERNION"
SOURCES = {
    "HIL_STATE_QUATERNION": "true state (HIL_STATE_QUATERNION)",
    "SIM_STATE": "true state (SIM_STATE)",
    ESTIMATE: "estimate (LOCAL_POSITION_NED, ATTITUDE_QUATERNION)",
}
"""Messages with poses and their titles, best first."""

POSES = {*SOURCES, "LOCAL_POSITION_NED"}
TELEMETRY = {**observer.INTERVALS_US, **dict.fromkeys(POSES, POSE_US)}

_EULER_RATES = "rollspeed", "pitchspeed", "yawspeed"
_POSITION, _VELOCITY, _ATTITUDE, _RATES = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)


class VehicleClock:
    """Clock of the vehicle, by the fastest of its messages."""

    def __init__(self) -> None:
        self.newest_us: int | None = None
        """Vehicle's time of the newest message [µs]."""
        self._gap_us = 0.0
        self._first = self._last = 0, 0

    def hear(self, time_us: int, now_us: int) -> None:
        """Take a message with the vehicle's time, which arrived at `now_us` [µs]."""
        gap_us = now_us - time_us
        if self.newest_us is None:
            self._first, self._gap_us = (time_us, now_us), gap_us
        else:
            # A later message was delayed, unless the vehicle's clock is slow.
            self._gap_us += SLOWEST * max(0, now_us - self._last[1])
        self._gap_us = min(self._gap_us, gap_us)
        self.newest_us, self._last = time_us, (time_us, now_us)

    def at(self, now_us: int) -> int:
        """Return the vehicle's time [µs] at `now_us`."""
        return now_us - round(self._gap_us)

    @property
    def pace(self) -> float | None:
        """Vehicle's seconds per second; None before `MEASURED_US`."""
        passed_us = self._last[1] - self._first[1]
        return (self._last[0] - self._first[0]) / passed_us if passed_us > MEASURED_US else None


class VehicleTelemetry(observer.FirmwareObserver):
    """Observer that also keeps the vehicle's poses, by its clock."""

    intervals_us = TELEMETRY

    def restart(self) -> None:
        """Reset all state before a flight."""
        super().restart()
        self.clock = VehicleClock()
        self.source = ""
        """Message whose poses are flown; empty before `place`."""
        self.tick_us = 0
        """Time of the tick whose motion is next [µs]."""
        self.silent_ticks = 0
        self._poses: dict[str, deque[tuple[int, frames.Vector]]] = {
            name: deque(maxlen=KEPT) for name in SOURCES
        }
        """Times [µs] and rows (13,): position and velocity NED, attitude, rates."""
        self._local: tuple[int, frames.Vector] | None = None
        """Time and estimated position and velocity (6,)."""
        self._zero: frames.Geodetic | None = None
        self._start = self._local_start = np.zeros(3)
        self._yaw = 0.0

    # --- received messages

    def _take(self, message: WireMessage) -> bool:
        taken = super()._take(message)
        if self._asked_us < 0:
            # Request also the rate of messages that come unrequested.
            self._came.clear()
        name = message.get_type()
        if name not in POSES or message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
            return taken
        if name == "LOCAL_POSITION_NED":
            self._local = _us(message), _row(message, "x", "y", "z", "vx", "vy", "vz")
        elif name == ESTIMATE:
            self.clock.hear(_us(message), self._now_us)
            if self._local is not None:
                at_us, moved = self._local
                ahead_s = (_us(message) - at_us) / constants.US_PER_S
                place, velocity = moved[:3] + ahead_s * moved[3:], moved[3:]
                turn = _row(message, "q1", "q2", "q3", "q4", *_EULER_RATES)
                self._add(name, _us(message), np.concatenate([place, velocity, turn]))
        elif (newest_us := self.clock.newest_us) is not None:
            point, motion = _truth(name, message)
            self._zero = self._zero or point
            row = np.concatenate([frames.geodetic_to_local(point, self._zero), motion])
            time_us = min(self.clock.at(self._now_us), newest_us + LATE_US)
            self._add(name, max(time_us, newest_us), row)
        return True

    def _add(self, name: str, time_us: int, row: frames.Vector) -> None:
        poses, turn = self._poses[name], row[_ATTITUDE]
        size = np.linalg.norm(turn)
        if not np.isfinite(row).all() or size < 0.5 or (poses and time_us <= poses[-1][0]):
            return
        # The nearer sign, for interpolation.
        turn /= -size if poses and turn @ poses[-1][1][_ATTITUDE] < 0.0 else size
        poses.append((time_us, row))
        if name == self.source:
            self.silent_ticks = 0

    # --- before a flight

    @property
    def armed(self) -> bool:
        """True if the heartbeat reports armed."""
        beat = self._heard
        return beat is not None and bool(beat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def lacking(self) -> str | None:
        """Missing condition of a flight; None = it can start."""
        pace = self.clock.pace
        if not self.heard:
            return "no heartbeat of a flight controller"
        if pace is None or not self._poses[ESTIMATE]:
            return "no ATTITUDE_QUATERNION and LOCAL_POSITION_NED"
        if not PACE[0] < pace < PACE[1]:
            return f"its clock runs at {pace:.2g} x real time (accepted: 1)"
        if self.armed:
            return "it is armed (accepted: landed and disarmed)"
        return None if self.ready else f"it is not ready to arm; it said: {self.last_text or '-'}"

    def leave_offboard(self) -> None:
        """Switch to Hold: PX4 returns to Offboard after a landing, and cannot be armed there."""
        if self._asked_us == self._now_us and self.flight(armed=False).mode is Mode.OFFBOARD:
            self._command(dialect.MAV_CMD_DO_SET_MODE, 1, *HOLD)

    def place(self, half_height_m: float) -> None:
        """Place the arena's start at the vehicle, which stands; restart the clock."""
        self.source = next(name for name in SOURCES if self._poses[name])
        estimate, row = self._poses[ESTIMATE][-1][1], self._poses[self.source][-1][1]
        self._start = row[_POSITION] + np.array([0.0, 0.0, half_height_m])
        self._yaw = frames.quat_yaw(row[_ATTITUDE])
        self._local_start = estimate[_POSITION]
        # Times of arrival count from another zero in the flight.
        self.clock, self._beat_us, self._asked_us = VehicleClock(), 0, 0

    def local(self, goal: frames.Goal) -> frames.Goal:
        """Return a goal of the arena in the vehicle's local frame, also north, east, down."""
        away = frames.heading_to_ned(np.array([*goal, 0.0][:3]), self._yaw)
        north, east, down = (self._local_start + away).tolist()
        return (north, east) if len(goal) == 2 else (north, east, down)

    # --- in flight

    def motion(self) -> frames.Vector:
        """Return the motion (13,) in the arena at the tick, `BEHIND_US` before it was known."""
        poses, clock = self._poses[self.source], self.clock
        time_us = poses[-1][0]
        if clock.newest_us is not None:
            time_us = clock.at(self.tick_us - BEHIND_US)
        row = pose_at(poses, time_us)
        turned = frames.quat_from_euler(0.0, 0.0, -self._yaw)
        row[_POSITION] = frames.ned_to_heading(row[_POSITION] - self._start, self._yaw)
        row[_VELOCITY] = frames.ned_to_heading(row[_VELOCITY], self._yaw)
        row[_ATTITUDE] = frames.quat_normalize(frames.quat_multiply(turned, row[_ATTITUDE]))
        return row


def pose_at(poses: Sequence[tuple[int, frames.Vector]], time_us: int) -> frames.Vector:
    """Return the row (13,) of poses at a time [µs]: interpolated, or extrapolated by its rates."""
    later = None
    for at_us, row in reversed(poses):
        if at_us <= time_us:
            break
        later = at_us, row
    if later is None:
        dt = min(time_us - at_us, AHEAD_US) / constants.US_PER_S
        turn = np.array([1.0, *(0.5 * dt * row[_RATES])])
        turned = frames.quat_multiply(row[_ATTITUDE], turn)
        return np.concatenate(
            [row[_POSITION] + dt * row[_VELOCITY], row[_VELOCITY], turned, row[_RATES]]
        )
    share = max(0, time_us - at_us) / max(1, later[0] - at_us)
    return row + share * (later[1] - row)


def _us(message: WireMessage) -> int:
    return int(message.time_boot_ms) * constants.US_PER_MS


def _row(message: WireMessage, *fields: str) -> frames.Vector:
    return np.array([getattr(message, name) for name in fields], np.float64)


def _truth(name: str, message: WireMessage) -> tuple[frames.Geodetic, frames.Vector]:
    """Return place, and velocity, attitude and rates (10,), of a true state."""
    if name == "SIM_STATE":
        # The extension has the digits that 32 bits lack.
        exact = message.lat_int / 1e7, message.lon_int / 1e7
        place = frames.Geodetic(*(exact if any(exact) else (message.lat, message.lon)), message.alt)
        turn = "q1", "q2", "q3", "q4", "xgyro", "ygyro", "zgyro"
        return place, _row(message, "vn", "ve", "vd", *turn)
    place = frames.Geodetic(message.lat / 1e7, message.lon / 1e7, message.alt / 1e3)
    velocity = _row(message, "vx", "vy", "vz") / 1e2
    turn = message.attitude_quaternion
    return place, np.concatenate([velocity, turn, _row(message, *_EULER_RATES)])


class AttachedBody(KernelBody):
    """Body that follows the telemetry. Its contacts move nothing."""

    def __init__(self, vehicle: VehicleTelemetry, *others: Any) -> None:
        """Follow a vehicle; `others` as `KernelBody`."""
        self._vehicle = vehicle
        super().__init__(*others)

    def move(self, at: Vec, force: Vec, torque: Vec, before: frames.Vector, moving_us: int) -> Any:
        """Move the body to the vehicle's pose and find its contacts; see `PlantBody`."""
        del at, force, torque, before
        told = self._vehicle.motion()
        parts: Any = (_POSITION, _VELOCITY, _ATTITUDE, _RATES)
        here, *others = (tuple(told[each].tolist()) for each in parts)
        motion, none = self.put(here, *others), (0.0, 0.0, 0.0)
        super().move(here, none, none, motion, moving_us)
        if np.linalg.norm(told[_VELOCITY]) <= REST_SPEED_M_S:
            # The plant would keep a vehicle at rest on the floor there.
            floor = frozenset({FLOOR_ID})
            self.touch = self.touch._replace(
                close=self.touch.close - floor, pressed=self.touch.pressed - floor
            )
        return motion


class AttachedBridge:
    """Bridge to an attached vehicle, for one flight. Implements `Bridge`."""

    rate_hz = constants.TICK_HZ
    time_us: int = 0

    def __init__(self, vehicle: VehicleTelemetry, url: str, half_height_m: float) -> None:
        """Set the vehicle, the URL of its link, and half the height of its body [m]."""
        self._vehicle, self._url, self._half_height_m = vehicle, url, half_height_m
        self.armed = False

    def wait_connected(self, timeout_s: float, alive: Callable[[], None]) -> None:
        """Wait until the vehicle stands, disarmed and ready, and place the arena there."""
        vehicle, stopwatch = self._vehicle, WallClock()
        while (lacking := vehicle.lacking) is not None:
            alive()
            now_us = stopwatch.time_us()
            if now_us > timeout_s * constants.US_PER_S:
                raise interfaces.FirmwareMissingError(
                    f"--connect {self._url}: vehicle not ready in {timeout_s:g} s: {lacking}"
                )
            select.select(vehicle.filenos(), [], [], _LISTEN_S)
            vehicle.receive(stopwatch.time_us())
            vehicle.send(stopwatch.time_us())
            vehicle.leave_offboard()
        vehicle.place(self._half_height_m)

    def step(self, sample: interfaces.SensorSample) -> interfaces.ActuatorControls:
        """Set the next tick; the simulated motors are stopped. Raises FirmwareLostError."""
        vehicle = self._vehicle
        vehicle.tick_us = sample.time_us + constants.TICK_US
        vehicle.silent_ticks += 1
        if vehicle.silent_ticks > SILENT_TICKS:
            raise interfaces.FirmwareLostError(f"{self._url}: no {vehicle.source} for 1 s")
        self.armed = vehicle.armed
        return interfaces.ActuatorControls(sample.time_us, hil_messages.STILL, self.armed)

    def use_truth(self, truth: Callable[[], interfaces.TrueState]) -> None:
        """Ignore the true state, which comes from the vehicle."""

    def close(self) -> None:
        """Do nothing: the vehicle keeps running."""


def address_of(real: RealFirmware) -> Address:
    """Return the address of the link to the vehicle. Raises FieldError."""
    found = _URL.fullmatch(real.connect or "")
    if found is None:
        raise errors.FieldError("real.connect", real.connect, "udpin://HOST:PORT")
    return found[1], int(found[2])


_AIRFRAME = parameters.RequiredAirframe("vehicle", CORNERS, {}, {}, lambda _: None)
"""Nothing is required: the vehicle is flown as it is."""


def attach_parts(
    request: flight_stack.FirmwareRequest,
) -> tuple[Launcher, observer.FirmwareObserver]:
    """Bind the link to the vehicle. Return a launcher that starts nothing, and the observer."""
    real, option = request.aircraft.real, "--connect"
    # Listens at any given address, like the companion's --connect.
    endpoint = UdpEndpoint(address_of(real), None, option, option, insecure=True)
    vehicle = VehicleTelemetry(endpoint, "observer", request.vehicle.told_origin)
    half_height_m = 0.5 * request.vehicle.body.height_m

    launcher = Launcher(
        _AIRFRAME,
        lambda: AttachedBridge(vehicle, real.connect or "", half_height_m),
        real.firmware_timeout,
        farewell=None,
    )
    launcher.body_by, launcher.local = partial(AttachedBody, vehicle), vehicle.local
    launcher.title = lambda: SOURCES[vehicle.source]
    return launcher, vehicle


ATTACH = programs.FirmwareKind(
    airframe=lambda _: _AIRFRAME,
    parameter_file=lambda _: "",
    parts=f"{__name__}:attach_parts",
    check_program=address_of,
    behind_us=BEHIND_US,
)
