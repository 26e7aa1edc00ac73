"""Clients of a link, each with separate streams and answers, and the limits on their data.

PX4 SITL has a preset remote on each link (14540, 14550), which receives data before it sends any.
Every other sender of a valid frame becomes a client. A client starts with the link's default
streams and receives separate answers and parameter lists. Requests of one client do not affect the
others.

Too much MAVLink processing delays a tick, so frames per client and time per tick are limited. The
idle time before the next tick delays nothing, so the limit there is higher.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field

from airl_mav.core.clock import Clock
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.frames import Geodetic
from airl_mav.core.signing import Signing
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.mavlink.codec import Decoder, WireMessage, is_signed
from firmware_sim.mavlink.endpoint import Peer, Sender, SharedEndpoint
from firmware_sim.mavlink.link import Link, LinkCounters
from firmware_sim.mavlink.services import Context
from firmware_sim.mavlink.texts_and_events import EventSender, TextEncoder

FRAMES_PER_S = 2_000
"""Sustained frame rate of one client [1/s]: eight times the rate of a setpoint per tick."""

BURST_FRAMES = 500
"""Maximum burst of one client [frames]: a ground station requests up to 500 parameters at once."""


class Allowance:
    """Generic cell rate algorithm (ITU-T I.371) in integer microseconds of simulated time.

    Counts frames and reads no clock: the result depends only on frames and their simulated times.
    """

    def __init__(self, per_s: int = FRAMES_PER_S, burst: int = BURST_FRAMES) -> None:
        """Allow a sustained rate of `per_s` frames per second, and bursts of `burst` frames."""
        self._each_us = US_PER_S // per_s
        self._ahead_us = self._each_us * burst
        self._until_us = 0
        """Simulated time at which the counted frames no longer limit the rate [µs]."""

    def left(self, now_us: int) -> bool:
        """Return True if another frame is allowed at simulated `now_us` [µs]."""
        return self._until_us - now_us < self._ahead_us

    def take(self, frames: int, now_us: int) -> None:
        """Count frames received at simulated `now_us` [µs]."""
        self._until_us = max(self._until_us, now_us) + self._each_us * frames

    def renew(self) -> None:
        """Reset the counted frames, because simulated time may restart."""
        self._until_us = 0


LISTEN_US = TICK_US // 8
"""Maximum time per tick for received data of one link [µs of the pacing clock]. The rest waits for
the next tick."""

IDLE_LISTEN_US = TICK_US // 4
"""Maximum additional time for received data of all links while the simulator is idle before the
next tick [µs of the pacing clock]. During a flood the companion, on the same host, needs part of
the processor."""

BULK_RESERVE_US = TICK_US // 8
"""Time before the next tick at which bulk transfers stop, to read received data [µs of the pacing
clock]."""


class TickTime:
    """Time before the next tick, common to all links."""

    def __init__(self, clock: Clock | None) -> None:
        """Store the pacing clock; None = no pacing, so time is unlimited."""
        self.clock = clock
        self.next_us = 0
        """Simulated time at which the next tick starts [µs]."""
        self.idle_us = IDLE_LISTEN_US
        """Remaining idle time for received data before the next tick [µs]."""

    def renew(self, next_us: int) -> None:
        """Start the time budget that ends with the tick at simulated `next_us` [µs]."""
        self.next_us = next_us
        self.idle_us = IDLE_LISTEN_US

    def is_short(self) -> bool:
        """Return True if bulk transfers must wait because the next tick is near."""
        return self.clock is not None and self.clock.time_us() > self.next_us - BULK_RESERVE_US


class ListeningTime:
    """Time budget per tick for the received data of one link."""

    def __init__(self, tick: TickTime) -> None:
        self._tick = tick
        self._tick_us = tick.next_us
        self._left_us = LISTEN_US
        self._looked_us = 0

    def renew(self) -> None:
        """Reset the budget for a new tick."""
        self._left_us = LISTEN_US

    def begin(self) -> bool:
        """Start reading, with a new budget in a new tick; return True if time is limited."""
        tick = self._tick
        # Without a clock only the number of messages is limited.
        if tick.clock is None:
            return False
        # `begin` runs several times per tick; the budget renews once per tick.
        if self._tick_us != tick.next_us:
            self._tick_us, self._left_us = tick.next_us, LISTEN_US
        self._looked_us = tick.clock.time_us()
        return True

    def left(self) -> bool:
        """Charge the time since the last call; return True if time remains."""
        tick = self._tick
        if tick.clock is None:
            return True
        now_us = tick.clock.time_us()
        spent_us, self._looked_us = now_us - self._looked_us, now_us
        # Idle time is charged first: it delays no tick.
        idle = now_us < tick.next_us
        if idle and tick.idle_us > 0:
            tick.idle_us -= spent_us
        else:
            self._left_us -= spent_us
        return self._left_us > 0 or (idle and tick.idle_us > 0)


EVERY_US = 10 * US_PER_S
"""Minimum interval between two warnings of one type [µs]."""


class Complaints:
    """Operator warnings about rejected and dropped data, at a limited rate."""

    def __init__(self) -> None:
        self._last: dict[tuple[str, str], tuple[int, int]] = {}
        """Last warning by link and problem: time [µs], counter value."""

    def restart(self) -> None:
        """Restart the intervals, because simulated time may restart. Keeps reported counts."""
        self._last = {key: (-EVERY_US, count) for key, (_, count) in self._last.items()}

    def due(self, name: str, refused: int, dropped: int, now_us: int) -> list[OperatorText]:
        """Return the warnings due on a link at `now_us` [µs] about rejected and dropped data."""
        texts: list[OperatorText] = []
        counts = {
            "frames refused: bad signature": refused,
            "datagrams dropped: flood or full": dropped,
        }
        for problem, count in counts.items():
            # The first warning is due at once.
            last_us, last = self._last.get((name, problem), (-EVERY_US, 0))
            if count > last and now_us - last_us >= EVERY_US:
                self._last[name, problem] = now_us, count
                texts.append(OperatorText(Severity.WARNING, f"{name}: {count - last} {problem}"))
        return texts


MAX_CLIENTS = 32
"""Maximum number of clients of a link, without the preset remote."""

MAX_COMPONENTS = 64
"""Maximum number of systems and components behind one client, for example a router."""

FORWARDS_PER_S = 250
"""Sustained rate of frames forwarded for one client [1/s]. Keeps a flood from the other clients."""

SILENT_US = 600 * US_PER_S
"""Simulated time without a message after which a client is removed [µs]."""

GONE_US = 5 * US_PER_S
"""Silence after which a client is replaced when the link is full [µs]. Heartbeats come every
second."""


@dataclass(slots=True, eq=False)
class Client:
    """Client of a link: peer, streams, and rate limits."""

    peer: Peer
    link: Link
    texts: TextEncoder
    reply_texts: TextEncoder
    events: EventSender
    context: Context | None = None
    """Context of the handlers; None without an autopilot."""
    announced_origin: Geodetic | None = None
    heard_us: int = 0
    """Simulated time of the last valid frame [µs]."""
    allowance: Allowance = field(default_factory=Allowance)
    forwards: Allowance = field(default_factory=lambda: Allowance(FORWARDS_PER_S, FORWARDS_PER_S))
    """Limit on the frames forwarded to other clients."""
    late: list[str] = field(default_factory=list)
    """Streams deferred from an earlier tick, because the tick was full."""
    components: set[tuple[int, int]] = field(default_factory=set)
    """System and component ids of all senders seen through this client."""

    def wakes(self, now_us: int, texts: Sequence[OperatorText]) -> bool:
        """Return True if anything may be due for this client at simulated time [µs]."""
        # Ordered by cost and likelihood: the due time alone decides in most ticks.
        return bool(
            self.link.scheduler.wake_us <= now_us
            or texts
            or self.late
            or self.link.pending
            or self.announced_origin is None
            or self.events.next_us <= now_us
        )

    def next_us(self, now_us: int) -> float:
        """Return the next due time of all but the fast streams [µs]; `now_us` = immediately."""
        context, plan = self.context, self.link.scheduler
        # Pending frames and running transfers need the very next tick.
        if self.late or self.link.pending or (context is not None and context.is_busy):
            return now_us
        slow_us = plan.next_slow_us(now_us)
        if self.announced_origin is None:
            # The origin is announced only on the time grid of the slow streams.
            slow_us = min(slow_us, plan.grid_us(now_us))
        return min(slow_us, self.events.next_us)

    def due(self, now_us: int) -> list[str]:
        """Return the streams due at simulated time [µs], deferred ones first."""
        due = self.link.scheduler.due(now_us)
        if self.late:
            late, self.late = self.late, []
            # A deferred stream that is due again is sent once.
            due = [*late, *(name for name in due if name not in late)]
        return due

    def close(self) -> None:
        """Release the client's resources."""
        if self.context is not None:
            self.context.close()

    def hear(self, source: tuple[int, int]) -> None:
        """Add the system and component id of a received message."""
        if len(self.components) < MAX_COMPONENTS:
            self.components.add(source)


class Clients:
    """Clients of one link."""

    def __init__(
        self,
        name: str,
        endpoint: SharedEndpoint,
        welcome: Callable[[Peer, Sender], Client],
        tick_time: TickTime,
        signing: Signing | None = None,
    ) -> None:
        """Start with the preset remote, if the endpoint has one.

        Args:
            name: Name of the link.
            endpoint: Endpoint that all clients share.
            welcome: Creates a client for a new peer.
            tick_time: Limit on the processing time of received data per tick.
            signing: Checks frames of unknown peers; None = no key.
        """
        self.name = name
        self.endpoint = endpoint
        self._fileno = endpoint.fileno()
        self._welcome = welcome
        self._listening = ListeningTime(tick_time)
        self._signing = signing
        self._backlog: deque[tuple[Client, WireMessage]] = deque()
        """Decoded messages deferred to the next tick."""
        self._clients: dict[Peer, Client] = {}
        # One decoder for all unknown peers bounds the memory that spoofed addresses can use.
        self._doorkeeper = Decoder(datagrams=endpoint.datagrams)
        """Decoder for data from unknown peers."""
        self._strangers = Allowance()
        self._dropped = 0
        self._gone = LinkCounters(0, 0, 0, 0, 0)
        # PX4 SITL sends to the preset remote before that remote sends any data.
        preset = endpoint.towards(None)
        if preset is not None:
            self._clients[None] = welcome(None, preset)

    def __iter__(self) -> Iterator[Client]:
        """Iterate over the clients: the preset remote, then in order of arrival."""
        return iter(tuple(self._clients.values()))

    def preset(self) -> Client | None:
        """Return the preset remote; None if the link has none."""
        return self._clients.get(None)

    @property
    def counters(self) -> LinkCounters:
        """Traffic since the start, including removed clients."""
        total = self._gone + LinkCounters(
            0, 0, self._doorkeeper.malformed, self._doorkeeper.unknown, 0, self._dropped
        )
        for client in self._clients.values():
            total += client.link.counters
        return total

    def may_receive(self, readable: Collection[int]) -> bool:
        """Return True if data may have arrived, given the readable descriptors."""
        return bool(self._backlog) or self._fileno in readable or self.endpoint.is_polled

    def renew(self) -> None:
        """Reset the processing time of received data for a new tick."""
        self._listening.renew()

    def restart(self, now_us: int) -> None:
        """Restart at simulated `now_us` [µs], which may be earlier than before."""
        self._backlog.clear()
        self._strangers.renew()
        for client in self._clients.values():
            client.allowance.renew()
            # A restart can set the time back, which would leave the rate limits exhausted.
            client.forwards.renew()
            client.heard_us = now_us

    def receive(self, now_us: int) -> Iterator[tuple[Client, WireMessage]]:
        """Yield messages received by simulated `now_us` [µs] with their clients, oldest first.

        Data over a sender's rate limit is dropped and counted. When the link's share of the tick is
        used up, the rest waits for the next tick.
        """
        backlog, listening = self._backlog, self._listening
        arrivals = self.endpoint.arrivals()
        # Decoded messages come first, which keeps the order of arrival.
        bounded = listening.begin()
        while not bounded or listening.left():
            if backlog:
                yield backlog.popleft()
                continue
            arrived = next(arrivals, None)
            if arrived is None:
                return
            backlog.extend(self._heard(*arrived, now_us))

    def _heard(self, peer: Peer, chunk: bytes, now_us: int) -> Iterator[tuple[Client, WireMessage]]:
        """Yield the messages of a chunk with their client. Drops data over the rate limit."""
        client = self._clients.get(peer)
        if client is None:
            client, messages = self._meet(peer, chunk, now_us)
        # An empty or damaged chunk also costs one frame of the allowance.
        elif client.allowance.left(now_us):
            messages = client.link.decode(chunk)
            client.allowance.take(max(1, len(messages)), now_us)
        else:
            self._dropped += 1
            return
        if client is not None and messages:
            client.heard_us = now_us
            for message in messages:
                yield client, message

    def forget_silent(self, now_us: int, silent_us: int = SILENT_US) -> None:
        """Remove clients without a message for `silent_us` before simulated `now_us` [µs]."""
        for peer, client in tuple(self._clients.items()):
            # The preset remote (peer None) stays, as in PX4 SITL.
            if peer is not None and now_us - client.heard_us >= silent_us:
                self._gone += client.link.counters
                client.close()
                del self._clients[peer]

    def close(self) -> None:
        """Close the endpoint and release the resources of all clients."""
        for client in self:
            client.close()
        self.endpoint.close()

    def _meet(
        self, peer: Peer, chunk: bytes, now_us: int
    ) -> tuple[Client | None, list[WireMessage]]:
        """Return the client created by a valid frame from a new peer, and its messages."""
        # All unknown peers share one rate limit, so changing the source address does not evade it.
        if not self._strangers.left(now_us):
            self._dropped += 1
            return None, []
        messages = self._doorkeeper.feed(chunk)
        self._strangers.take(max(1, len(messages)), now_us)
        if self._signing is not None and self._signing.key is not None:
            count = len(messages)
            messages = [m for m in messages if self._signing.accepts(bytes(m.get_msgbuf()))]
            self._gone += LinkCounters(0, 0, 0, 0, 0, refused=count - len(messages))
            if not any(is_signed(m) for m in messages):
                # An accepted unsigned frame creates no client. Otherwise one heartbeat with a
                # spoofed source address would direct minutes of telemetry to that address.
                return None, []
        if not messages:
            return None, []
        end = self.endpoint.towards(peer)
        # The room check comes last, because it can remove a silent client.
        if end is None or not self._room(now_us):
            self._dropped += 1
            return None, []
        client = self._welcome(peer, end)
        # The shared decoder has counted these messages; the client's link must count them too.
        client.link.note(messages)
        client.allowance.take(len(messages), now_us)
        self._clients[peer] = client
        return client, messages

    def _room(self, now_us: int) -> bool:
        """Return True if the link accepts another client. Removes silent clients if necessary."""
        learned = [client for peer, client in self._clients.items() if peer is not None]
        if len(learned) < MAX_CLIENTS:
            return True
        # A full link gives the place of its most silent client to the new client.
        silent_us = now_us - min(client.heard_us for client in learned)
        if silent_us < GONE_US:
            return False
        self.forget_silent(now_us, silent_us)
        return True
