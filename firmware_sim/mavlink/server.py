"""The MAVLink server of an autopilot: links, streams and services."""

from __future__ import annotations

import math
import select
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

from airl_mav.core.clock import Clock
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.signing import Signing, StoredSigning
from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.autopilot.port import AutopilotPort
from firmware_sim.engine.record import Record
from firmware_sim.interfaces import Truth
from firmware_sim.mavlink.clients import Client, Clients, Senders
from firmware_sim.mavlink.codec import COMPONENT_ID, REPLY_IDS, SYSTEM_ID, TextEncoder, WireMessage
from firmware_sim.mavlink.endpoint import Peer, Sender
from firmware_sim.mavlink.event_buffer import EventBuffer, EventSender
from firmware_sim.mavlink.forwarding import Forwarder
from firmware_sim.mavlink.limits import Allowance, Complaints, TickTime
from firmware_sim.mavlink.link import Link, LinkConfig, LinkCounters, Payloads
from firmware_sim.mavlink.own_streams import OwnStreams, Radio
from firmware_sim.mavlink.services import handle, peers, send_pending
from firmware_sim.mavlink.services.context import Context, sender
from firmware_sim.mavlink.services.transfers import RunningCalibration
from firmware_sim.mavlink.streams import BUILDERS, Builder
from firmware_sim.mavlink.streams.status import system_time
from firmware_sim.mavlink.telemetry import TickContext, flown_of
from firmware_sim.mavlink.tlog import TlogWriter, TrafficLog
from firmware_sim.storage import Storage

_DISCARD_CALLS = 16
"""Reads that empty a link for sure: so many times 256 datagrams exceed a socket's buffer."""

PIECES_PER_TICK = 32
"""Messages of lists and files that all clients together get per tick: 8,000 a second. One client
gets less in its turn; many share it, and a tick stays a tick."""

LEAST_PIECES_PER_TICK = 4
"""What they get of them in a tick that would be late with more: 1,000 a second."""

STREAMS_PER_TICK = 256
"""Streamed messages of all clients together per tick: 64,000 a second, a hundred times what PX4
sends by default. Who asks for more gets it later: all clients have equal shares then."""

TEXTS_PER_TICK = 8
"""Texts of services that go to all operators per tick."""

TEXTS_PER_S, TEXTS_BURST = 20, 50
"""Texts per second, and in a burst. All clients get each of them. Its event displaces an older one
in the buffer."""

FORGET_EVERY_US = US_PER_S
"""Silent clients are looked for so often [µs]."""


class MavlinkServer:
    """Speaks MAVLink on all links for one autopilot.

    Per tick: `receive`, then the autopilot's step, then `send`, all on one thread and with
    simulated time passed in. Nothing blocks, and no received message raises. Without an autopilot
    the vehicle is off: it neither sends nor receives.
    """

    def __init__(
        self,
        links: Sequence[LinkConfig],
        port: AutopilotPort | None = None,
        *,
        boot_unix_us: int,
        clock: Clock | None = None,
        signing: StoredSigning | None = None,
        storage: Storage | None = None,
    ) -> None:
        """Open the links: each streams its default rates from the first `send` on.

        Args:
            links: What they are made of.
            port: The autopilot; None: it comes later (`attach`).
            boot_unix_us: Calendar time of simulated time 0 [µs since 1970, UTC].
            storage: The vehicle's files, for MAVLink FTP; None: temporary ones. Closed with it.
            clock: Measures what part of a tick goes into received messages and bulk transfers, and
                bounds it; None, or a clock that stands still meanwhile: it is bounded by their
                number only.
            signing: The key that is asked for on all links; None: there is none until a client
                sets one, which is forgotten with the server.
        """
        self._port: AutopilotPort | None = None
        self._has_sample = False
        """Whether the autopilot has had a sample."""
        self._tick_time = TickTime(clock)
        self._stored = signing
        self._signing = (
            Signing(lambda: boot_unix_us + self._now_us) if signing is None else signing.signing
        )
        self._storage = storage or Storage()
        self._calibration = RunningCalibration()
        self._radio = Radio()
        self._now_us = 0
        self._forget_us = 0
        self._system_id = SYSTEM_ID
        self._streams, self._context = OwnStreams(), TickContext()
        self._texts: list[Message] = []
        self._announced = Allowance(TEXTS_PER_S, TEXTS_BURST)
        self._answers_apart = any(config.separate_replies for config in links)
        """Whether answers must leave the telemetry as it is: events are part of that."""
        self._events = EventBuffer()
        self._complaints = Complaints()
        self._first_in_turn = 0
        """Place of the client that is the next to get what it gets piece by piece."""
        self._senders = Senders()
        self.strangers = self._senders.strangers
        # The same functions on every link: what two links send in one tick is built once.
        self._builders: dict[str, Builder | None] = {
            **BUILDERS,
            "SYSTEM_TIME": system_time(boot_unix_us),
            **self._streams.builders,
            "TIMESYNC": None,
        }
        self._forwarder = Forwarder(self._all)
        self._traffic = TrafficLog(lambda: self._now_us)
        self._links = [self._open(config, link_id) for link_id, config in enumerate(links)]
        self._arrivals = select.poll()
        for number in self.filenos():
            self._arrivals.register(number, select.POLLIN)
        self._is_transferring = True
        """Whether a client may get something piece by piece: lists, files, logs."""
        self._mission_progress: object = None
        if port is not None:
            self.attach(port)

    def attach(self, port: AutopilotPort, truth: Callable[[], Truth] | None = None) -> None:
        """Replace the autopilot, between two episodes; `truth` is what clients ask for as such.

        Clients and the rates that they have set are kept; running parameter lists and messages for
        the old autopilot (stale setpoints) are dropped. Simulated time may start anew.
        """
        if self._port is not None:
            self._discard()
        self._port, self._has_sample = port, False
        self._forget_us = 0
        self._system_id = _system_id(port)
        self._streams.attach(port, truth, self._system_id)
        self._senders.forget()
        self._complaints.restart()
        self._announced.renew()
        self._calibration = RunningCalibration()
        self._events = EventBuffer()
        for clients in self._links:
            clients.restart(self._now_us)
            for client in clients:
                self._connect(client, port)
                client.link.scheduler.restart()

    def receive(self, now_us: int) -> int:
        """Read and carry out everything that has arrived by simulated `now_us` [µs].

        Returns how many messages took effect.
        """
        self._now_us = now_us
        effective = 0
        readable = [number for number, _ in self._arrivals.poll(0)]
        for clients in self._links:
            if not clients.may_receive(readable):
                continue
            for client, message in clients.receive(now_us):
                if self._dispatch(client, message):
                    effective += 1
                else:
                    client.link.ignored += 1
        if self._texts:
            self._send_texts()
        return effective

    def next_send_us(self) -> float:
        """Return when `send` has to be called next [µs]: fast streams may wait until then."""
        now_us = self._now_us + TICK_US
        return min((client.next_us(now_us) for client in self._all()), default=math.inf)

    def send(self, now_us: int, flown: Record | None = None) -> None:
        """Send texts, pending parameters and the streams that are due at simulated `now_us` [µs].

        Args:
            now_us: Time after the newest tick.
            flown: (n,) logs of the ticks since the last call; None = of one tick, as the
                autopilot's state is now.
        """
        self._now_us = now_us
        self._tick_time.renew(now_us)
        port = self._port
        if port is None:
            return
        if not self._has_sample:
            if port.sample is None:
                return
            self._has_sample = True
        after_us = TICK_US
        if flown is None:
            flown = flown_of(port.state())
            after_us = now_us - flown["time_us"].item(0)
        self._streams.vibration.update(flown)
        texts: list[Message] = port.take_messages()
        if texts:
            texts = list(dict.fromkeys(texts))  # once a tick; as `_announce`
        for event in port.take_events():
            self._events.add(event, now_us)
        everyone = list(self._all())
        progress = port.plans.progress
        if self._is_transferring or progress != self._mission_progress:
            self._mission_progress = progress
            self._send_pending(everyone, now_us)
            self._is_transferring = any(
                c.context is not None and c.context.is_busy for c in everyone
            )
        due = [(client, client.due(now_us)) for client in everyone if client.wakes(now_us, texts)]
        if due:
            self._stream(due, flown, after_us, texts)
        if now_us >= self._forget_us:
            self._forget(now_us)

    def _stream(
        self,
        due: Sequence[tuple[Client, list[str]]],
        flown: Record,
        after_us: int,
        texts: Sequence[Message],
    ) -> None:
        """Send clients texts, events and the streams that are due.

        Args:
            due: Clients that have something to be sent, and their slow streams.
            flown: (n,) logs of the newest ticks.
            after_us: Time from the log of a tick to its end [µs].
            texts: For operators.
        """
        assert self._port is not None  # noqa: S101 (the caller has looked)
        now_us, state = self._now_us, self._port.state()
        origin, before, last = state.origin, self._context.row, len(flown) - 1
        context = self._context.of(state)
        if context is not before:
            for client in self._all():
                client.link.scheduler.quiet.clear()  # Home may be known now, or the pilot heard.
        payloads: Payloads = {}
        most = max(1, STREAMS_PER_TICK // (2 * len(due)))
        share = _share([len(names) for _, names in due])
        for client, names in due:
            link = client.link
            if link.scheduler.fast_us <= now_us:
                if context is not before and last > 0:
                    # A stretch of ticks ends with the first one after a change.
                    link.stream_fast(flown[:last], after_us, before, most)
                    link.stream_fast(flown[last:], after_us, context, most)
                else:
                    link.stream_fast(flown, after_us, context, most)
            if texts or (client.events is not None and client.events.has_news(now_us)):
                _stream_news(client, texts, now_us)
            if len(names) > share:
                names, client.late = names[:share], names[share:]
            moved = origin is not None and origin != client.announced_origin
            if moved and link.scheduler.is_time(now_us):
                client.announced_origin = origin
                names = ["GPS_GLOBAL_ORIGIN", *names]
            if names:
                link.stream_due(names, state, payloads)
            link.flush()

    def _forget(self, now_us: int) -> None:
        """Forget silent clients, complain of floods, save the newest time stamp of signatures."""
        self._forget_us = now_us + FORGET_EVERY_US
        for clients in self._links:
            clients.forget_silent(now_us)
            count = clients.counters
            for text in self._complaints.due(clients.name, count.refused, count.dropped, now_us):
                _tell(clients, text)
        if self._stored is not None:
            self._stored.save_due()

    def _send_pending(self, clients: Sequence[Client], now_us: int) -> None:
        """Send clients what is next of what they get piece by piece.

        Who comes too late for this tick is first in the next.
        """
        first = self._first_in_turn
        sent = 0
        for turn in range(len(clients)):
            place = (first + turn) % len(clients)
            if sent >= PIECES_PER_TICK or (
                sent >= LEAST_PIECES_PER_TICK and self._tick_time.is_short()
            ):
                self._first_in_turn = place
                return
            context, link = clients[place].context, clients[place].link
            if context is None:
                continue
            context.now_us = now_us
            before = link.sent
            send_pending(context)
            sent += link.sent - before

    def log_to(self, tlog: TlogWriter | None, link: str = "onboard") -> None:
        """Write both directions of a link's preset remote to a tlog from now on; None ends it.

        Every other client that speaks, on any link, has a log of its own beside it. The caller
        closes the writer. Raises ValueError if there is no such link.
        """
        (clients,) = (clients for clients in self._links if clients.name == link)
        if tlog is None:
            self._traffic.end()
        else:
            self._traffic.begin(tlog, clients.preset())

    def counters(self) -> dict[str, LinkCounters]:
        """Return the traffic per link name, all its clients together."""
        return {clients.name: clients.counters for clients in self._links}

    def filenos(self) -> list[int]:
        """Return the descriptors that become readable when something arrives."""
        numbers = (clients.endpoint.fileno() for clients in self._links)
        return [number for number in numbers if number is not None]

    def close(self) -> None:
        """Close endpoints and storage, and keep the newest time stamp of signatures."""
        if self._stored is not None:
            self._stored.save()
        for clients in self._links:
            clients.close()
        self._storage.close()

    def _open(self, config: LinkConfig, link_id: int) -> Clients:
        def welcome(peer: Peer, endpoint: Sender) -> Client:
            builders = self._link_builders()
            # A requested PING must not advance the sequence of those that are streamed.
            replies = self._link_builders() if config.separate_replies else builders
            link = Link(
                config,
                builders,
                replies,
                endpoint=endpoint,
                system_id=self._system_id,
                signing=self._signing,
                link_id=link_id,
            )
            texts = TextEncoder()
            reply_texts = TextEncoder(REPLY_IDS) if config.separate_replies else texts
            client = Client(peer, link, texts, reply_texts, heard_us=self._now_us)
            if self._port is not None:
                self._connect(client, self._port)
                link.scheduler.restart()
            return client

        return Clients(config.name, config.endpoint, welcome, self._tick_time, self._signing)

    def _connect(self, client: Client, port: AutopilotPort) -> None:
        client.link.identify(self._system_id)
        client.close()
        client.context = Context(
            client.link,
            port,
            self._now_us,
            self._announce,
            self._broadcast,
            self._events,
            self._signing,
            self._system_id,
            storage=self._storage,
            calibration=self._calibration,
            radio=self._radio,
        )
        self._is_transferring = True
        client.events = EventSender(self._events)
        client.announced_origin = None

    def _discard(self) -> None:
        """Drop what has arrived for the autopilot that goes."""
        for clients in self._links:
            for _ in range(_DISCARD_CALLS):
                clients.renew()
                for client, _message in clients.receive(self._now_us):
                    client.link.ignored += 1

    def _link_builders(self) -> dict[str, Builder | None]:
        return {
            **self._builders,
            "PING": peers.ping_requests(),
            "RC_CHANNELS": self._radio.updates(),
        }

    def _dispatch(self, client: Client, message: WireMessage) -> bool:
        source, context = sender(message), client.context
        # What comes from the vehicle itself is an echo.
        if source == (self._system_id, COMPONENT_ID) or context is None:
            return False
        context.now_us = self._now_us
        self._is_transferring = True  # `send` looks whether it does
        client.hear(source)
        self._traffic.heard(client, message)
        kind = message.get_type()
        effective = handle(message, kind, context)
        if effective:
            self._senders.note(message, kind, source)
        forwarded = self._forwarder.forward(message, client, self._system_id, self._now_us)
        return effective or forwarded

    def _send_texts(self) -> None:
        """Send the texts of the services to the operators."""
        for text in self._texts:
            _tell(self._all(), text)
        self._texts.clear()

    def _announce(self, text: Message) -> None:
        """Tell the operators once a tick: a client that repeats itself must not flood others."""
        if text in self._texts or len(self._texts) >= TEXTS_PER_TICK:
            return
        if not self._announced.left(self._now_us):
            return
        self._announced.take(1, self._now_us)
        if text.event is not None and self._answers_apart:
            text = replace(text, event=None)
        elif text.event is not None:
            self._events.add(text.event, self._now_us)
        self._texts.append(text)

    def _broadcast(self, name: str, payload: bytes) -> None:
        for client in self._all():
            client.link.send_payload(name, payload)

    def _all(self) -> Iterator[Client]:
        return chain.from_iterable(self._links)


def _stream_news(client: Client, texts: Iterable[Message], now_us: int) -> None:
    """Add texts, and the events that a client lacks, to its telemetry."""
    for text in texts:
        for chunk in client.texts.encode(text):
            client.link.stream(chunk)
    if client.events is not None:
        for message in client.events.due(now_us):
            client.link.stream(message)


def _tell(clients: Iterable[Client], text: Message) -> None:
    for client in clients:
        for chunk in client.reply_texts.encode(text):
            client.link.send(chunk)


def _share(asked: Sequence[int]) -> int:
    """Return how many streamed messages each client may get in a tick, of those it asks for."""
    if sum(asked) <= STREAMS_PER_TICK // 2:
        return STREAMS_PER_TICK // 2
    return max(1, STREAMS_PER_TICK // 2 // sum(1 for number in asked if number))


def _system_id(port: AutopilotPort) -> int:
    """Return MAV_SYS_ID, which PX4 reads when it boots."""
    stored = port.parameters.by_name("MAV_SYS_ID")
    return SYSTEM_ID if stored is None else int(stored.value)
