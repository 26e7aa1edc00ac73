"""Messages to the vehicle's network: ONBOARD_COMPUTER_STATUS and OBSTACLE_DISTANCE.

Obstacles are taken from the newest depth image around the camera's height, level at any tilt.
Directions without a return within range are free, directions outside the field of view unknown.
"""

from __future__ import annotations

import math
import os
import socket
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from typing import Any, Protocol

import numpy as np
import psutil
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.frames import Vector, quats_to_euler
from airl_mav.core.machine import temperature_c
from airl_mav.policy.images import NEAREST_M, level_scan, rays_of, tilt_of
from airl_mav.policy.observation import Kinematics
from companion.frame_source import FrameSource


@contextmanager
def every(period_us: int, act: Callable[[], object], clock: Clock, name: str) -> Iterator[None]:
    """Call `act` immediately and once per period [µs] in a named thread, skipping missed calls."""
    ended = threading.Event()

    def go_on() -> None:
        due_us = clock.time_us()
        while not ended.is_set():
            act()
            # A late call moves the schedule instead of causing a burst.
            due_us = max(due_us + period_us, clock.time_us())
            clock.sleep_until(due_us, ended)

    thread = threading.Thread(target=go_on, name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


MESSAGE = "ONBOARD_COMPUTER_STATUS"

PERIOD_US = US_PER_S

NOT_KNOWN_8, NOT_KNOWN_16, NOT_KNOWN_32 = 2**8 - 1, 2**15 - 1, 2**32 - 1
"""Values for "not known" in fields of uint8, int16 and uint32 (common.xml)."""

NO_TEMPERATURE = 2**7 - 1
"""Value for "not known" in temperatures, int8 [°C]."""

CORES, BYTES_PER_MIB = 8, 2**20

STORAGES = ("storage_type", "storage_usage", "storage_total")
LINKS = ("link_type", "link_tx_rate", "link_rx_rate", "link_tx_max", "link_rx_max")


class MessageSender(Protocol):
    """Sender of MAVLink messages to the vehicle's network, such as `MavsdkLink`."""

    def send_message(self, name: str, fields: Mapping[str, Any]) -> bool:
        """Send a message by name and fields; return True if sent."""


def computer_status(
    now_us: int, cores_percent: Sequence[float], ram_bytes: tuple[int, int], celsius: float | None
) -> dict[str, Any]:
    """Return the fields of the message at a time since the start [µs].

    The loads of the first 8 cores are sent. `ram_bytes` is used and total memory [bytes].
    """
    # The message has room for 8 cores; more are dropped.
    cores = [round(percent) for percent in cores_percent[:CORES]]
    # 127 means unknown, so the maximum is 126.
    temperature = NO_TEMPERATURE if celsius is None else max(-128, min(126, round(celsius)))
    return {
        "time_usec": now_us,
        "uptime": now_us // US_PER_MS,
        "type": 0,  # the mission computer
        "cpu_cores": cores + [NOT_KNOWN_8] * (CORES - len(cores)),
        "cpu_combined": [NOT_KNOWN_8] * 10,
        "gpu_cores": [NOT_KNOWN_8] * 4,
        "gpu_combined": [NOT_KNOWN_8] * 10,
        "temperature_board": NO_TEMPERATURE,
        "temperature_core": [temperature] + [NO_TEMPERATURE] * (CORES - 1),
        "fan_speed": [NOT_KNOWN_16] * 4,
        "ram_usage": ram_bytes[0] // BYTES_PER_MIB,
        "ram_total": ram_bytes[1] // BYTES_PER_MIB,
        **dict.fromkeys(STORAGES, [NOT_KNOWN_32] * 4),
        **dict.fromkeys(LINKS, [NOT_KNOWN_32] * 6),
    }


def _measured(now_us: int) -> dict[str, Any]:
    memory = psutil.virtual_memory()
    ram_bytes = memory.total - memory.available, memory.total
    return computer_status(now_us, psutil.cpu_percent(percpu=True), ram_bytes, temperature_c())


def present(
    link: MessageSender, clock: Clock, measure: Callable[[int], dict[str, Any]] = _measured
) -> AbstractContextManager[None]:
    """Send the computer's status (`measure`) from a thread while the context is active."""
    return every(
        PERIOD_US,
        lambda: link.send_message(MESSAGE, measure(clock.time_us())),
        clock,
        "presence",
    )


OBSTACLES = "OBSTACLE_DISTANCE"

OBSTACLES_US = US_PER_S // 10
"""Interval of messages [µs]; PX4 discards distances after 0.5 s."""

OLDEST_US = US_PER_S // 4
"""Maximum age of a used image [µs]."""

BINS = 72
BIN_RAD = math.radians(5.0)
"""Minimum width of a bin [rad], equal to the bins of PX4's map."""

UNKNOWN_CM = 65_535

SENSOR_TYPE_UNKNOWN, FRAME_BODY_FRD = 4, 12
"""MAV_DISTANCE_SENSOR and MAV_FRAME (common.xml)."""


class VehicleLink(MessageSender, Protocol):
    """Source of the vehicle's attitude and sender of messages, such as `MavsdkLink`."""

    def kinematics(self) -> Kinematics:
        """Return the newest position, velocity and attitude."""


def obstacle_distance(
    depth_mm: NDArray[np.uint16],
    camera: Intrinsics,
    range_m: float,
    quaternion: Vector,
    pitch_up_rad: float,
    now_us: int,
) -> dict[str, Any]:
    """Return the fields of the message.

    `depth_mm` (h, w) is a depth image, 0 = no return, up to `range_m` [m]. `quaternion` (4,) is the
    vehicle's attitude, body to NED; `pitch_up_rad` is the mounting angle of the camera; `now_us` is
    the time since the start.
    """
    # Bins are at least 5 degrees wide; the tolerance keeps an exact multiple.
    fov_rad = camera.horizontal_fov_rad
    count = min(BINS, max(1, int(fov_rad / BIN_RAD + 1e-6)))
    width_deg = math.degrees(fov_rad) / count
    # Level scan: tilt of vehicle and mount is removed from the rays.
    roll, pitch, _ = quats_to_euler(quaternion[None])
    tilt = tilt_of(roll, pitch + pitch_up_rad)
    (ranges,) = level_scan(depth_mm[None], rays_of(camera), tilt, count)
    # MAVLink: max_distance + 1 means free.
    free_cm = round(100.0 * range_m) + 1
    told = [free_cm if r > range_m else round(100.0 * max(r, NEAREST_M)) for r in ranges.tolist()]
    return {
        "time_usec": now_us,
        "sensor_type": SENSOR_TYPE_UNKNOWN,
        "distances": told + [UNKNOWN_CM] * (BINS - count),
        "increment": round(width_deg),
        "min_distance": round(100.0 * NEAREST_M),
        "max_distance": free_cm - 1,
        "increment_f": width_deg,
        # The message's angle refers to the middle of the first bin.
        "angle_offset": 0.5 * (width_deg - math.degrees(fov_rad)),
        "frame": FRAME_BODY_FRD,
    }


def obstacles_told(
    link: VehicleLink, frames: FrameSource, range_m: float, pitch_up_rad: float, clock: Clock
) -> AbstractContextManager[None]:
    """Send the message of a depth camera from a thread while the context is active."""

    def tell() -> None:
        received, now_us = frames.latest(), clock.time_us()
        # An old image would mark free space where an obstacle has come close.
        if received is None or now_us - received.received_us > OLDEST_US:
            return
        frame, attitude = received.frame, link.kinematics().quaternion
        if frame.intrinsics.kind != "depth" or not np.isfinite(attitude).all():
            return
        fields = obstacle_distance(
            frame.image, frame.intrinsics, range_m, attitude, pitch_up_rad, now_us
        )
        link.send_message(OBSTACLES, fields)

    return every(OBSTACLES_US, tell, clock, "obstacles")


ALIVE_SHARE = 0.5
"""Interval of watchdog notifications as a share of systemd's timeout, as recommended by
sd_watchdog_enabled(3)."""


class ServiceManager:
    """Service manager that started this process, if any. Thread-safe."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        """Read the socket and the watchdog timeout from an environment."""
        self._socket: socket.socket | None = None
        address = environment.get("NOTIFY_SOCKET", "")
        if address[:1] in ("/", "@"):
            # CLOEXEC: child processes must not notify the manager.
            found = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            try:
                # "@" marks a name in Linux's abstract namespace.
                found.connect(address.replace("@", "\0", 1))
                found.setblocking(False)
                self._socket = found
            except OSError:
                found.close()
        self.watchdog_us = _watchdog_us(environment)
        """Watchdog timeout [µs]; None = no watchdog."""

    def tell(self, **facts: str) -> None:
        """Send facts by names of sd_notify(3), such as STATUS; lost facts are not an error."""
        if self._socket is not None:
            # One fact per line: a newline within a value would start another.
            lines = (f"{name}={value}".replace("\n", " ") for name, value in facts.items())
            try:
                self._socket.send("\n".join(lines).encode())
            except BlockingIOError:
                # The manager's queue is full; the flight must not wait.
                return
            except OSError:
                self.close()

    def close(self) -> None:
        """Stop sending notifications."""
        found, self._socket = self._socket, None
        if found is not None:
            found.close()


def _watchdog_us(environment: Mapping[str, str]) -> int | None:
    """Return WATCHDOG_USEC if it applies to this process; None otherwise."""
    told, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID")
    if not told.isdecimal() or int(told) == 0 or pid not in (None, f"{os.getpid()}"):
        return None
    return int(told)


@contextmanager
def service(environment: Mapping[str, str] = os.environ) -> Iterator[ServiceManager]:
    """Yield the service manager, with watchdog pings from a thread while the context is active."""
    with closing(ServiceManager(environment)) as manager, ExitStack() as alive:
        if manager.watchdog_us is not None:
            # Half the timeout leaves room for one missed ping.
            period_us = int(ALIVE_SHARE * manager.watchdog_us)
            sign = every(period_us, lambda: manager.tell(WATCHDOG="1"), WallClock(), "systemd")
            alive.enter_context(sign)
        try:
            yield manager
        finally:
            manager.tell(STOPPING="1")
