"""Partner for a companion in another process: turns are passed over its MAVLink connection.

The vehicle sends its telemetry, then a STATUSTEXT that gives the turn. The companion sends its
commands, then a STATUSTEXT that returns the turn. Simulated time is frozen until then. The
companion may use any language. See docs/reference/lockstep-protocol.md.
"""

from __future__ import annotations

import re
import select
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from airl_mav.addons.remote_lockstep.turns import NO_FRAME, PhaseToken, TurnBack, TurnGiven
from airl_mav.addons.remote_lockstep.turns import Order as Word
from airl_mav.camera.frame import Frame
from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.signing import StoredSigning
from airl_mav.lockstep import stage, vehicle
from airl_mav.lockstep.turns import Handle, LockstepError, Turn
from airl_mav.rehearsal.episode import Order
from airl_mav.scenario.stand_alone import COMPANION_TIMEOUT_S, LONGEST_REST_US, TURN_US
from firmware_sim.firmware import FrameServer
from firmware_sim.mavlink.codec import Decoder, Encoder, WireMessage, dialect
from firmware_sim.mavlink.endpoint import Peer, Sender, UdpEndpoint

KNOCK_S = 0.1
"""Heartbeat interval before the companion is connected [wall s]."""

FIRST_REPEAT_S, LAST_REPEAT_S = 0.02, 1.0
"""Interval of turn repetitions: the first one, doubled each time up to the last one [wall s]."""

SLICE_S = 0.2
"""Maximum duration of one blocking wait [wall s]."""

_TURN_BACK = re.compile(r"D\d+\b")


@dataclass(frozen=True)
class _Rest:
    """Wake-up conditions of the sleeping companion."""

    wake_us: int
    event: str
    setpoints_sent: int


class TokenPartner:
    """Partner that passes turns during one flight. Implements `turns.Partner`."""

    def __init__(
        self,
        wire: Wire,
        camera: TokenCamera,
        *,
        turn_us: int = TURN_US,
        patience_s: float = COMPANION_TIMEOUT_S,
        broken_off: Callable[[], bool] = lambda: False,
        phase: Callable[[str, int], None] = lambda _phase, _time_us: None,
    ) -> None:
        """Initialize without waiting for the companion.

        `turn_us` is the time until the next turn if the companion does not request one [µs],
        `patience_s` the maximum duration of a turn [s of wall time, while this process runs].
        `broken_off` is polled while waiting; True ends the wait and, for this flight, the
        companion. `phase` receives each phase that the companion reports, with its time [µs].
        """
        self._wire = wire
        self._camera = camera
        self._turn_us, self._patience_s = turn_us, patience_s
        self._broken_off = broken_off
        self._phase = phase
        self._order: Word = ""
        self._ordered = threading.Event()
        self._encoder = Encoder()
        self._heartbeat = b""
        self._heard = False
        """True if the companion is connected; before, only heartbeats are sent."""
        self._backlog: list[bytes] = []
        """Telemetry sent before the first turn."""
        self._number = 0
        self._rest: _Rest | None = None
        self._unseen = False
        """True if the camera's newest frame has not been sent yet."""
        self._early: list[Heard] = []
        """Messages received before the first turn."""
        self._phases: set[str] = set()
        """Phases reported in the current turn."""

    @property
    def turns(self) -> int:
        """Number of turns given so far."""
        return self._number

    def order(self, order: Order) -> None:
        """Send an order to the companion with its next turn."""
        self._order = "land" if order is Order.LAND else "abandon"
        self._ordered.set()

    def close(self) -> None:
        """Notify the companion that the flight is over."""
        if self._heard:
            self._heard = False
            self._say(TurnGiven(self._number + 1, 0, order="end"))

    # --- turns.Partner

    def send(self, frames: Sequence[bytes]) -> None:
        """Forward telemetry, immediately if the companion is connected."""
        self._heartbeat = stage.newest_heartbeat(frames) or self._heartbeat
        if self._number == 0:
            self._backlog += frames
        if self._heard:
            self._wire.send(b"".join(frames))

    def turn(self, now_us: int, handle: Handle) -> Turn:
        """Let the companion run until it sleeps; see `turns.Partner`."""
        # Frames arrive by simulated time, whether the companion sleeps or not.
        arrived = self._camera.arrive(now_us)
        self._unseen = self._unseen or arrived
        # The companion need not be woken: the conductor continues.
        if self._rest is not None and not self._wakes(self._rest, now_us, arrived):
            return self._asleep(self._rest)
        if not self._heard and not self._knock():
            return Turn(None)
        # Texts with the number of the previous turn are late repetitions.
        over = TurnGiven(self._number, now_us)
        self._number += 1
        # Drain the socket: earlier messages must not fill its buffer.
        self._hear([*self._early, *self._wire.receive()], over, handle)
        self._early.clear()
        self._phases.clear()
        given = TurnGiven(self._number, now_us, self._camera.sequence, self._order)
        back = self._exchange(given, handle)
        if back is None:
            # None: the flight was aborted while waiting.
            return Turn(None)
        if back.ended:
            self.close()
            return Turn(None)
        self._rest = self._understood(back, now_us)
        return self._asleep(self._rest)

    # --- wake-up conditions

    def _understood(self, back: TurnBack, now_us: int) -> _Rest:
        wake_us = back.wake_us
        # A companion without a wish for its next turn gets one after a fixed interval.
        if wake_us is None:
            wake_us = now_us + self._turn_us
        elif wake_us <= now_us:
            raise LockstepError(
                f"the companion's {back.text()!r}: accepted: a time after now, {now_us} µs"
            )
        # The companion sleeps again if it is woken too early.
        wake_us = min(wake_us, now_us + LONGEST_REST_US)
        return _Rest(wake_us, back.event, back.setpoints_sent or 0)

    def _wakes(self, rest: _Rest, now_us: int, arrived: bool) -> bool:
        """Return True if a wake-up condition is met."""
        met = {"": False, "frame": arrived, "stop": self._ordered.is_set()}
        return now_us >= rest.wake_us or met[rest.event]

    def _asleep(self, rest: _Rest) -> Turn:
        """Return the time or event until which the conductor can continue alone."""
        wake_us, interrupt = rest.wake_us, None
        # A sleep until the next frame ends at its arrival, which is known once the frame is in
        # transit.
        if rest.event == "frame":
            if self._camera.next_us is not None:
                wake_us = min(wake_us, self._camera.next_us)
            else:
                interrupt = self._camera.published
                interrupt.clear()
        elif rest.event == "stop" and not self._order:
            interrupt = self._ordered
        return Turn(wake_us, interrupt, rest.setpoints_sent)

    # --- passing the turn

    def _knock(self) -> bool:
        """Send heartbeats until the companion answers; False = aborted."""
        while not self._broken_off():
            self._wire.send(self._heartbeat)
            if self._wait(KNOCK_S) and (early := self._wire.receive()):
                self._early = early
                self._heard = True
                self._wire.send(b"".join(self._backlog))
                return True
        return False

    def _exchange(self, given: TurnGiven, handle: Handle) -> TurnBack | None:
        """Give the turn repeatedly until it is returned; None = aborted."""
        again = False
        # Counted in repetitions, not by a clock: a suspended process has not waited.
        for again_s in _repeats(self._patience_s):
            if again:
                self._repeat()
            # A lost frame is repeated together with the turn.
            if again or self._unseen:
                self._camera.send()
            again, self._unseen = True, False
            self._say(given)
            # Wall time: the companion is another process.
            stopwatch = WallClock()
            while (left_s := again_s - stopwatch.time_us() / US_PER_S) > 0.0:
                if self._wait(left_s):
                    back = self._hear(self._wire.receive(), given, handle)
                    if back is not None:
                        return back
                # Checked after each wait, so that Ctrl-C takes effect.
                if self._broken_off():
                    return None
        raise LockstepError(
            f"the companion is gone: it did not give back turn {given.number} in "
            f"{self._patience_s:g} s"
        )

    def _repeat(self) -> None:
        """Repeat the messages that precede the turn."""
        if self._number == 1:
            # The companion may have started during the first transmission.
            self._wire.send(b"".join(self._backlog))
        else:
            # MAVSDK drops a vehicle after 3 s of wall time without a heartbeat.
            self._wire.send(self._heartbeat)

    def _hear(self, heard: list[Heard], given: TurnGiven, handle: Handle) -> TurnBack | None:
        """Handle received messages; return the turn if it is given back.

        The sender that gives a turn back is the companion. All others are ignored from then on.

        Raises LockstepError for a malformed message.
        """
        found = None
        for peer, message in ((each.peer, each.message) for each in heard):
            text = message.text if message.get_type() == "STATUSTEXT" else ""
            # The number proves which turn is returned; texts may be duplicated.
            if (back := TurnBack.parse(text)) is not None:
                # A turn that was never given is a protocol error.
                if back.number > given.number:
                    raise LockstepError(f"the companion's {text!r}: accepted: D{given.number}")
                if back.number == given.number:
                    found = back
                    if given.number > 0:  # turn 0: before the first turn
                        self._wire.keep_to(peer)
            # A malformed text with the token's letter is reported, not ignored.
            elif _TURN_BACK.match(text):
                raise LockstepError(
                    f"the companion's {text!r}; accepted: D<turn> [<wake_us> [<setpoints> "
                    "[frame|stop]]], D<turn> end"
                )
            elif (phase := PhaseToken.parse(text)) is not None:
                self._enter(phase, given)
            else:
                handle(bytes(message.get_msgbuf()))
        return found

    def _enter(self, phase: PhaseToken, given: TurnGiven) -> None:
        """Report a phase once per turn, even if it is repeated."""
        if phase.number == given.number and phase.name not in self._phases:
            self._phases.add(phase.name)
            self._phase(phase.name, given.time_us)

    # --- the socket

    def _say(self, given: TurnGiven) -> None:
        text = given.text().encode()
        message = dialect.MAVLink_statustext_message(dialect.MAV_SEVERITY_DEBUG, text)
        self._wire.send(self._encoder.pack(message))

    def _wait(self, seconds: float) -> bool:
        """Wait for a message; return True if there is one."""
        ready, _, _ = select.select([self._wire.socket], [], [], min(seconds, SLICE_S))
        return bool(ready)


def _repeats(total_s: float) -> Iterator[float]:
    """Yield increasing wait times, up to a total [s]."""
    wait_s = FIRST_REPEAT_S
    while total_s > 0.0:
        yield min(wait_s, total_s)
        total_s -= wait_s
        wait_s = min(2.0 * wait_s, LAST_REPEAT_S)


_OVERHEAD = 12
"""Header and checksum of an unsigned frame [bytes]."""


def split(frames: bytes) -> Iterator[bytes]:
    """Yield the frames of concatenated unsigned frames."""
    start = 0
    while start + _OVERHEAD <= len(frames):
        end = start + _OVERHEAD + frames[start + 1]
        yield frames[start:end]
        start = end


def datagrams(frames: Iterable[bytes], longest: int) -> Iterator[bytes]:
    """Pack frames into as few datagrams of at most `longest` bytes as possible."""
    waiting: list[bytes] = []
    length = 0
    for frame in frames:
        # A frame is never split between datagrams.
        if waiting and length + len(frame) > longest:
            yield b"".join(waiting)
            waiting, length = [], 0
        waiting.append(frame)
        length += len(frame)
    if waiting:
        yield b"".join(waiting)


LONGEST_DATAGRAM = 1400
"""Maximum size of a telemetry datagram [bytes]; MAVSDK reads 2048 at a time."""

LINK_ID = 0
"""Link id in the signatures of the vehicle's onboard link, as at level sitl."""

TELL_EVERY_US = 10 * US_PER_S
"""Minimum interval between two messages about rejected frames [µs of wall time]."""


@dataclass(frozen=True, slots=True)
class Heard:
    """Message and its sender."""

    peer: Peer
    message: WireMessage


class Wire:
    """Connection to the companion during one flight; the caller owns and closes the socket."""

    def __init__(
        self,
        endpoint: UdpEndpoint,
        stored: StoredSigning | None = None,
        say: Callable[[str], None] = lambda _line: None,
        clock: Clock | None = None,
    ) -> None:
        """Discard pending input of an earlier flight.

        `stored` is the signing key shared with the companion; None = no signing. `say` receives
        messages about rejected frames, at intervals by the wall clock.
        """
        socket = endpoint.fileno()
        if socket is None:
            raise ValueError("the endpoint is closed")
        self.socket = socket
        """File descriptor to wait on."""
        self.refused = 0
        """Number of unsigned, forged or outdated frames."""
        self.foreign = 0
        """Number of datagrams from senders other than the companion."""
        self._endpoint = endpoint
        self._stored = stored
        self._say = say
        self._clock = clock or WallClock()
        self._told = 0
        self._tell_us: int | None = None
        self._decoder = Decoder(datagrams=True)
        self._preset = endpoint.towards(None)
        self._learned: tuple[Peer, Sender] | None = None
        self._kept: tuple[Peer] | None = None
        # Discards what an earlier companion has left in the socket.
        endpoint.receive()

    def send(self, frames: bytes) -> None:
        """Send unsigned frames to the preset remote and the last sender; sign if there is a key."""
        signing = None if self._stored is None else self._stored.signing
        signed = (
            each if signing is None else signing.sign(each, LINK_ID) for each in split(frames)
        )
        ends = [self._preset, None if self._learned is None else self._learned[1]]
        for datagram in datagrams(signed, LONGEST_DATAGRAM):
            for end in ends:
                if end is not None:
                    end.send(datagram)

    def receive(self) -> list[Heard]:
        """Return all accepted messages, oldest first."""
        heard: list[Heard] = []
        for peer, data in self._endpoint.arrivals():
            # Once the companion is known, other senders are foreign.
            if self._kept is not None and peer != self._kept[0]:
                self.foreign += 1
                continue
            messages = self._decoder.feed(data)
            accepted = self._accepted(messages)
            if not accepted:
                continue
            # Answers go to the newest accepted sender.
            if peer is not None and (self._learned is None or peer != self._learned[0]):
                end = self._endpoint.towards(peer)
                self._learned = None if end is None else (peer, end)
            heard += (Heard(peer, message) for message in accepted)
        self._tell()
        if self._stored is not None:
            self._stored.save_due()
        return heard

    def keep_to(self, peer: Peer) -> None:
        """Accept only this sender from now on: it is the companion."""
        self._kept = self._kept or (peer,)

    def close(self) -> None:
        """Save the newest time stamp, and report the remaining rejections."""
        self._tell_us = None
        self._tell()
        if self._stored is not None:
            self._stored.save()

    def _accepted(self, messages: list[WireMessage]) -> list[WireMessage]:
        if self._stored is None:
            return messages
        signing = self._stored.signing
        # A companion with the key signs everything; other senders get no telemetry.
        frames = ((m, bytes(m.get_msgbuf())) for m in messages)
        accepted = [m for m, frame in frames if signing.accepts(frame, unsigned=False)]
        self.refused += len(messages) - len(accepted)
        return accepted

    def _tell(self) -> None:
        """Report rejected frames at intervals; otherwise a wrong key would look like silence."""
        count = self.refused + self.foreign
        if count == self._told:
            return
        now_us = self._clock.time_us()
        # The first report is immediate, later reports come at intervals.
        if self._tell_us is not None and now_us < self._tell_us:
            return
        self._told, self._tell_us = count, now_us + TELL_EVERY_US
        if self.refused:
            self._say(f"onboard: {self.refused} frames refused so far: bad signature")
        if self.foreign:
            self._say(f"onboard: {self.foreign} datagrams dropped so far: not the companion's")


class TokenCamera(vehicle.DelayedFrames):
    """Camera of a companion in another process. Implements `firmware.FrameServer`.

    Each turn sends only the newest frame that has arrived, as the companion cannot read older ones.
    """

    def __init__(self, server: FrameServer, transport_us: int) -> None:
        """Set the frame server and the transport latency from exposure to arrival [µs].

        The caller owns and closes the server.
        """
        super().__init__(transport_us)
        self.endpoint = server.endpoint
        self._server = server
        self._newest: Frame | None = None

    def arrive(self, now_us: int) -> bool:
        """Receive all frames that arrived by `now_us` [µs]; return True if there was one."""
        arrived = self.arrived(now_us)
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
