"""A TCP port that accepts one connection; no wait is endless."""

from __future__ import annotations

import errno
import select
import socket
from collections.abc import Callable

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import MS_PER_S, US_PER_S
from airl_mav.core.errors import UsageError

WATCH_S = 0.1
"""Longest wait without checking that the other program is alive [wall s]."""

CHUNK = 65_536
"""Bytes read at once."""

_READ, _WRITE = select.POLLIN, select.POLLOUT


class TcpPort:
    """Listens, accepts one connection, refuses every further one."""

    def __init__(self, host: str, port: int, option: str) -> None:
        """Listen.

        Args:
            host: Address to bind.
            port: TCP port; 0 = any free one.
            option: The command line option that moves the port, for messages.

        Raises:
            UsageError: The port is taken, or cannot be used.
        """
        self.refused = 0
        """Further connections that were refused."""
        self._clock = WallClock()
        self._connection: socket.socket | None = None
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._listener.setblocking(False)
        try:
            self._listener.bind((host, port))
            self._listener.listen()
        except (OSError, OverflowError) as error:
            self._listener.close()
            raise UsageError(_listen_problem(host, port, option, error)) from error
        self.port: int = self._listener.getsockname()[1]
        self._poll = select.poll()
        self._poll.register(self._listener, _READ)

    @property
    def connected(self) -> bool:
        """Whether there has been a connection; it may have ended since."""
        return self._connection is not None

    def accept(self, timeout_s: float, alive: Callable[[], None]) -> bool:
        """Wait for the connection; return whether it was made.

        Args:
            timeout_s: Longest wait [wall s].
            alive: Called at intervals; may raise.
        """
        deadline_us = self._deadline_us(timeout_s)
        while self._connection is None:
            alive()
            left_s = self._left_s(deadline_us)
            if left_s <= 0.0:
                return False
            if self._poll.poll(min(left_s, WATCH_S) * MS_PER_S):
                self._take()
        return True

    def send(self, data: bytes, timeout_s: float, alive: Callable[[], None]) -> bool:
        """Send all of it; False when the connection has ended or does not accept it in time."""
        connection = self._connected()
        sent = _send(connection, data)
        if sent == len(data):
            return True
        deadline_us = self._deadline_us(timeout_s)
        writable = select.poll()
        writable.register(connection, _WRITE)
        while sent is not None and sent < len(data):
            left_s = self._left_s(deadline_us)
            if left_s <= 0.0:
                return False
            alive()
            writable.poll(min(left_s, WATCH_S) * MS_PER_S)
            more = _send(connection, data[sent:])
            sent = None if more is None else sent + more
        return sent is not None

    def receive(self, timeout_s: float) -> bytes | None:
        """Return what has arrived, b"" when nothing did in time [wall s], None at the end.

        May return b"" early.
        """
        connection = self._connected()
        for number, _ in self._poll.poll(timeout_s * MS_PER_S):
            if number == connection.fileno():
                try:
                    return connection.recv(CHUNK) or None
                except BlockingIOError:
                    return b""
                except OSError:
                    return None
            self._refuse()
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

    def _take(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return  # gone again
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection = connection
        self._poll.register(connection, _READ)

    def _refuse(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return
        connection.close()
        self.refused += 1

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


def _listen_problem(host: str, port: int, option: str, error: OSError | OverflowError) -> str:
    where = f"TCP port {port} on {host}"
    if isinstance(error, OverflowError):
        return f"{option}: {where}: must be in 0..65535"
    if error.errno == errno.EADDRINUSE:
        return f"{where} is taken (another simulator?): choose another with {option}"
    return f"{where} cannot be used ({error.strerror}): choose another with {option}"
