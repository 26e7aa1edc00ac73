"""The camera's frames in lockstep: held back until the companion may see them."""

from __future__ import annotations

import threading
from collections import deque

from airl_mav.camera.frame import Frame
from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from companion.camera import ReceivedFrame
from companion.tokens import NO_FRAME
from firmware_sim.firmware import FrameServer


class UnderWay:
    """Frames between their exposure and the companion."""

    def __init__(self, transport_us: int) -> None:
        """Take the time from a frame's exposure until it lies decoded in the companion [µs]."""
        self.published = threading.Event()
        """Set with every frame that is sent; whoever waits for one clears it first."""
        self._transport_us = transport_us
        self._frames: deque[Frame] = deque()

    def send(self, frame: Frame) -> None:
        """Send a frame on its way."""
        frames, arrived_us = self._frames, frame.capture_time_us - self._transport_us
        while len(frames) > 1 and frames[1].capture_time_us <= arrived_us:
            frames.popleft()  # A newer one has arrived: nobody can see it any more.
        frames.append(frame)
        if not self.published.is_set():
            self.published.set()

    def arrived(self, now_us: int) -> Frame | None:
        """Take out what has arrived by `now_us` [µs]; return the newest, None if nothing has."""
        newest = None
        while (next_us := self.next_us) is not None and next_us <= now_us:
            newest = self._frames.popleft()
        return newest

    @property
    def next_us(self) -> int | None:
        """When the next one arrives [µs]; None: none is under way."""
        return self._frames[0].capture_time_us + self._transport_us if self._frames else None

    @property
    def awaited(self) -> bool:
        """Whether the companion waits for the next exposure."""
        return not self.published.is_set()

    def clear(self) -> None:
        """Forget all frames."""
        self._frames.clear()


class MemoryCamera:
    """Both ends of the camera: `firmware.FrameServer` and, by `latest`, `camera.FrameSource`."""

    endpoint = "memory"

    def __init__(self, transport_us: int) -> None:
        """Take the time from a frame's exposure until it lies decoded in the companion [µs]."""
        self.clock: Clock | None = None
        """The companion's."""
        self._under_way = UnderWay(transport_us)
        self.publish = self._under_way.send
        self._newest: ReceivedFrame | None = None

    @property
    def awaited(self) -> bool:
        """Whether the companion waits for the next exposure."""
        return self._under_way.awaited

    def close(self) -> None:
        """Forget all frames."""
        self._under_way.clear()

    def latest(self) -> ReceivedFrame | None:
        """Return the newest frame that has arrived, without waiting; None before the first."""
        now_us = 0 if self.clock is None else self.clock.time_us()
        arrived = self._under_way.arrived(now_us)
        if arrived is not None:
            self._newest = ReceivedFrame(arrived, now_us)
        return self._newest

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        """Wait for a frame that is not the one already seen; see `companion.camera.FrameSource`.

        Here the time-out counts in simulated time.
        """
        clock, under_way = self.clock, self._under_way
        if clock is None:
            raise RuntimeError("nobody looks: the camera has no companion's clock")
        deadline_us = clock.time_us() + int(timeout_s * US_PER_S)
        while True:
            newest = self.latest()
            if newest is not None and newest.frame.sequence != newer_than_sequence:
                return newest
            if clock.time_us() >= deadline_us:
                return None
            if under_way.next_us is not None:
                clock.sleep_until(min(deadline_us, under_way.next_us))
            else:
                under_way.published.clear()
                clock.sleep_until(deadline_us, under_way.published)


class TokenCamera:
    """The camera of a companion in another process. Implements `firmware.FrameServer`.

    Only the newest frame that has arrived when a turn begins is sent: the companion could not see
    any other.
    """

    def __init__(self, server: FrameServer, transport_us: int) -> None:
        """Take where the frames go, and the time from a frame's exposure until it arrives [µs]."""
        self.under_way = UnderWay(transport_us)
        self.endpoint = server.endpoint
        self._server = server
        self._newest: Frame | None = None

    @property
    def awaited(self) -> bool:
        """Whether the companion waits for the next exposure."""
        return self.under_way.awaited

    def publish(self, frame: Frame) -> None:
        """Send a frame on its way, in simulated time."""
        self.under_way.send(frame)

    def arrive(self, now_us: int) -> bool:
        """Take in what has arrived by `now_us` [µs]; return whether that is anything."""
        arrived = self.under_way.arrived(now_us)
        self._newest = arrived or self._newest
        return arrived is not None

    @property
    def sequence(self) -> int:
        """Sequence of the newest frame that has arrived."""
        return NO_FRAME if self._newest is None else self._newest.sequence

    def send(self) -> None:
        """Send that frame, by the wall clock; also again, to whoever may have missed it."""
        if self._newest is not None:
            self._server.publish(self._newest)

    def close(self) -> None:
        """Forget all frames; the server is its owner's to close."""
        self.under_way.clear()
