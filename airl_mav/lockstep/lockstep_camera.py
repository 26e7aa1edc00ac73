"""Camera transport in lockstep: delays each frame by its transport latency."""

from __future__ import annotations

import threading
from collections import deque

from airl_mav.camera.frame import Frame
from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from companion.frame_source import ReceivedFrame
from companion.tokens import NO_FRAME
from firmware_sim.firmware import FrameServer


class UnderWay:
    """Queue of frames in transit from exposure to the companion."""

    def __init__(self, transport_us: int) -> None:
        """Set the transport latency [µs]: from exposure to the decoded frame in the companion."""
        self.published = threading.Event()
        """Set by each sent frame; a waiting thread clears the event first."""
        self._transport_us = transport_us
        self._frames: deque[Frame] = deque()

    def send(self, frame: Frame) -> None:
        """Queue a frame for delivery."""
        frames, arrived_us = self._frames, frame.capture_time_us - self._transport_us
        while len(frames) > 1 and frames[1].capture_time_us <= arrived_us:
            frames.popleft()  # A newer frame has arrived: this one can no longer be read.
        frames.append(frame)
        if not self.published.is_set():
            self.published.set()

    def arrived(self, now_us: int) -> Frame | None:
        """Remove all frames that arrived by `now_us` [µs]; return the newest or None."""
        newest = None
        while (next_us := self.next_us) is not None and next_us <= now_us:
            newest = self._frames.popleft()
        return newest

    @property
    def next_us(self) -> int | None:
        """Arrival time of the next frame [µs]; None = no frame is in transit."""
        return self._frames[0].capture_time_us + self._transport_us if self._frames else None

    @property
    def awaited(self) -> bool:
        """True if the companion waits for the next exposure."""
        return not self.published.is_set()

    def clear(self) -> None:
        """Discard all frames."""
        self._frames.clear()


class MemoryCamera:
    """In-process camera: `firmware.FrameServer` and, with `latest`, `frame_source.FrameSource`."""

    endpoint = "memory"

    def __init__(self, transport_us: int) -> None:
        """Set the transport latency [µs]: from exposure to the decoded frame in the companion."""
        self.clock: Clock | None = None
        """Clock of the companion; None = not connected yet."""
        self.transport_us = transport_us
        self._under_way = UnderWay(transport_us)
        self.publish = self._under_way.send
        self._newest: ReceivedFrame | None = None

    @property
    def awaited(self) -> bool:
        """True if the companion waits for the next exposure."""
        return self._under_way.awaited

    def close(self) -> None:
        """Discard all frames."""
        self._under_way.clear()

    def latest(self) -> ReceivedFrame | None:
        """Return the newest frame that has arrived, without blocking; None before the first."""
        now_us = 0 if self.clock is None else self.clock.time_us()
        arrived = self._under_way.arrived(now_us)
        if arrived is not None:
            self._newest = ReceivedFrame(arrived, now_us)
        return self._newest

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        """Wait for a frame with another sequence number; see `companion.frame_source.FrameSource`.

        The timeout is in simulated time.
        """
        clock, under_way = self.clock, self._under_way
        if clock is None:
            raise RuntimeError("nobody looks: the camera has no companion's clock")
        # The timeout counts in simulated time: wall time must not affect the flight.
        deadline_us = clock.time_us() + int(timeout_s * US_PER_S)
        while True:
            newest = self.latest()
            if newest is not None and newest.frame.sequence != newer_than_sequence:
                return newest
            if clock.time_us() >= deadline_us:
                return None
            # A frame in transit has a known arrival; otherwise its publication ends the sleep.
            if under_way.next_us is not None:
                clock.sleep_until(min(deadline_us, under_way.next_us))
            else:
                under_way.published.clear()
                clock.sleep_until(deadline_us, under_way.published)


class TokenCamera:
    """Camera of a companion in another process. Implements `firmware.FrameServer`.

    Each turn sends only the newest frame that has arrived, as the companion cannot read older ones.
    """

    def __init__(self, server: FrameServer, transport_us: int) -> None:
        """Set the frame server and the transport latency from exposure to arrival [µs]."""
        self.transport_us = transport_us
        self.under_way = UnderWay(transport_us)
        self.endpoint = server.endpoint
        self._server = server
        self._newest: Frame | None = None

    @property
    def awaited(self) -> bool:
        """True if the companion waits for the next exposure."""
        return self.under_way.awaited

    def publish(self, frame: Frame) -> None:
        """Queue a frame for delivery, in simulated time."""
        self.under_way.send(frame)

    def arrive(self, now_us: int) -> bool:
        """Receive all frames that arrived by `now_us` [µs]; return True if there was one."""
        arrived = self.under_way.arrived(now_us)
        self._newest = arrived or self._newest
        return arrived is not None

    @property
    def sequence(self) -> int:
        """Sequence number of the newest arrived frame."""
        return NO_FRAME if self._newest is None else self._newest.sequence

    def send(self) -> None:
        """Send the newest arrived frame immediately; a resend covers packet loss."""
        if self._newest is not None:
            self._server.publish(self._newest)

    def close(self) -> None:
        """Discard all frames; the caller owns and closes the server."""
        self.under_way.clear()
