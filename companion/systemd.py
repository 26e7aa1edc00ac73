"""Notifications for systemd (sd_notify(3)): ready, status, watchdog. Needs `$NOTIFY_SOCKET`."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from typing import TYPE_CHECKING

from airl_mav.core.clock import Clock, WallClock

if TYPE_CHECKING:
    pass


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


def _watchdog_us(environment: Mapping[str, str]) -> int | None:
    """Return WATCHDOG_USEC if it applies to this process; None otherwise."""
    told, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID")
    if not told.isdecimal() or int(told) == 0 or pid not in (None, f"{os.getpid()}"):
        return None
    return int(told)
