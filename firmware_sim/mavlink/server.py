"""The MAVLink server of an autopilot: links, streams and services."""

from __future__ import annotations

import math
import select
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Any

from airl_mav.core.clock import Clock
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.signing import Signing, StoredSigning
from firmware_sim import sensor_table
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.engine.record import Record
from firmware_sim.interfaces import TrueState
from firmware_sim.mavlink import streams
from firmware_sim.mavlink.clients import Allowance, Client, Clients, Complaints, TickTime
from firmware_sim.mavlink.codec import COMPONENT_ID, SYSTEM_ID, WireMessage
from firmware_sim.mavlink.endpoint import Peer, Sender, SharedEndpoint
from firmware_sim.mavlink.link import Link, LinkCounters, Payloads
from firmware_sim.mavlink.px4_links import LinkConfig, UdpLinks, gcs_link, onboard_link
from firmware_sim.mavlink.services import Context, connection, handle, send_pending, sender, table
from firmware_sim.mavlink.streams.sensors import Radio
from firmware_sim.mavlink.telemetry import TickContext, flown_of
from firmware_sim.mavlink.texts_and_events import REPLY_IDS, EventBuffer, EventSender, TextEncoder
from firmware_sim.mavlink.traffic import READING, Effects, Forwarder, TlogWriter, TrafficLog

_DISCARD_CALLS = 16
"""Number of reads that empty a link: 16 times 256 datagrams exceed a socket's buffer."""

PIECES_PER_TICK = 32
"""Maximum list and file messages of all clients per tick: 8,000 per second. Bounds the tick when
many clients take turns; one client receives fewer."""

LEAST_PIECES_PER_TICK = 4
"""Number of list and file messages per tick if the next tick is near: 1,000 per second."""

STREAMS_PER_TICK = 256
"""Maximum streamed messages of all clients per tick: 64,000 per second, a hundred times PX4's
default. All clients have equal shares; messages beyond a share are delayed."""

TEXTS_PER_TICK = 8
"""Maximum service texts to all operators per tick."""

TEXTS_PER_S, TEXTS_BURST = 20, 50
"""Service texts per second, and per burst. Every client receives each text, and a text's event
displaces an older one in the buffer."""

FORGET_EVERY_US = US_PER_S
"""Interval of the search for silent clients [µs]."""


class MavlinkServer:
    """MAVLink server of one autopilot, on all links.

    Per tick: `receive`, then the autopilot's step, then `send`, all on one thread and with
    simulated time passed in. No call blocks, and no received message raises. Without an autopilot
    the vehicle is off: it neither sends nor receives.
    """

    def __init__(
        self,
        links: Sequence[LinkConfig],
        port: BuiltinAutopilot | None = None,
        *,
        boot_unix_us: int,
        clock: Clock | None = None,
        signing: StoredSigning | None = None,
    ) -> None:
        """Open the links. Each streams its default rates from the first `send`.

        Args:
            links: Configurations of the links.
            port: Autopilot; None = attached later (`attach`).
            boot_unix_us: Calendar time of simulated time 0 [µs since 1970, UTC].
            clock: Limits the time per tick for received messages and bulk transfers. None, or a
                clock that stops during the tick: only their number is limited.
            signing: Stored key, required on all links; None = no key until a client sets one, which
                is lost when the server closes.
        """
        self._port: BuiltinAutopilot | None = None
        self._has_sample = False
        """True if the autopilot has received a sample."""
        self._tick_time = TickTime(clock)
        self._stored = signing
        self._signing = (
            Signing(lambda: boot_unix_us + self._now_us) if signing is None else signing.signing
        )
        self.vehicle_states: dict[type, Any] = {}
        """States of services that all clients share, by class."""
        table("HANDLERS")  # loads the services
        self._radio = Radio()
        self._now_us = 0
        self._forget_us = 0
        self._system_id = SYSTEM_ID
        self._vehicle, self._context = streams.Vehicle(boot_unix_us), TickContext()
        self._texts: list[OperatorText] = []
        self._announced = Allowance(TEXTS_PER_S, TEXTS_BURST)
        self._answers_apart = any(config.separate_replies for config in links)
        """True if replies must not change the telemetry, which includes events."""
        # The buffer is common to all clients; each client has its own position in it.
        self._events = EventBuffer()
        self._complaints = Complaints()
        self._first_in_turn = 0
        """Index of the first client in the next round of list and file messages."""
        self._effects = Effects()
        self.effects = self._effects.effects
        # All links share these builders, so each message is built once per tick.
        self._builders: dict[str, streams.Builder | None] = {
            **streams.BUILDERS,
            **streams.addon_builders(),
            **{
                name: partial(build, self._vehicle)
                for name, build in streams.VEHICLE_BUILDERS.items()
            },
            **{name: each.build for name, each in sensor_table.streams().items()},
            "TIMESYNC": None,
        }
        self._forwarder = Forwarder(self._all)
        self._traffic = TrafficLog(lambda: self._now_us)
        self._links = [self._open(config, link_id) for link_id, config in enumerate(links)]
        # One poll for all sockets: most ticks receive nothing.
        self._arrivals = select.poll()
        for number in self.filenos():
            self._arrivals.register(number, select.POLLIN)
        self._is_transferring = True  # possibly: `send` checks
        self._mission_progress: object = None
        if port is not None:
            self.attach(port)

    def attach(self, port: BuiltinAutopilot, truth: Callable[[], TrueState] | None = None) -> None:
        """Replace the autopilot between two episodes; `truth` returns the true state for clients.

        Keeps clients and the rates they have set. Drops running parameter lists and messages for
        the old autopilot (stale setpoints). Simulated time may restart.
        """
        # Data received for the old autopilot is dropped before the new one is attached.
        if self._port is not None:
            self._discard()
        self._port, self._has_sample = port, False
        self._forget_us = 0
        self._system_id = _system_id(port)
        self._vehicle.attach(port, truth, self._system_id)
        self._effects.forget()
        # The values at boot are no changes by clients.
        port.parameters.history.clear()
        port.plans.history.clear()
        self._complaints.restart()
        self._announced.renew()
        for state in self.vehicle_states.values():
            state.restart()
        # A new boot restarts the event numbers.
        self._events = EventBuffer()
        for clients in self._links:
            clients.restart(self._now_us)
            for client in clients:
                self._connect(client, port)
                client.link.scheduler.restart()

    def receive(self, now_us: int) -> int:
        """Read and process all data received by simulated `now_us` [µs].

        Returns the number of messages with an effect.
        """
        self._now_us = now_us
        effective = 0
        # Timeout 0: the tick never waits for data.
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
        """Return the time of the next required `send` [µs]: fast streams can wait until then."""
        now_us = self._now_us + TICK_US
        return min((client.next_us(now_us) for client in self._all()), default=math.inf)

    def send(self, now_us: int, flown: Record | None = None) -> None:
        """Send texts, pending transfers and the streams due at simulated `now_us` [µs].

        Args:
            now_us: Time after the newest tick.
            flown: (n,) logs of the ticks since the last call; None = one tick, with the autopilot's
                current state.
        """
        self._now_us = now_us
        self._tick_time.renew(now_us)
        port = self._port
        if port is None:
            return
        # Without a sensor sample the state is undefined, so nothing is sent.
        if not self._has_sample:
            if port.sample is None:
                return
            self._has_sample = True
        after_us = TICK_US
        # Without a log, the current state is the row of the only tick.
        if flown is None:
            flown = flown_of(port.state())
            after_us = now_us - flown["time_us"].item(0)
        self._vehicle.vibration.update(flown)
        texts: list[OperatorText] = port.take_messages()
        if texts:
            texts = list(dict.fromkeys(texts))  # once per tick, like `_announce`
        for event in port.take_events():
            self._events.add(event, now_us)
        everyone = list(self._all())
        # Mission progress (reached, jumped) is sent even without a transfer.
        progress = port.plans.progress
        if self._is_transferring or progress != self._mission_progress:
            self._mission_progress = progress
            self._send_pending(everyone, now_us)
            self._is_transferring = any(
                c.context is not None and c.context.is_busy for c in everyone
            )
        # Skipping idle clients keeps most ticks free of Python work.
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
        texts: Sequence[OperatorText],
    ) -> None:
        """Send texts, events and streams to clients that are due, each with its slow streams."""
        assert self._port is not None  # noqa: S101 (the caller has looked)
        now_us, state = self._now_us, self._port.state()
        origin, before, last = state.origin, self._context.row, len(flown) - 1
        context = self._context.of(state)
        if context is not before:
            for client in self._all():
                client.link.scheduler.quiet.clear()  # home or pilot input may be available
        payloads: Payloads = {}
        # Half of the budget goes to fast streams, divided among the clients with due streams.
        most = max(1, STREAMS_PER_TICK // (2 * len(due)))
        # The other half goes to slow streams.
        share = _share([len(names) for _, names in due])
        for client, names in due:
            link = client.link
            if link.scheduler.fast_us <= now_us:
                if context is not before and last > 0:
                    # A sequence of ticks ends with the first tick after a change.
                    link.stream_fast(flown[:last], after_us, before, most)
                    link.stream_fast(flown[last:], after_us, context, most)
                else:
                    link.stream_fast(flown, after_us, context, most)
            if texts or client.events.next_us <= now_us:
                _stream_news(client, texts, now_us)
            # Streams beyond the share wait for the next tick, where they come first.
            if len(names) > share:
                names, client.late = names[:share], names[share:]
            # The origin is sent when it changes, not at a rate.
            moved = origin is not None and origin != client.announced_origin
            if moved and link.scheduler.is_time(now_us):
                client.announced_origin = origin
                names = ["GPS_GLOBAL_ORIGIN", *names]
            if names:
                link.stream_due(names, state, payloads)
            link.flush()

    def _forget(self, now_us: int) -> None:
        """Remove silent clients, warn of floods, save the newest signature time stamp."""
        self._forget_us = now_us + FORGET_EVERY_US
        for clients in self._links:
            clients.forget_silent(now_us)
            # The counters include removed clients, so a flood from many addresses is reported.
            count = clients.counters
            for text in self._complaints.due(clients.name, count.refused, count.dropped, now_us):
                _tell(clients, text)
        if self._stored is not None:
            self._stored.save_due()

    def _send_pending(self, clients: Sequence[Client], now_us: int) -> None:
        """Send each client the next part of its transfers.

        The first client skipped in this tick is the first in the next tick.
        """
        first = self._first_in_turn
        sent = 0
        # Round robin, so that one client's long transfer does not starve the others.
        for turn in range(len(clients)):
            place = (first + turn) % len(clients)
            # The minimum lets transfers progress even when every tick is late.
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
        """Write both directions of a link's preset remote to a tlog; None stops logging.

        Every other client, on any link, gets a separate log next to it. The caller closes the
        writer. Raises ValueError if the link does not exist.
        """
        (clients,) = (clients for clients in self._links if clients.name == link)
        if tlog is None:
            self._traffic.end()
        else:
            self._traffic.begin(tlog, clients.preset())

    def counters(self) -> dict[str, LinkCounters]:
        """Return the traffic per link name, summed over its clients."""
        return {clients.name: clients.counters for clients in self._links}

    def filenos(self) -> list[int]:
        """Return the descriptors that become readable when data arrives."""
        numbers = (clients.endpoint.fileno() for clients in self._links)
        return [number for number in numbers if number is not None]

    def close(self) -> None:
        """Close endpoints and storage, and save the newest signature time stamp."""
        if self._stored is not None:
            self._stored.save()
        for clients in self._links:
            clients.close()
        for state in self.vehicle_states.values():
            state.close()

    def _open(self, config: LinkConfig, link_id: int) -> Clients:
        def welcome(peer: Peer, endpoint: Sender) -> Client:
            builders = self._link_builders()
            # A requested PING must not advance the sequence of the streamed ones.
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
            events = EventSender(self._events)
            client = Client(peer, link, texts, reply_texts, events, heard_us=self._now_us)
            if self._port is not None:
                self._connect(client, self._port)
                # A client that connects in flight starts its streams now.
                link.scheduler.restart()
            return client

        return Clients(config.name, config.endpoint, welcome, self._tick_time, self._signing)

    def _connect(self, client: Client, port: BuiltinAutopilot) -> None:
        client.link.identify(self._system_id)
        # Ends transfers that refer to the old autopilot.
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
            vehicle_states=self.vehicle_states,
            radio=self._radio,
        )
        self._is_transferring = True
        client.events = EventSender(self._events)
        client.announced_origin = None

    def _discard(self) -> None:
        """Drop data received for the previous autopilot."""
        for clients in self._links:
            for _ in range(_DISCARD_CALLS):
                # A new budget per read: the loop must empty the socket in one tick.
                clients.renew()
                for client, _message in clients.receive(self._now_us):
                    client.link.ignored += 1

    def _link_builders(self) -> dict[str, streams.Builder | None]:
        return {
            **self._builders,
            "PING": connection.ping_requests(),
            "RC_CHANNELS": self._radio.updates(),
        }

    def _dispatch(self, client: Client, message: WireMessage) -> bool:
        source, context = sender(message), client.context
        # A frame with the vehicle's ids is an echo.
        if source == (self._system_id, COMPONENT_ID) or context is None:
            return False
        context.now_us = self._now_us
        self._is_transferring = True  # cleared by `send` when idle
        client.hear(source)
        self._traffic.record_first(client, message)
        kind = message.get_type()
        effective = handle(message, kind, context)
        if effective and kind not in READING:
            self._effects.note(message, kind, source, client, context)
        # Frames without effect here may still concern another client.
        forwarded = self._forwarder.forward(message, client, self._system_id, self._now_us)
        return effective or forwarded

    def _send_texts(self) -> None:
        """Send the texts of the services to all operators."""
        for text in self._texts:
            _tell(self._all(), text)
        self._texts.clear()

    def _announce(self, text: OperatorText) -> None:
        """Queue a text once per tick, so that a repeating client cannot flood the others."""
        # The limit bounds the texts that all clients can trigger in a tick.
        if text in self._texts or len(self._texts) >= TEXTS_PER_TICK:
            return
        if not self._announced.left(self._now_us):
            return
        self._announced.take(1, self._now_us)
        # Events are telemetry: in lockstep a request must not add one.
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


def _stream_news(client: Client, texts: Iterable[OperatorText], now_us: int) -> None:
    """Add texts and the client's missing events to its telemetry."""
    for text in texts:
        for chunk in client.texts.encode(text):
            client.link.stream(chunk)
    for message in client.events.due(now_us):
        client.link.stream(message)


def _tell(clients: Iterable[Client], text: OperatorText) -> None:
    for client in clients:
        for chunk in client.reply_texts.encode(text):
            client.link.send(chunk)


def _share(requests: Sequence[int]) -> int:
    """Return the maximum number of streamed messages per client and tick, given their requests."""
    if sum(requests) <= STREAMS_PER_TICK // 2:
        return STREAMS_PER_TICK // 2
    return max(1, STREAMS_PER_TICK // 2 // sum(1 for number in requests if number))


def _system_id(port: BuiltinAutopilot) -> int:
    """Return MAV_SYS_ID, which PX4 reads at boot."""
    stored = port.parameters.by_name("MAV_SYS_ID")
    return SYSTEM_ID if stored is None else int(stored.value)


def udp_server(
    ends: UdpLinks,
    boot_unix_us: int,
    clock: Clock,
    signing: StoredSigning | None = None,
    *,
    onboard: SharedEndpoint | None = None,
    devices: Sequence[LinkConfig] = (),
) -> MavlinkServer:
    """Return the server of all links, without an autopilot; see `MavlinkServer`.

    `onboard` wraps and replaces the endpoint of the onboard link; None = use it directly.
    """
    links = [onboard_link(onboard or ends.api), gcs_link(ends.gcs), *devices]
    return MavlinkServer(links, boot_unix_us=boot_unix_us, clock=clock, signing=signing)
