"""Sources of camera frames: the newest frame and the time it was decoded."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

import zmq
from zmq.utils import z85

from airl_mav.camera.frame import MOST_BYTES, Frame, FrameError
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core import addons, constants, errors
from airl_mav.core.clock import Clock, WallClock
from airl_mav.scenario.aircraft import GREATEST_PORT

MESSAGES_PER_LOOK = 8
"""Maximum number of messages read at once, for a publisher that sends faster than it is read."""

SHARE_S = 0.02
"""Maximum time for which one of two threads occupies a shared source [wall s]."""

REDIAL_S = 2.0
"""Silence after which the source reconnects [wall s]."""


@dataclass(frozen=True)
class ReceivedFrame:
    """Frame and the time it was available to the companion."""

    frame: Frame
    received_us: int
    """Simulated time when the frame was decoded [µs]."""


class FrameSource(Protocol):
    """Camera interface of the companion: only the newest frame counts."""

    def latest(self) -> ReceivedFrame | None:
        """Return the newest frame without waiting; None before the first frame."""

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        """Wait for a frame with another sequence (-1 = any); None after a timeout [wall s]."""


class ZmqFrameSource:
    """Frames published by a simulator or a camera driver over ZeroMQ (tcp, ipc).

    ZeroMQ keeps only the newest message and reconnects to a closed publisher. It does not detect a
    publisher without power or recover from oversized frames, so the source reconnects after
    silence. Use from one thread at a time.
    """

    def __init__(
        self,
        endpoint: str,
        clock: Clock,
        context: zmq.Context[zmq.Socket[bytes]] | None = None,
        key: bytes | None = None,
    ) -> None:
        """Connect to an endpoint such as "tcp://192.168.1.2:5560", or raise FieldError.

        `key` is CURVE's secret key of the publisher; None = unencrypted.
        """
        self.malformed = 0
        """Number of invalid messages, or frames of another size than the first frame."""
        self.failure: str | None = None
        """Reason for missing frames; always None, as a publisher may start at any time."""
        self.dropped = 0
        """Number of lost frames; always 0, as frames between two reads are dropped by design."""
        self._clock = clock
        self._newest: ReceivedFrame | None = None
        self._owns_context = context is None
        self._context = zmq.Context() if context is None else context
        self._socket = self._context.socket(zmq.SUB)
        # CONFLATE keeps only the newest message.
        self._socket.setsockopt(zmq.CONFLATE, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        # ZeroMQ closes the connection at an oversized message.
        self._socket.setsockopt(zmq.MAXMSGSIZE, MOST_BYTES)
        self._socket.subscribe(b"")
        self._endpoint = endpoint
        self._silent = WallClock()
        """Time since the last message or the last connection attempt."""
        try:
            if key is not None:
                # The subscriber's own key pair is new each time: the publisher accepts any.
                public, secret = zmq.curve_keypair()
                self._socket.setsockopt(zmq.CURVE_PUBLICKEY, public)
                self._socket.setsockopt(zmq.CURVE_SECRETKEY, secret)
                self._socket.setsockopt(zmq.CURVE_SERVERKEY, zmq.curve_public(z85.encode(key)))
            self._socket.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            accepted = f"{error}; accepted: tcp://HOST:PORT, ipc://PATH"
            raise errors.FieldError("camera", endpoint, accepted) from None

    def latest(self) -> ReceivedFrame | None:
        """Return the newest frame without waiting; None before the first frame."""
        # Bounded: a fast publisher must not hold the caller here.
        for _ in range(MESSAGES_PER_LOOK):
            if not self._socket.poll(0):
                if self._silent.time_us() >= REDIAL_S * constants.US_PER_S:
                    self._redial()
                break
            # Any message proves the connection, even an invalid one.
            self._silent = WallClock()
            # Message parts are read as messages; publishers of this format send no parts.
            data = self._socket.recv()
            try:
                frame = self._known(Frame.from_bytes(data))
            except FrameError:
                self.malformed += 1
            else:
                self._newest = ReceivedFrame(frame, self._clock.time_us())
        return self._newest

    def _redial(self) -> None:
        self._silent = WallClock()
        with suppress(zmq.ZMQError):  # already disconnected
            self._socket.disconnect(self._endpoint)
        self._socket.connect(self._endpoint)

    def _known(self, frame: Frame) -> Frame:
        """Return a frame, or raise FrameError if its size differs from the first frame's."""
        if self._newest is not None:
            known = self._newest.frame
            # A camera that changes in flight would not match the policy's input.
            if (frame.intrinsics, frame.lenses) != (known.intrinsics, known.lenses):
                raise FrameError("another camera's frame")
        return frame

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        """Wait for a frame, see `FrameSource`; a lower sequence is new after a restart."""
        stopwatch = WallClock()
        while True:
            newest = self.latest()
            if newest is not None and newest.frame.sequence != newer_than_sequence:
                return newest
            left_ms = 1e3 * timeout_s - 1e-3 * stopwatch.time_us()
            if left_ms <= 0.0:
                return None
            # The wait ends in time for a reconnection.
            self._socket.poll(math.ceil(min(left_ms, 1e3 * REDIAL_S)))

    def close(self) -> None:
        """Disconnect."""
        self._socket.close(linger=0)
        if self._owns_context:
            self._context.term()


class SharedFrames:
    """Frame source for two threads; one thread may wait. Implements `FrameSource`."""

    def __init__(self, frames: FrameSource) -> None:
        """Share a source that supports one thread at a time."""
        self._frames = frames
        self._one_at_a_time = threading.Lock()

    def latest(self) -> ReceivedFrame | None:
        """Return the newest frame; None before the first frame."""
        with self._one_at_a_time:
            return self._frames.latest()

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        """Wait for a frame with another sequence; see `FrameSource`."""
        stopwatch = WallClock()
        while True:
            left_s = timeout_s - stopwatch.time_us() / constants.US_PER_S
            # The lock is released between slices, so that the other thread can read.
            with self._one_at_a_time:
                found = self._frames.wait(newer_than_sequence, min(max(left_s, 0.0), SHARE_S))
            if found is not None or left_s <= SHARE_S:
                return found


def open_camera(endpoint: str, clock: Clock, key: bytes | None = None) -> ZmqFrameSource:
    """Connect to the camera at a ZeroMQ address; see `ZmqFrameSource`.

    Raises FieldError for an unusable address.
    """
    port = endpoint.rpartition(":")[2]
    # libzmq would silently truncate the number to 16 bits.
    if endpoint.startswith("tcp:") and not (port.isdecimal() and 1 <= int(port) <= GREATEST_PORT):
        raise errors.FieldError("camera", endpoint, f"tcp://HOST:PORT, port 1..{GREATEST_PORT}")
    return ZmqFrameSource(endpoint, clock, key=key)


class OpenCamera(FrameSource, Protocol):
    """Frame source that can be closed and reports failures."""

    @property
    def failure(self) -> str | None:
        """Return the reason for missing frames; None = no failure, or unknown."""

    @property
    def dropped(self) -> int:
        """Return the number of lost camera images; 0 if unknown."""

    def close(self) -> None:
        """Release the camera."""


def open_named_camera(
    name: str,
    clock: Clock,
    wanted: Intrinsics,
    whose: str,
    further: Mapping[str, Intrinsics] | None = None,
    key: bytes | None = None,
) -> OpenCamera:
    """Open a camera by name; FieldError if it is missing, sees too little or has no depth.

    A name is tcp://HOST:PORT or ipc://PATH (images are used unchanged), or a driver's name.
    Its images are converted to the `wanted` camera of `whose`, such as "vehicle quad". `key`
    decrypts the images of an address.
    """
    # An address has a scheme; the publisher defines its own camera, so nothing is converted.
    if "://" in name:
        return open_camera(name, clock, key)
    open_driver = addons.load_entry("companion", "CAMERAS", "driver", ("camera", name), "cameras")
    camera: OpenCamera = open_driver(name, clock, wanted, whose, further)
    return camera
