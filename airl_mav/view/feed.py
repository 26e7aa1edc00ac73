"""Non-blocking ZeroMQ link between flight and view; messages to a slow view are dropped."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import zmq
from pydantic import ValidationError

from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import LOOPBACK, US_PER_S
from airl_mav.view.ends import ViewEnds
from airl_mav.view.view_messages import Image, Message, Steering, Told, from_parts, to_parts

QUEUED = 64
"""Queue limit on either side; messages beyond it are dropped."""

SILENCE_S = 5.0
"""Timeout after which a silent view counts as closed and its requests are dropped [s]."""


class Feed:
    """Sender of snapshots. Use from one thread at a time."""

    def __init__(self, ends: ViewEnds) -> None:
        """Connect; the view may start later or be closed."""
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PUSH)
        self._socket.setsockopt(zmq.SNDHWM, QUEUED)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.connect(ends.told)

    def send(self, message: Message, image: Image | None = None) -> None:
        """Send a message with its image, or drop it."""
        with suppress(zmq.Again):
            self._socket.send_multipart(to_parts(message, image), zmq.NOBLOCK)

    def close(self) -> None:
        """Disconnect and drop queued messages."""
        self._socket.close(linger=0)
        self._context.term()


class Asked:
    """Receiver of the viewers' requests. Use from one thread at a time."""

    def __init__(self, ends: ViewEnds, default: Steering, clock: Clock | None = None) -> None:
        """Connect to the view; `default` applies before its first message and after a timeout."""
        self._clock = clock or WallClock()
        self._heard_us = self._clock.time_us()
        self._default = self._newest = default
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.CONFLATE, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.subscribe(b"")
        self._socket.connect(ends.asked)

    def newest(self, wait_s: float = 0.0) -> Steering:
        """Return the newest requests, waiting up to `wait_s` [s] for a new message."""
        if self._socket.poll(round(1e3 * wait_s)):
            with suppress(ValidationError):
                self._newest = Steering.model_validate_json(self._socket.recv())
            self._heard_us = self._clock.time_us()
        elif self._clock.time_us() - self._heard_us > SILENCE_S * US_PER_S:
            self._newest = self._default
        return self._newest

    def close(self) -> None:
        """Disconnect."""
        self._socket.close(linger=0)
        self._context.term()


class Ends:
    """Sockets of the view: receive snapshots and publish viewers' requests."""

    def __init__(self) -> None:
        """Bind two free ports of the loopback address."""
        self._context = zmq.Context()
        self._told = self._bound(zmq.PULL)
        self._asked = self._bound(zmq.PUB)
        self.ends = ViewEnds(told=_address(self._told), asked=_address(self._asked))
        """Addresses for flights to connect to."""

    def _bound(self, kind: int) -> zmq.Socket[bytes]:
        socket: zmq.Socket[bytes] = self._context.socket(kind)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM if kind == zmq.PULL else zmq.SNDHWM, QUEUED)
        socket.bind(f"tcp://{LOOPBACK}:*")
        return socket

    def take(self, wait_s: float) -> list[tuple[Told, Image | None]]:
        """Return all received messages, oldest first, waiting up to `wait_s` [s] for the first."""
        found: list[tuple[Told, Image | None]] = []
        wait_ms = round(1e3 * wait_s)
        while self._told.poll(wait_ms):
            read = from_parts(self._told.recv_multipart())
            if read is not None:
                found.append(read)
            wait_ms = 0
            if len(found) >= 16 * QUEUED:
                break  # A flight at full speed: draw the received messages first.
        return found

    def ask(self, steering: Steering) -> None:
        """Publish the requests; call repeatedly so that late subscribers receive them."""
        self._asked.send(steering.model_dump_json().encode(), zmq.NOBLOCK)

    def close(self) -> None:
        """Free the ports."""
        self._told.close(linger=0)
        self._asked.close(linger=0)
        self._context.term()


def _address(socket: zmq.Socket[Any]) -> str:
    return str(socket.getsockopt_string(zmq.LAST_ENDPOINT)).rstrip("\0")
