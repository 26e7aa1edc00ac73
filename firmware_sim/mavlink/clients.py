"""Clients of a link, each with separate streams and answers; forwarding and commanders.

PX4 SITL has a preset remote on each link (14540, 14550), which receives data before it sends any.
Every other sender of a valid frame becomes a client. A client starts with the link's default
streams and receives separate answers and parameter lists. Requests of one client do not affect the
others.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Geodetic
from airl_mav.core.signing import Signing
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.mavlink.codec import (
    COMPONENT_ID,
    Decoder,
    TextEncoder,
    WireMessage,
    dialect,
    is_signed,
)
from firmware_sim.mavlink.endpoint import Peer, Sender, SharedEndpoint
from firmware_sim.mavlink.event_buffer import EventSender
from firmware_sim.mavlink.link import Link, LinkCounters
from firmware_sim.mavlink.rate_limits import Allowance, ListeningTime, TickTime
from firmware_sim.mavlink.services.context import ANY, Context, sender

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
    events: EventSender | None = None
    """Event sender; None without an autopilot."""
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
        events = self.events
        return bool(
            self.link.scheduler.wake_us <= now_us
            or texts
            or self.late
            or self.link.pending
            or self.announced_origin is None
            or (events is not None and events.next_us <= now_us)
        )

    def next_us(self, now_us: int) -> float:
        """Return the next due time of all but the fast streams [µs]; `now_us` = immediately."""
        events, context, plan = self.events, self.context, self.link.scheduler
        # Pending frames and running transfers need the very next tick.
        if self.late or self.link.pending or (context is not None and context.is_busy):
            return now_us
        slow_us = plan.next_slow_us(now_us)
        if self.announced_origin is None:
            # The origin is announced only on the time grid of the slow streams.
            slow_us = min(slow_us, plan.grid_us(now_us))
        return slow_us if events is None else min(slow_us, events.next_us)

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
            heard = len(messages)
            messages = [m for m in messages if self._signing.accepts(bytes(m.get_msgbuf()))]
            self._gone += LinkCounters(0, 0, 0, 0, 0, refused=heard - len(messages))
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


COMMANDS = frozenset(
    (
        "COMMAND_LONG",
        "COMMAND_INT",
        "SET_MODE",
        "SET_POSITION_TARGET_LOCAL_NED",
        "SET_POSITION_TARGET_GLOBAL_INT",
        "SET_ATTITUDE_TARGET",
        "MANUAL_CONTROL",
        "RC_CHANNELS_OVERRIDE",
        "MISSION_COUNT",
        "MISSION_CLEAR_ALL",
        "MISSION_SET_CURRENT",
        "PARAM_SET",
        "SETUP_SIGNING",
    )
)
"""Messages that change the vehicle's behaviour."""

ANNOUNCED = (dialect.MAV_TYPE_GCS, dialect.MAV_TYPE_ONBOARD_CONTROLLER)
"""MAV_TYPE values in the heartbeat of a ground station and of a companion computer."""


class Senders:
    """Record of the systems that send commands and of those announced by a heartbeat."""

    def __init__(self) -> None:
        self._announced: set[tuple[int, int]] = set()
        """Announced system and component ids, kept while the links are open."""
        self._commands: Counter[tuple[int, int, str]] = Counter()

    def note(self, message: WireMessage, kind: str, source: tuple[int, int]) -> None:
        """Count a message from a sender if the message had an effect on this vehicle."""
        if kind in COMMANDS:
            self._commands[(*source, kind)] += 1
        elif kind == "HEARTBEAT" and message.type in ANNOUNCED:
            self._announced.add(source)

    def strangers(self) -> tuple[str, ...]:
        """Return a line per unannounced sender and message type since the last `forget`.

        A heartbeat after a command also announces its sender: MAVSDK starts with commands.
        """
        return tuple(
            f"system {system} component {component}, {kind} ({count} times)"
            for (system, component, kind), count in sorted(self._commands.items())
            if (system, component) not in self._announced
        )

    def forget(self) -> None:
        """Reset the counts for a new episode."""
        self._commands.clear()


REMEMBERED_FRAMES = 128
"""Number of recent frames per sender that are not forwarded again. Below 256, the number of
sequence numbers: a sender of heartbeats alone repeats its frames after that."""

REMEMBERED_SENDERS = 256

NEVER = frozenset((dialect.MAVLINK_MSG_ID_SETUP_SIGNING,))
"""Messages that are never forwarded. A signing key is for its recipient only."""


class Forwarder:
    """Message forwarder. Sends each frame once: programs that join two links cause no loop."""

    def __init__(self, everybody: Callable[[], Iterable[Client]]) -> None:
        """Store the callable that returns all clients of all links."""
        self._everybody = everybody
        self._seen: OrderedDict[tuple[int, int], deque[bytes]] = OrderedDict()

    def forward(self, message: WireMessage, origin: Client, system_id: int, now_us: int) -> bool:
        """Forward a message to the clients concerned; return True if any received it.

        Args:
            message: Received message.
            origin: Client that sent the message.
            system_id: System id of this vehicle.
            now_us: Simulated time [µs].
        """
        # Messages without target fields are broadcasts.
        target = getattr(message, "target_system", ANY), getattr(message, "target_component", ANY)
        if target == (system_id, COMPONENT_ID) or message.get_msgId() in NEVER:
            return False
        if not origin.forwards.left(now_us):
            return False
        # A frame never returns to the client that sent it.
        receivers = [
            client
            for client in self._everybody()
            if client is not origin and _concerns(target, client)
        ]
        if not receivers:
            return False
        # Only frames with a receiver enter the memory of recent frames.
        frame = bytes(message.get_msgbuf())
        if not self._is_new(sender(message), frame):
            return False
        origin.forwards.take(1, now_us)
        for client in receivers:
            client.link.pass_on(frame)
        return True

    def _is_new(self, source: tuple[int, int], frame: bytes) -> bool:
        frames = self._seen.get(source)
        if frames is None:
            # The sender that was silent longest is removed (`move_to_end` below keeps this order).
            if len(self._seen) >= REMEMBERED_SENDERS:
                self._seen.popitem(last=False)
            frames = self._seen[source] = deque(maxlen=REMEMBERED_FRAMES)
        if frame in frames:
            return False
        frames.append(frame)
        self._seen.move_to_end(source)
        return True


def _concerns(target: tuple[int, int], client: Client) -> bool:
    system, component = target
    # A target that no client has announced is unknown: the frame is dropped, as in MAVLink
    # routing.
    if system == ANY:
        return bool(client.components)
    if component == ANY:
        return any(heard[0] == system for heard in client.components)
    return target in client.components
