"""Connection of MAVSDK: opening, search for a flight controller, exchange of raw bytes."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from typing import Any

from mavsdk import ComponentType, Configuration, ConnectionResult, Mavsdk
from mavsdk.logging import log_subscribe

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from companion.link_interface import LinkError

SLICE_S = 0.5
"""Maximum single wait for a flight controller [wall s]."""

RAW_URL = "raw://"
"""Connection without sockets: bytes are exchanged with this process, see `exchange_raw`."""

RAW_CHUNK = 65_536
"""Maximum bytes per call; MAVSDK's parser reassembles divided frames."""

RAW_TIMEOUT_S = 3600.0
"""MAVSDK's command timeout on a raw connection [wall s]. A reply is certain, but not its wall time:
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


def first_autopilot(mavsdk: Mavsdk, timeout_s: float, stop: threading.Event | None = None) -> Any:
    """Return the first flight controller or None after a timeout [wall s]; LinkError on `stop`."""
    stopwatch = WallClock()
    while (left_s := timeout_s - stopwatch.time_us() / US_PER_S) > 0.0:
        if stop is not None and stop.is_set():
            raise LinkError("stopped")
        # Short waits: Python handles signals only between calls into MAVSDK.
        system = mavsdk.first_autopilot(min(left_s, SLICE_S))
        if system is not None:
            return system
    return None


def exchange_raw(mavsdk: Mavsdk, sent: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """Exchange the bytes of a `raw://` connection; return a function for incoming whole frames.

    `sent` receives every outgoing frame, in MAVSDK's thread: it must not block or acquire a lock
    that a feeding thread may hold. Feed from one thread at a time.
    """
    set_timeout(mavsdk, RAW_TIMEOUT_S)
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
