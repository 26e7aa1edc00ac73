"""Who is at the other end of a link: several clients, each with its streams and its answers.

PX4 SITL has a preset remote on each link (14540, 14550), which hears it before it has said
anything. Whoever else sends a valid frame becomes a client: it begins with the link's default
streams, and gets its own answers and parameter lists. What one client asks for changes nothing for
another.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Geodetic
from airl_mav.core.signing import Signing
from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.mavlink.codec import Decoder, TextEncoder, WireMessage, dialect, is_signed
from firmware_sim.mavlink.endpoint import Peer, Sender, SharedEndpoint
from firmware_sim.mavlink.event_buffer import EventSender
from firmware_sim.mavlink.limits import Allowance, ListeningTime, TickTime
from firmware_sim.mavlink.link import Link, LinkCounters
from firmware_sim.mavlink.services.context import Context

MAX_CLIENTS = 32
"""Clients of a link at a time, the preset remote not counted."""

MAX_COMPONENTS = 64
"""Systems and components behind one client, as behind a router."""

FORWARDS_PER_S = 250
"""Frames of one client that are passed on to others for long. A flood must not reach them."""

SILENT_US = 600 * US_PER_S
"""A client that has said nothing for so long in simulated time is forgotten [µs]."""

GONE_US = 5 * US_PER_S
"""Where a link has all its clients, one that was silent for so long makes room for another [µs].
Heartbeats come every second."""


@dataclass(slots=True, eq=False)
class Client:
    """One other end of a link."""

    peer: Peer
    link: Link
    texts: TextEncoder
    reply_texts: TextEncoder
    events: EventSender | None = None
    """As `context`."""
    context: Context | None = None
    """None while there is no autopilot."""
    announced_origin: Geodetic | None = None
    heard_us: int = 0
    """When it last sent a valid frame, in simulated time [µs]."""
    allowance: Allowance = field(default_factory=Allowance)
    forwards: Allowance = field(default_factory=lambda: Allowance(FORWARDS_PER_S, FORWARDS_PER_S))
    """Limits the frames that are passed on to others."""
    late: list[str] = field(default_factory=list)
    """Streams that have found no room in their tick."""
    components: set[tuple[int, int]] = field(default_factory=set)
    """System and component ids of who has been heard from its side."""

    def wakes(self, now_us: int, texts: Sequence[Message]) -> bool:
        """Return whether anything may have to be sent to it at simulated time [µs]."""
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
        """Return when anything but fast streams is sent to it next, `now_us` = at any time [µs]."""
        events, context, plan = self.events, self.context, self.link.scheduler
        if self.late or self.link.pending or (context is not None and context.is_busy):
            return now_us
        slow_us = plan.next_slow_us(now_us)
        if self.announced_origin is None:
            slow_us = min(slow_us, plan.grid_us(now_us))
        return slow_us if events is None else min(slow_us, events.next_us)

    def due(self, now_us: int) -> list[str]:
        """Return the streams to send now, at simulated time [µs]: first what is late."""
        due = self.link.scheduler.due(now_us)
        if self.late:
            late, self.late = self.late, []
            due = [*late, *(name for name in due if name not in late)]
        return due

    def close(self) -> None:
        """Release what is held for it."""
        if self.context is not None:
            self.context.close()

    def hear(self, source: tuple[int, int]) -> None:
        """Note whose message has come from this client: its system and component."""
        if len(self.components) < MAX_COMPONENTS:
            self.components.add(source)


class Clients:
    """The clients of one link."""

    def __init__(
        self,
        name: str,
        endpoint: SharedEndpoint,
        welcome: Callable[[Peer, Sender], Client],
        tick_time: TickTime,
        signing: Signing | None = None,
    ) -> None:
        """Begin with the preset remote, where there is one.

        Args:
            name: Of the link.
            endpoint: Where its clients are.
            welcome: Makes a client of who is heard for the first time.
            tick_time: Bounds the time that what arrives takes out of a tick.
            signing: Checks what strangers send; None: there is no key.
        """
        self.name = name
        self.endpoint = endpoint
        self._fileno = endpoint.fileno()
        self._welcome = welcome
        self._listening = ListeningTime(tick_time)
        self._signing = signing
        self._backlog: deque[tuple[Client, WireMessage]] = deque()
        """Decoded messages that wait for the next tick."""
        self._clients: dict[Peer, Client] = {}
        self._doorkeeper = Decoder(datagrams=endpoint.datagrams)
        """Reads what nobody known has sent."""
        self._strangers = Allowance()
        self._dropped = 0
        self._gone = LinkCounters(0, 0, 0, 0, 0)
        preset = endpoint.towards(None)
        if preset is not None:
            self._clients[None] = welcome(None, preset)

    def __iter__(self) -> Iterator[Client]:
        """Iterate over the clients: the preset remote, then by when they came."""
        return iter(tuple(self._clients.values()))

    def preset(self) -> Client | None:
        """Return the preset remote."""
        return self._clients.get(None)

    @property
    def counters(self) -> LinkCounters:
        """Traffic so far, of clients that are gone too."""
        total = self._gone + LinkCounters(
            0, 0, self._doorkeeper.malformed, self._doorkeeper.unknown, 0, self._dropped
        )
        for client in self._clients.values():
            total += client.link.counters
        return total

    def may_receive(self, readable: Collection[int]) -> bool:
        """Return whether something may have arrived: which descriptors are readable."""
        return bool(self._backlog) or self._fileno in readable or self.endpoint.is_polled

    def renew(self) -> None:
        """Begin another tick: what arrives may take its time again."""
        self._listening.renew()

    def restart(self, now_us: int) -> None:
        """Take simulated `now_us` [µs] as the present, whatever it was before."""
        self._backlog.clear()
        self._strangers.renew()
        for client in self._clients.values():
            client.allowance.renew()
            client.forwards.renew()
            client.heard_us = now_us

    def receive(self, now_us: int) -> Iterator[tuple[Client, WireMessage]]:
        """Yield what has arrived by simulated `now_us` [µs], and from whom, oldest first.

        What exceeds the allowance of its sender is dropped and counted; when the link's time of the
        tick is spent, the rest waits.
        """
        backlog, listening = self._backlog, self._listening
        arrivals = self.endpoint.arrivals()
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
        """Yield the messages of a chunk with their client. Excess over an allowance is dropped."""
        client = self._clients.get(peer)
        if client is None:
            client, messages = self._meet(peer, chunk, now_us)
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
        """Forget who has said nothing for long before simulated `now_us` [µs]."""
        for peer, client in tuple(self._clients.items()):
            if peer is not None and now_us - client.heard_us >= silent_us:
                self._gone += client.link.counters
                client.close()
                del self._clients[peer]

    def close(self) -> None:
        """Close the endpoint, and release what is held for the clients."""
        for client in self:
            client.close()
        self.endpoint.close()

    def _meet(
        self, peer: Peer, chunk: bytes, now_us: int
    ) -> tuple[Client | None, list[WireMessage]]:
        """Return the client that a stranger becomes by a valid frame, and what it said."""
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
                # What passes unsigned makes nobody a client: else one heartbeat with a false
                # address would send that address telemetry for minutes.
                return None, []
        if not messages:
            return None, []
        end = self.endpoint.towards(peer)
        if end is None or not self._room(now_us):
            self._dropped += 1
            return None, []
        client = self._welcome(peer, end)
        client.link.note(messages)
        client.allowance.take(len(messages), now_us)
        self._clients[peer] = client
        return client, messages

    def _room(self, now_us: int) -> bool:
        """Return whether another client can be taken. Who has gone silent makes room."""
        learned = [client for peer, client in self._clients.items() if peer is not None]
        if len(learned) < MAX_CLIENTS:
            return True
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
"""Messages that change what the vehicle does."""

ANNOUNCED = (dialect.MAV_TYPE_GCS, dialect.MAV_TYPE_ONBOARD_CONTROLLER)
"""Types in the heartbeat of a ground station and of a companion computer."""


class Senders:
    """Notes who commands, and whose heartbeat calls them a companion or a ground station."""

    def __init__(self) -> None:
        self._announced: set[tuple[int, int]] = set()
        """System and component ids. They hold for as long as the links are open."""
        self._commands: Counter[tuple[int, int, str]] = Counter()

    def note(self, message: WireMessage, kind: str, source: tuple[int, int]) -> None:
        """Take a message of a sender that was for this vehicle and did something."""
        if kind in COMMANDS:
            self._commands[(*source, kind)] += 1
        elif kind == "HEARTBEAT" and message.type in ANNOUNCED:
            self._announced.add(source)

    def strangers(self) -> tuple[str, ...]:
        """Return a line for each stranger and kind of message since the last `forget`.

        A stranger has not announced itself by now: MAVSDK commands before its first heartbeat.
        """
        return tuple(
            f"system {system} component {component}, {kind} ({count} times)"
            for (system, component, kind), count in sorted(self._commands.items())
            if (system, component) not in self._announced
        )

    def forget(self) -> None:
        """Begin anew: another episode."""
        self._commands.clear()
