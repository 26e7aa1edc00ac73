"""Notifications for systemd (sd_notify(3)): ready, status, alive; none without `$NOTIFY_SOCKET`."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager

from airl_mav.core.clock import WallClock
from companion.periodic import every

ALIVE_SHARE = 0.5
"""Signs of life come after this share of the time that systemd allows, as sd_watchdog_enabled(3)
advises."""


class ServiceManager:
    """The service manager that started this process, if one did. Safe from any thread."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        """Take the socket and the watchdog's time from an environment."""
        self._socket: socket.socket | None = None
        address = environment.get("NOTIFY_SOCKET", "")
        if address[:1] in ("/", "@"):
            found = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            try:
                # "@" is a name in Linux' abstract namespace.
                found.connect(address.replace("@", "\0", 1))
                found.setblocking(False)
                self._socket = found
            except OSError:
                found.close()
        self.watchdog_us = _watchdog_us(environment)
        """Longest time without a sign of life [µs]; None: nobody watches."""

    def tell(self, **facts: str) -> None:
        """Send facts by the names of sd_notify(3), such as STATUS; a lost one is no failure."""
        if self._socket is not None:
            lines = (f"{name}={value}".replace("\n", " ") for name, value in facts.items())
            try:
                self._socket.send("\n".join(lines).encode())
            except BlockingIOError:
                # It has too much to read, and what waits for nobody must fly on.
                return
            except OSError:
                self.close()

    def close(self) -> None:
        """Tell nothing more."""
        found, self._socket = self._socket, None
        if found is not None:
            found.close()


def _watchdog_us(environment: Mapping[str, str]) -> int | None:
    """Return WATCHDOG_USEC where it is meant for this process."""
    told, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID")
    if not told.isdecimal() or int(told) == 0 or pid not in (None, f"{os.getpid()}"):
        return None
    return int(told)


@contextmanager
def service(environment: Mapping[str, str] = os.environ) -> Iterator[ServiceManager]:
    """Give the service manager, with watchdog pings from a thread while the context lasts."""
    with closing(ServiceManager(environment)) as manager, ExitStack() as alive:
        if manager.watchdog_us is not None:
            period_us = int(ALIVE_SHARE * manager.watchdog_us)
            sign = every(period_us, lambda: manager.tell(WATCHDOG="1"), WallClock(), "systemd")
            alive.enter_context(sign)
        try:
            yield manager
        finally:
            manager.tell(STOPPING="1")
