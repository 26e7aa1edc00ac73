"""MAVLink link faults: delay, jitter, loss, duplicates, reordering and a cut.

The faults wrap an endpoint, only in episodes with link faults.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Generic, TypeVar
from weakref import WeakValueDictionary

import numpy as np

from airl_mav.core.clock import Clock
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.faults import Part
from firmware_sim.fault_timeline import Acting, FaultTimeline
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import Peer, Sender, SharedEndpoint

UP, DOWN = 0, 1
"""Directions: to and from the flight controller."""

PARTS: tuple[tuple[Part, Part], tuple[Part, Part]] = (("link", "uplink"), ("link", "downlink"))
"""Parts whose faults affect each direction."""

MAVLINK_2 = 0xFD

STREAMED_UP = frozenset(
    {
        dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
        dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT,
        dialect.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET,
        dialect.MAVLINK_MSG_ID_MANUAL_CONTROL,
    }
)
"""Streamed messages of a companion, which have no acknowledgement."""

Frame = TypeVar("Frame")


class Lane(Generic[Frame]):
    """One direction of a link: frames in transit and the faults that affect them."""

    def __init__(self) -> None:
        self._acting: list[tuple[Acting, np.random.Generator]] = []
        self._under_way: deque[tuple[int, Frame]] = deque()
        self._delayed: Frame | None = None

    @property
    def quiet(self) -> bool:
        """True if frames pass as on a healthy link."""
        return not self._acting and not self._under_way and self._delayed is None

    @property
    def cut(self) -> bool:
        """True if the link is cut."""
        return any(each.fault.kind == "cut" for each, _ in self._acting)

    def set(self, acting: list[tuple[Acting, np.random.Generator]]) -> None:
        """Set the active faults, each with its random generator."""
        self._acting = acting

    def clear(self) -> None:
        """Discard all frames in transit and all faults."""
        self._acting = []
        self._under_way.clear()
        self._delayed = None

    def put(self, frame: Frame, now_us: int) -> None:
        """Send a frame at simulated `now_us` [µs]."""
        due_us, copies, wait = now_us, 1, False
        for each, rng in self._acting:
            kind = each.fault.kind
            if kind == "cut":
                return
            amount = each.fault.amount
            if kind == "delay":
                due_us += round(amount * US_PER_S)
            elif kind == "jitter":
                due_us += round(rng.uniform(0.0, amount) * US_PER_S)
            elif rng.random() < amount:
                if kind == "loss":
                    return
                copies += kind == "duplicate"
                wait = wait or kind == "reorder"
        if self._under_way:
            due_us = max(due_us, self._under_way[-1][0])
        if wait and self._delayed is None:
            self._delayed = frame
            return
        self._under_way.extend([(due_us, frame)] * copies)
        if self._delayed is not None:
            self._under_way.append((due_us, self._delayed))
            self._delayed = None

    def arrived(self, now_us: int) -> Iterator[Frame]:
        """Remove and yield the frames that have arrived by simulated `now_us` [µs], in order."""
        while self._under_way and self._under_way[0][0] <= now_us:
            yield self._under_way.popleft()[1]

    def hurry(self) -> None:
        """Make all frames in transit arrive immediately."""
        frames = [frame for _, frame in self._under_way]
        if self._delayed is not None:
            frames.append(self._delayed)
            self._delayed = None
        self._under_way = deque((0, frame) for frame in frames)


class FailingSender:
    """Sender to one peer over a failing link. Implements `endpoint.Sender`."""

    def __init__(self, endpoint: Sender, clock: Clock, *, conducted: bool) -> None:
        """Wrap the sender of a healthy link. Other arguments: see `FailingEndpoint`."""
        self.lane: Lane[bytes] = Lane()
        """Lane to the peer."""
        self._endpoint, self._clock, self._conducted = endpoint, clock, conducted

    send_errors = property(lambda self: self._endpoint.send_errors)
    """Number of chunks that could not be sent."""

    def send(self, data: bytes) -> None:
        """Send one frame, such as a reply."""
        lane = self.lane
        if lane.quiet or (self._conducted and not lane.cut):
            self._endpoint.send(data)
            return
        lane.put(data, self._clock.time_us())

    def send_streams(self, frames: Sequence[bytes]) -> None:
        """Send the telemetry of one tick, with all due frames in transit."""
        lane = self.lane
        if lane.quiet:
            self._endpoint.send_streams(frames)
            return
        now_us = self._clock.time_us()
        for frame in frames:
            lane.put(frame, now_us)
        if arrived := list(lane.arrived(now_us)):
            self._endpoint.send_streams(arrived)


class FailingEndpoint(FailingSender):
    """Endpoint behind a failing link. Implements `endpoint.SharedEndpoint`."""

    def __init__(self, endpoint: SharedEndpoint, clock: Clock, *, conducted: bool = False) -> None:
        """Wrap a healthy endpoint, with the simulated clock.

        If `conducted`, the companion runs in lockstep. A command and its reply then happen at the
        same simulated time: only a cut stops them, other faults affect setpoints and telemetry.
        Frames arrive at ticks, so that flights are reproducible.
        """
        super().__init__(endpoint, clock, conducted=conducted)
        self._shared, self.datagrams = endpoint, endpoint.datagrams
        self.fileno, self.close = endpoint.fileno, endpoint.close
        self._timeline: FaultTimeline | None = None
        self._up: Lane[tuple[Peer, bytes]] = Lane()
        self._senders: WeakValueDictionary[int, FailingSender] = WeakValueDictionary({0: self})
        """Senders still in use, by lane number."""
        self._lanes = 1
        """Number of lanes created so far; lane numbers are never reused."""
        self._generators: dict[tuple[int, int, int], np.random.Generator] = {}

    def begin(self, timeline: FaultTimeline | None) -> None:
        """Begin an episode with these faults, once per episode. Frames in transit are lost."""
        self._timeline = timeline
        self._generators.clear()
        self._up.clear()
        for sender in self._senders.values():
            sender.lane.clear()
        if timeline is not None:
            timeline.on_change(self._rearrange)
            self._rearrange()

    @property
    def is_polled(self) -> bool:
        """True if frames may have arrived although the descriptor is not readable."""
        return not self._up.quiet or self._shared.is_polled

    def receive(self) -> list[bytes]:
        """Return all chunks that have arrived, oldest first."""
        return [chunk for _, chunk in self.arrivals()]

    def arrivals(self) -> Iterator[tuple[Peer, bytes]]:
        """Yield received chunks with their peers, oldest first; see `SharedEndpoint`."""
        lane = self._up
        if lane.quiet:
            yield from self._shared.arrivals()
            return
        now_us = self._clock.time_us()
        for peer, chunk in self._shared.arrivals():
            if self._conducted and not lane.cut and not _is_streamed(chunk):
                # Keep the order: frames sent before a command arrive with it.
                lane.hurry()
                yield from lane.arrived(now_us)
                yield peer, chunk
            else:
                lane.put((peer, chunk), now_us)
        if not self._conducted or now_us % TICK_US == 0:
            yield from lane.arrived(now_us)

    def towards(self, peer: Peer) -> Sender | None:
        """Return the sender to one peer; None for a preset remote that is not set."""
        healthy = self._shared.towards(peer)
        if healthy is None:
            return None
        sender = FailingSender(healthy, self._clock, conducted=self._conducted)
        self._senders[self._lanes] = sender
        self._lanes += 1
        self._rearrange()
        return sender

    def _rearrange(self) -> None:
        if self._timeline is None:
            return
        self._up.set(self._acting(UP, 0))
        for key in [k for k in self._generators if k[1] == DOWN and k[2] not in self._senders]:
            del self._generators[key]
        for number, sender in self._senders.items():
            sender.lane.set(self._acting(DOWN, number))

    def _acting(self, direction: int, lane: int) -> list[tuple[Acting, np.random.Generator]]:
        """Return the faults of a direction, each with its random generator for a lane."""
        timeline = self._timeline
        if timeline is None:
            return []
        acting = []
        for each in timeline.acting(*PARTS[direction]):
            key = each.number, direction, lane
            if key not in self._generators:
                self._generators[key] = timeline.generator(*key)
            acting.append((each, self._generators[key]))
        return acting


def _is_streamed(frame: bytes) -> bool:
    """Return True if a chunk begins with a streamed message (`STREAMED_UP`)."""
    if not frame or frame[0] != MAVLINK_2:
        return False
    return int.from_bytes(frame[7:10], "little") in STREAMED_UP
