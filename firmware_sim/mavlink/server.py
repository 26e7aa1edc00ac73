"""The MAVLink server of an autopilot: links, streams and services."""

from __future__ import annotations

from collections.abc import Sequence

from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.autopilot_state import AutopilotState, Message
from firmware_sim.autopilot.port import AutopilotPort
from firmware_sim.mavlink.codec import COMPONENT_ID, SYSTEM_ID, Values, WireMessage
from firmware_sim.mavlink.link import Link, LinkConfig, LinkCounters, Payloads
from firmware_sim.mavlink.senders import Senders
from firmware_sim.mavlink.services import handle, missions, params, peers
from firmware_sim.mavlink.services.context import Context
from firmware_sim.mavlink.streams import BUILDERS, Builder, sensors
from firmware_sim.mavlink.streams.status import system_time
from firmware_sim.mavlink.streams.vibration import VibrationMeter
from firmware_sim.mavlink.texts import REPLY_IDS, TextEncoder
from firmware_sim.mavlink.tlog import TlogWriter

_DISCARD_CALLS = 4
"""Reads that empty a link for sure: four times 256 datagrams exceed a socket's buffer."""


class _Session:
    """One link and its state."""

    def __init__(self, link: Link, *, separate_replies: bool) -> None:
        self.link = link
        self.context: Context | None = None
        """None while there is no autopilot."""
        self.texts = TextEncoder()
        self.reply_texts = TextEncoder(REPLY_IDS) if separate_replies else self.texts
        self.announced_origin: Geodetic | None = None


class MavlinkServer:
    """Speaks MAVLink on all links for one autopilot.

    Per tick: `receive`, then the autopilot's step, then `send`, all on one thread and with
    simulated time passed in. Nothing blocks, and no received message raises. Without an autopilot
    the vehicle is off: it neither sends nor receives.
    """

    def __init__(
        self, links: Sequence[LinkConfig], port: AutopilotPort | None = None, *, boot_unix_us: int
    ) -> None:
        """Open the links: each streams its default rates from the first `send` on.

        The autopilot may come later (`attach`). `boot_unix_us` is the calendar time of simulated
        time 0 [µs since 1970, UTC].
        """
        self._port: AutopilotPort | None = None
        self._now_us = 0
        self._vibration = VibrationMeter()
        self._texts: list[Message] = []
        self._senders = Senders()
        self.strangers = self._senders.strangers
        # The same functions on every link: what two links send in one tick is built once.
        self._builders: dict[str, Builder] = {
            **BUILDERS,
            "SYSTEM_TIME": system_time(boot_unix_us),
            "VIBRATION": lambda state: self._vibration.message(state),
            "BATTERY_STATUS": self._battery_status,
            "TIMESYNC": peers.timesync_request,
        }
        self._sessions = [self._open(config) for config in links]
        if port is not None:
            self.attach(port)

    def attach(self, port: AutopilotPort) -> None:
        """Replace the autopilot, between two episodes.

        Rates that clients have set are kept; running parameter lists and messages for the old
        autopilot (stale setpoints) are dropped. Simulated time may start anew.
        """
        if self._port is not None:
            for session in self._sessions:
                for _ in range(_DISCARD_CALLS):
                    session.link.ignored += len(session.link.receive())
        self._port = port
        self._senders.forget()
        self._vibration = VibrationMeter()
        for session in self._sessions:
            session.context = Context(
                session.link, port, self._now_us, self._texts.append, self._broadcast
            )
            session.announced_origin = None
            session.link.scheduler.restart()

    def receive(self, now_us: int) -> int:
        """Read and carry out everything that has arrived by simulated `now_us` [µs].

        Returns how many messages took effect.
        """
        self._now_us = now_us
        effective = 0
        for session in self._sessions:
            for message in session.link.receive():
                if self._dispatch(session, message):
                    effective += 1
                else:
                    session.link.ignored += 1
        if self._texts:
            self._send_texts()
        return effective

    def send(self, now_us: int) -> None:
        """Send texts, pending parameters and the streams that are due at simulated `now_us` [µs].

        To be called once per tick.
        """
        self._now_us = now_us
        port = self._port
        if port is None:
            return
        sample = port.sample
        if sample is not None:
            self._vibration.update(sample)
        texts = port.take_messages()
        state: AutopilotState | None = None
        payloads: Payloads = {}
        for session in self._sessions:
            link = session.link
            for text in texts:
                for chunk in session.texts.encode(text):
                    link.stream(chunk)
            due = link.scheduler.due(now_us)
            if due or session.announced_origin is None:
                # Not in every tick: the snapshot costs more than asking the schedulers.
                if state is None:
                    state = port.state()
                if state.origin is not None and state.origin != session.announced_origin:
                    session.announced_origin = state.origin
                    link.stream_due(("GPS_GLOBAL_ORIGIN",), state, payloads)
            if session.context is not None:
                session.context.now_us = now_us
                params.send_pending(session.context)
                missions.send_pending(session.context)
            if state is not None:
                link.stream_due(due, state, payloads)
            link.flush()

    def log_to(self, tlog: TlogWriter | None, link: str = "onboard") -> None:
        """Write both directions of a link to a tlog from now on; None ends it.

        The caller closes the writer. Raises ValueError if there is no such link.
        """
        (session,) = (session for session in self._sessions if session.link.name == link)
        session.link.tap = None if tlog is None else lambda frame: tlog.write(self._now_us, frame)

    def counters(self) -> dict[str, LinkCounters]:
        """Return the traffic per link name."""
        return {session.link.name: session.link.counters for session in self._sessions}

    def filenos(self) -> list[int]:
        """Return the descriptors that become readable when something arrives."""
        numbers = (session.link.endpoint.fileno() for session in self._sessions)
        return [number for number in numbers if number is not None]

    def close(self) -> None:
        """Close the endpoints."""
        for session in self._sessions:
            session.link.endpoint.close()

    def _open(self, config: LinkConfig) -> _Session:
        builders = self._link_builders()
        # A requested PING must not advance the sequence of those that are streamed.
        replies = self._link_builders() if config.separate_replies else builders
        return _Session(Link(config, builders, replies), separate_replies=config.separate_replies)

    def _link_builders(self) -> dict[str, Builder]:
        return {**self._builders, "PING": peers.ping_requests()}

    def _dispatch(self, session: _Session, message: WireMessage) -> bool:
        if (message.get_srcSystem(), message.get_srcComponent()) == (SYSTEM_ID, COMPONENT_ID):
            return False  # an echo of our own message
        if session.context is None:
            return False
        session.context.now_us = self._now_us
        effective = handle(message, session.context)
        if effective:
            self._senders.note(message)
        return effective

    def _send_texts(self) -> None:
        """Send the texts of the services to the operators."""
        for session in self._sessions:
            for text in self._texts:
                for chunk in session.reply_texts.encode(text):
                    session.link.send(chunk)
        self._texts.clear()

    def _broadcast(self, message: WireMessage) -> None:
        for session in self._sessions:
            session.link.send(message)

    def _battery_status(self, state: AutopilotState) -> Values | None:
        if self._port is None:
            return None
        return sensors.battery_status(state, self._port.parameters)
