"""How MAVSDK is opened, and a flight controller found on it."""

from __future__ import annotations

import threading
from typing import Any

from mavsdk import ComponentType, Configuration, ConnectionResult, Mavsdk
from mavsdk.logging import log_subscribe

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from companion.interfaces import LinkError

SLICE_S = 0.5
"""Longest single wait for a flight controller [wall s]."""


def open_connection(url: str, kind: ComponentType) -> Mavsdk:
    """Return MAVSDK on a connection, with a component type in its heartbeat.

    The URL is such as `udpin://127.0.0.1:14540`, `serial:///dev/ttyAMA0:921600` or `raw://`.
    Raises UsageError if it is invalid or its port is taken.
    """
    # MAVSDK would log to standard output; errors are returned as results.
    log_subscribe(lambda *_: True)
    mavsdk = Mavsdk(Configuration.create_with_component_type(kind))
    result = mavsdk.add_any_connection(url)
    if result == ConnectionResult.SUCCESS:
        return mavsdk
    mavsdk.destroy()
    name = result.name.lower().replace("_", " ")
    problem = f"{name}; accepted: udpin://HOST:PORT, serial://DEVICE:BAUD"
    if result == ConnectionResult.BIND_ERROR:
        problem = "the port is taken (another companion?): choose another (airl-sitl: --api-port)"
    raise UsageError(f"--connect {url}: {problem}")


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
