"""Partner for a companion in another process: turns are passed over its MAVLink connection.

The vehicle sends its telemetry, then a STATUSTEXT that gives the turn. The companion sends its
commands, then a STATUSTEXT that returns the turn. Simulated time is frozen until then. The
companion may use any language. See docs/reference/lockstep-protocol.md.
"""

from __future__ import annotations

import re
import select
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.lockstep.lockstep_camera import TokenCamera
from airl_mav.lockstep.turns import Handle, LockstepError, Turn
from airl_mav.lockstep.wire import Heard, Wire, newest_heartbeat
from airl_mav.rehearsal.episode import Order
from airl_mav.scenario.stand_alone import COMPANION_TIMEOUT_S, LONGEST_REST_US, TURN_US
from companion.tokens import Order as Word
from companion.tokens import PhaseToken, TurnBack, TurnGiven
from firmware_sim.mavlink.codec import Encoder, dialect

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

        Args:
            wire: Socket of the companion, connected or not.
            camera: Camera of the companion.
            turn_us: Time until the next turn if the companion does not request one [µs].
            patience_s: Maximum duration of a turn [s of wall time, while this process runs].
            broken_off: Polled while waiting for the companion; True ends the wait and, for this
                flight, the companion.
            phase: Called with each phase that the companion reports, and the simulated time [µs].
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
        self._heartbeat = newest_heartbeat(frames) or self._heartbeat
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
        if now_us >= rest.wake_us:
            return True
        if rest.event == "frame":
            return arrived
        return rest.event == "stop" and self._ordered.is_set()

    def _asleep(self, rest: _Rest) -> Turn:
        """Return the time or event until which the conductor can continue alone."""
        wake_us, interrupt = rest.wake_us, None
        # A sleep until the next frame ends at its arrival, which is known once the frame is in
        # transit.
        if rest.event == "frame":
            under_way = self._camera.under_way
            if under_way.next_us is not None:
                wake_us = min(wake_us, under_way.next_us)
            else:
                interrupt = under_way.published
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
