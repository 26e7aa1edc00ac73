"""Connection of MAVSDK: opening, search for a flight controller, exchange of raw bytes."""

from __future__ import annotations

import ctypes
import re
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavsdk import ComponentType, Configuration, ConnectionResult, Mavsdk
from mavsdk.autopilot import Autopilot
from mavsdk.logging import log_subscribe

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import LOOPBACK, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.signing import SIGNATURE_BYTES, StoredSigning, frames_of
from companion.link_interface import LinkError

SLICE_S = 0.5
"""Maximum single wait for a flight controller [wall s]."""

SEARCH_S = 0.05
"""Interval of searches for a system id [wall s]."""

RAW_URL = "raw://"
"""Connection without sockets: bytes are exchanged with this process, see `exchange_raw`."""

RAW_CHUNK = 65_536
"""Maximum bytes per call; MAVSDK's parser reassembles divided frames."""

RAW_TIMEOUT_S = 3600.0
"""MAVSDK's command timeout in lockstep [wall s]. A reply is certain, but not its wall time:
a process that was stopped must not repeat commands when it resumes."""


def open_connection(url: str, kind: ComponentType, system_id: int | None = None) -> Mavsdk:
    """Return MAVSDK on a connection, with a component type in its heartbeat, or raise UsageError.

    Example URLs are `udpin://127.0.0.1:14540`, `serial:///dev/ttyAMA0:921600` and `raw://`.
    `system_id` is the system id of the component's vehicle; None = MAVSDK's default.
    """
    # MAVSDK logs to standard output by default; errors are returned as results.
    log_subscribe(lambda *_: True)
    configuration = Configuration.create_with_component_type(kind)
    # A component on board has the system id of its vehicle.
    if system_id is not None:
        configuration.system_id = system_id
    mavsdk = Mavsdk(configuration)
    result = mavsdk.add_any_connection(url)
    if result == ConnectionResult.SUCCESS:
        return mavsdk
    mavsdk.destroy()
    name = result.name.lower().replace("_", " ")
    problem = f"{name}; accepted: udpin://HOST:PORT, serial://DEVICE:BAUD"
    # A second companion on this host is the usual cause.
    if result == ConnectionResult.BIND_ERROR:
        problem = "the port is taken (another companion?): choose another (airl-sitl: --api-port)"
    raise UsageError(f"--connect {url}: {problem}")


def find_autopilot(
    mavsdk: Mavsdk,
    timeout_s: float,
    stop: threading.Event | None = None,
    system_id: int | None = None,
) -> Any:
    """Return the flight controller with a system id or None after a timeout [wall s].

    `system_id` None = the first flight controller. Raises LinkError on `stop`.
    """
    stopwatch = WallClock()
    while (left_s := timeout_s - stopwatch.time_us() / US_PER_S) > 0.0:
        if stop is not None and stop.is_set():
            raise LinkError("stopped")
        # Short waits: Python handles signals only between calls into MAVSDK.
        if system_id is None:
            system = mavsdk.first_autopilot(min(left_s, SLICE_S))
        elif (system := autopilots(mavsdk).get(system_id)) is None:
            WallClock().sleep_until(int(min(left_s, SEARCH_S) * US_PER_S))
        if system is not None:
            return system
    return None


def autopilots(mavsdk: Mavsdk) -> dict[int, Any]:
    """Return the connected flight controllers by system id."""
    return {
        system.get_system_id(): system
        for system in mavsdk.get_systems()
        if system.has_autopilot() and system.is_connected()
    }


def exchange_raw(mavsdk: Mavsdk, sent: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """Exchange the bytes of a `raw://` connection; return a function for incoming whole frames.

    `sent` receives every outgoing frame, in MAVSDK's thread: it must not block or acquire a lock
    that a feeding thread may hold. Feed from one thread at a time.
    """
    mavsdk.subscribe_raw_bytes_to_be_sent(sent)
    # MAVSDK-Python's function creates a ctypes array type for every length of `data`: 0.1 ms.
    # One buffer, allocated once, avoids that.
    buffer = (ctypes.c_uint8 * RAW_CHUNK)()
    handle, pass_bytes = mavsdk._handle, mavsdk._lib.mavsdk_pass_received_raw_bytes

    def feed(data: bytes) -> None:
        for start in range(0, len(data), RAW_CHUNK):
            chunk = data[start : start + RAW_CHUNK]
            ctypes.memmove(buffer, chunk, len(chunk))
            pass_bytes(handle, buffer, len(chunk))

    return feed


def set_timeout(mavsdk: Mavsdk, seconds: float) -> None:
    """Set the timeout until MAVSDK repeats a request [wall s]; MAVSDK's default is 0.5 s."""
    call = mavsdk._lib.mavsdk_set_timeout_s  # not wrapped by MAVSDK-Python 4.1
    call.argtypes = [ctypes.c_void_p, ctypes.c_double]
    call(mavsdk._handle, seconds)


RATE_HZ = 50.0
"""Requested rate of position, velocity and attitude [Hz]."""

_STATUS_HZ = 5.0
"""Rate of health and landed state if they must be requested [Hz]; equal to PX4's."""

_KINEMATICS = (("position_velocity_ned", RATE_HZ), ("attitude_quaternion", RATE_HZ))


@dataclass(frozen=True)
class Dialect:
    """Properties of one kind of flight controller."""

    name: str
    streams: tuple[tuple[str, float], ...]
    """Streams to request, in order: X of MAVSDK's telemetry.set_rate_X, and the rate [Hz]."""
    health: tuple[str, ...]
    """Flags of MAVSDK's health required for arming and flight by position."""
    arm_timeout_s: float
    """Timeout from the start of a mission to arming, with a flight controller just powered up
    [s]."""


POSITION = ("is_local_position_ok", "is_global_position_ok")
"""Flags of MAVSDK's health for positions."""

PX4 = Dialect(
    "PX4",
    _KINEMATICS,
    # health_all_ok without the home position: PX4 sets home when it arms, and MAVSDK discards it
    # after this process was stopped for 3 s.
    (
        "is_gyrometer_calibration_ok",
        "is_accelerometer_calibration_ok",
        "is_magnetometer_calibration_ok",
        *POSITION,
        "is_armable",
    ),
    arm_timeout_s=20.0,
)

ARDUPILOT = Dialect(
    "ArduPilot",
    # By default only heartbeats are sent (SRn_ parameters are 0); health needs several streams.
    (
        *_KINEMATICS,
        ("position", _STATUS_HZ),
        ("health", _STATUS_HZ),
        ("landed_state", _STATUS_HZ),
        ("home", 1.0),
    ),
    # STABILIZE can be armed without a position; GUIDED, and so take-off, requires a position.
    # MAVSDK's calibration flags are omitted: for ArduPilot they mean "enabled and healthy now", and
    # the pre-arm checks include the calibration.
    (*POSITION, "is_home_position_ok", "is_armable"),
    # The EKF estimates the gyro bias for 40 s before it uses GPS.
    arm_timeout_s=90.0,
)

SET_GUIDED = {"target_component": 1, "command": 176, "param1": 1.0, "param2": 4.0}
"""COMMAND_LONG to ArduPilot: DO_SET_MODE with a custom mode, GUIDED."""


def dialect_of(autopilot: Autopilot) -> Dialect:
    """Return the dialect of MAVSDK's kind of autopilot; unknown kinds are treated as PX4."""
    return ARDUPILOT if autopilot == Autopilot.ARDUPILOT else PX4


LINK_ID = 2
"""Link id in signatures of a companion; the flight controller's links are 0 and 1."""

AUTOPILOT_COMPONENT = 1
"""MAV_COMP_ID_AUTOPILOT1."""

MAX_DATAGRAM = 4096
RECEIVE_BUFFER_BYTES = 1 << 20
"""Receive buffer [bytes], or the maximum that Linux allows: a flood must not displace telemetry."""

POLL_S = 0.5
"""Maximum wait between checks for the end [wall s]."""

_URL = re.compile(r"udp(?:in)?://(?P<host>[^:/]*):(?P<port>\d+)")


class SigningProxy:
    """UDP socket that passes verified frames to MAVSDK, and MAVSDK's frames, signed, to vehicles.

    MAVSDK exchanges raw bytes with this process, so no other program can reach it. MAVSDK accepts
    every frame; an unsigned HEARTBEAT could report another mode or an invented vehicle.
    """

    def __init__(self, url: str, key: Path, system_id: int | None = None) -> None:
        """Bind udpin://HOST:PORT; the default host is this machine.

        `system_id` is the system id of the vehicle to send to; None = every vehicle with the key.
        """
        # Signing works on datagrams, so serial connections are not supported.
        found = _URL.fullmatch(url)
        if found is None:
            raise UsageError(f"--connect {url}: with a signing key: udpin://HOST:PORT")
        self._stored = StoredSigning(key)
        self._system_id = system_id
        self._vehicles: dict[int, tuple[str, int]] = {}
        """Newest address of each vehicle, by system id."""
        self._links: dict[bytes, int] = {}
        """Link id of each sender, by its system and component id."""
        self._lock = threading.Lock()
        """Held to sign or verify: both threads use the time stamps."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        try:
            self._socket.bind((found["host"] or LOOPBACK, int(found["port"])))
        except OSError as error:
            self._socket.close()
            raise UsageError(f"--connect {url}: {error.strerror}") from None
        self._socket.settimeout(POLL_S)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def refused(self) -> int:
        """Number of frames rejected: unsigned, with an invalid signature, or duplicates."""
        return self._stored.signing.refused

    def start(self, mavsdk: Mavsdk) -> None:
        """Start the exchange with a MAVSDK connected to `RAW_URL`; close before MAVSDK."""
        feed = exchange_raw(mavsdk, self._send)
        self._thread = threading.Thread(target=self._run, args=(feed,), name="signing", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the exchange and store the newest time stamp. Idempotent."""
        # The stamp is stored last: a reused time stamp would be rejected after a restart.
        if not self._stop.is_set():
            self._stop.set()
            if self._thread is not None:
                self._thread.join()
            self._socket.close()
            self._stored.save()

    def _run(self, feed: Callable[[bytes], None]) -> None:
        while not self._stop.is_set():
            # The finite timeout lets the loop see `_stop`; other errors are ICMP messages.
            with suppress(OSError):
                data, address = self._socket.recvfrom(MAX_DATAGRAM)
                with self._lock:
                    accepted = [each for each in frames_of(data) if self._accepts(each, address)]
                if accepted:
                    feed(b"".join(accepted))
            self._stored.save_due()

    def _accepts(self, frame: bytes, address: tuple[str, int]) -> bool:
        """Return True for a signed frame of its sender's link; store the address of a vehicle."""
        signing, source, link = self._stored.signing, frame[5:7], frame[-SIGNATURE_BYTES]
        # Frames of a vehicle's other link are signed and new here, but may be old: only one counts.
        if self._links.get(source, link) != link:
            signing.refused += 1
            return False
        if not signing.accepts(frame, unsigned=False):
            return False
        self._links[source] = link
        system, component = source
        if component == AUTOPILOT_COMPONENT and self._system_id in (None, system):
            self._vehicles[system] = address
        return True

    def _send(self, frame: bytes) -> None:
        with self._lock:
            vehicles = set(self._vehicles.values())
            signed = self._stored.signing.sign(frame, LINK_ID) if vehicles else b""
        for address in vehicles:
            # MAVSDK may still send while the socket closes.
            with suppress(OSError):
                self._socket.sendto(signed, address)
