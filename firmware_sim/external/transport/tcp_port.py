"""A TCP port that accepts one connection; no wait is endless."""

from __future__ import annotations

import errno
import select
import socket
from collections.abc import Callable

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import MS_PER_S, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.ports import LOOPBACK

WATCH_S = 0.1
"""Longest wait without checking that the other program is alive [wall s]."""

CHUNK = 65_536

_READ, _WRITE = select.POLLIN, select.POLLOUT


class TcpPort:
    """Listens on the loopback address, accepts one connection, refuses every further one."""

    def __init__(self, port: int) -> None:
        """Listen on a TCP port, 0 = any free one. Raises UsageError if it cannot be used."""
        self.refused = 0
        """Further connections that were refused."""
        self._clock = WallClock()
        self._connection: socket.socket | None = None
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._listener.setblocking(False)
        try:
            self._listener.bind((LOOPBACK, port))
            self._listener.listen()
        except (OSError, OverflowError) as error:
            self._listener.close()
            raise UsageError(_listen_problem(port, error)) from error
        self.port: int = self._listener.getsockname()[1]
        self._poll = select.poll()
        self._poll.register(self._listener, _READ)

    def accept(self, timeout_s: float, alive: Callable[[], None]) -> bool:
        """Wait for the connection [wall s]; return whether it was made; `alive` may raise."""
        deadline_us = self._deadline_us(timeout_s)
        while self._connection is None:
            alive()
            left_s = self._left_s(deadline_us)
            if left_s <= 0.0:
                return False
            if self._poll.poll(min(left_s, WATCH_S) * MS_PER_S):
                self._connection = self._newcomer()
        self._connection.setblocking(False)
        self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._poll.register(self._connection, _READ)
        return True

    @property
    def peer(self) -> tuple[str, int]:
        """Address of the other end."""
        host, port = self._connected().getpeername()
        return host, port

    def send(self, data: bytes, timeout_s: float, alive: Callable[[], None]) -> bool:
        """Send all of it; False when the connection has ended or does not accept it in time."""
        connection, left = self._connected(), data
        sent = _send(connection, left)
        if sent == len(left):
            return True  # As nearly always: there is nothing to look at the clock for.
        deadline_us = self._deadline_us(timeout_s)
        while sent is not None:
            left = left[sent:]
            left_s = self._left_s(deadline_us)
            if not left or left_s <= 0.0:
                return not left
            alive()
            writable = select.poll()
            writable.register(connection, _WRITE)
            writable.poll(min(left_s, WATCH_S) * MS_PER_S)
            sent = _send(connection, left)
        return False

    def receive(self, timeout_s: float) -> bytes | None:
        """Return received data, b"" after a timeout [wall s] or early, None at the end."""
        connection = self._connected()
        for number, _ in self._poll.poll(timeout_s * MS_PER_S):
            if number == connection.fileno():
                try:
                    return connection.recv(CHUNK) or None
                except BlockingIOError:
                    return b""
                except OSError:
                    return None
            newcomer = self._newcomer()
            if newcomer is not None:
                newcomer.close()
                self.refused += 1
        return b""

    def close(self) -> None:
        """Close everything; harmless when called again."""
        if self._connection is not None:
            self._connection.close()
        self._listener.close()

    def _connected(self) -> socket.socket:
        if self._connection is None:
            raise RuntimeError("there is no connection yet")
        return self._connection

    def _newcomer(self) -> socket.socket | None:
        """Return who asked to be connected; None when it is gone again."""
        try:
            return self._listener.accept()[0]
        except OSError:
            return None

    def _deadline_us(self, timeout_s: float) -> int:
        return self._clock.time_us() + int(timeout_s * US_PER_S)

    def _left_s(self, deadline_us: int) -> float:
        return (deadline_us - self._clock.time_us()) / US_PER_S


def _send(connection: socket.socket, data: bytes) -> int | None:
    """Return how many bytes were taken, None when the connection has ended."""
    try:
        return connection.send(data)
    except BlockingIOError:
        return 0
    except OSError:
        return None


def _listen_problem(port: int, error: OSError | OverflowError) -> str:
    where = f"TCP port {port} on {LOOPBACK}"
    if isinstance(error, OverflowError):
        return f"--instance: {where}: must be in 0..65535"
    if error.errno == errno.EADDRINUSE:
        return f"{where} is taken (another simulator?): choose another with --instance"
    return f"{where} cannot be used ({error.strerror}): choose another with --instance"
