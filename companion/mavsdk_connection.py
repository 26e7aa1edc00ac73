"""How MAVSDK is opened, and a flight controller found on it.

Also what its library offers and MAVSDK-Python 4.1 does not wrap, or wraps slowly.
"""

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
from companion.interfaces import LinkError

SLICE_S = 0.5
"""Longest single wait for a flight controller [wall s]."""

RAW_CHUNK = 65_536
"""Bytes passed at a time; MAVSDK's parser reassembles a divided frame."""


def open_connection(url: str, kind: ComponentType) -> Mavsdk:
    """Return MAVSDK on a connection.

    Args:
        url: `udpin://127.0.0.1:14540`, `serial:///dev/ttyAMA0:921600` or `raw://`.
        kind: Component type in its heartbeat.

    Raises:
        UsageError: The URL is invalid or its port is taken.
    """
    # MAVSDK would log to standard output; errors are returned as results.
    log_subscribe(lambda *_: True)
    mavsdk = Mavsdk(Configuration.create_with_component_type(kind))
    result = mavsdk.add_any_connection(url)
    if result != ConnectionResult.SUCCESS:
        mavsdk.destroy()
        raise UsageError(_problem(url, result))
    return mavsdk


def first_autopilot(mavsdk: Mavsdk, timeout_s: float, stop: threading.Event | None = None) -> Any:
    """Return the first flight controller that is found; None when none is in time [wall s].

    Raises LinkError when `stop`, set from outside, breaks off the wait.
    """
    stopwatch = WallClock()
    while (left_s := timeout_s - stopwatch.time_us() / US_PER_S) > 0.0:
        if stop is not None and stop.is_set():
            raise LinkError("stopped")
        # In slices: a signal is handled only between two calls into MAVSDK.
        system = mavsdk.first_autopilot(min(left_s, SLICE_S))
        if system is not None:
            return system
    return None


def _problem(url: str, result: Any) -> str:
    name = result.name.lower().replace("_", " ")
    if result == ConnectionResult.BIND_ERROR:
        return (
            f"--connect {url}: the port is taken (another companion?): choose another "
            "(airl-sitl: --api-port)"
        )
    return f"--connect {url}: {name}; accepted: udpin://HOST:PORT, serial://DEVICE:BAUD"


def exchange_raw_bytes(mavsdk: Mavsdk, sent: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """Take over the bytes of a `raw://` connection; see `mavsdk_link.MavsdkLink.exchange_raw`."""
    library, handle = mavsdk._lib, mavsdk._handle
    mavsdk.subscribe_raw_bytes_to_be_sent(sent)
    # MAVSDK-Python's own function makes a ctypes array type for every length of `data`: 0.1 ms.
    buffer = (ctypes.c_uint8 * RAW_CHUNK)()
    pass_bytes = library.mavsdk_pass_received_raw_bytes

    def feed(data: bytes) -> None:
        for start in range(0, len(data), RAW_CHUNK):
            chunk = data[start : start + RAW_CHUNK]
            ctypes.memmove(buffer, chunk, len(chunk))
            pass_bytes(handle, buffer, len(chunk))

    return feed


def set_timeout(mavsdk: Mavsdk, seconds: float) -> None:
    """Set the time after which MAVSDK repeats an unanswered request [wall s]."""
    call = mavsdk._lib.mavsdk_set_timeout_s
    call.argtypes = [ctypes.c_void_p, ctypes.c_double]
    call(mavsdk._handle, seconds)
