"""Companion in a thread of this process, with MAVSDK on raw bytes and a simulated clock.

Either the conductor's thread or the companion's thread runs at any moment. MAVSDK's threads run all
the time; a barrier detects when they are idle. MAVSDK handles incoming and outgoing messages in one
queue, in order. An answer to a PING therefore proves two things: its getters return all data fed
before, and all earlier requests have been sent.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from queue import Empty, SimpleQueue

from airl_mav.core.clock import Patience
from airl_mav.core.constants import US_PER_S
from airl_mav.lockstep.turns import Handle, LockstepError, Turn
from airl_mav.lockstep.wire import newest, newest_heartbeat
from companion.conducted import Abandoned, Poll
from companion.mavsdk_link import MavsdkLink
from firmware_sim.mavlink.codec import Encoder, dialect, layout

FIRST_BARRIER = 0x8000_0000
"""Sequence number of the first barrier's PING, above the autopilot's sequence numbers."""

PATIENCE_S = 60
"""Maximum duration of a turn by default [s of wall time, while this process runs]."""

PING_AGAIN_S = 0.1
"""Interval at which an unanswered PING is repeated [wall s]."""

HEARTBEAT_S = 1.0
"""Interval at which the newest heartbeat is repeated in a long turn [wall s]."""

LONGEST_ANSWER_US = 10 * US_PER_S
"""Maximum time until a command is answered [µs of simulated time]."""

_PING: int = dialect.MAVLINK_MSG_ID_PING
_PING_LAYOUT = layout("PING")


class ThreadPartner:
    """Partner that runs a companion in a thread. Implements `turns.Partner`."""

    def __init__(self, patience_s: float = PATIENCE_S) -> None:
        """Set the maximum duration of a turn [s of wall time]; no companion is attached."""
        self._patience_s = patience_s
        self.error: BaseException | None = None
        """Error that ended the companion; None = still running or completed."""
        # Only SimpleQueue never blocks in `put`: MAVSDK's thread must not wait for other threads.
        self._inbox: SimpleQueue[bytes | Turn] = SimpleQueue()
        # A plain lock passes control: a Semaphore consists of several and is ten times slower.
        self._go = threading.Lock()
        self._go.acquire()
        self._abandoned = False
        self._link: MavsdkLink | None = None
        self._feed: Callable[[bytes], None] = lambda _: None
        self._heartbeat = b""
        self._barriers = FIRST_BARRIER
        self._fed = True
        """True if MAVSDK was fed since the newest barrier."""
        self._interrupted = False
        """True while the companion waits for an answer in the middle of its turn."""
        self._sent_before = 0
        """Number of setpoints sent before the current turn."""
        self._encoder = Encoder()
        self._thread: threading.Thread | None = None

    def attach(self, link: MavsdkLink) -> None:
        """Attach the companion's link, which must be created with `RAW_URL`."""
        self._link = link
        self._feed = link.exchange_raw(self._inbox.put)

    def start(self, program: Callable[[], None]) -> None:
        """Start the companion; it waits for its first turn."""
        self._thread = threading.Thread(
            target=self._run, args=(program,), name="companion", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End the companion, wherever it waits for its turn."""
        self._abandoned = True
        with suppress(RuntimeError):  # the companion is running, or has ended
            self._go.release()
        if self._thread is not None:
            self._thread.join(timeout=1.0)

    # --- the conductor's thread

    def send(self, frames: Sequence[bytes]) -> None:
        """Feed frames to MAVSDK; of each state only the newest, as MAVSDK keeps no older ones."""
        kept = newest(frames)
        self._heartbeat = newest_heartbeat(kept) or self._heartbeat
        self._fed = True
        self._feed(b"".join(kept))

    def turn(self, now_us: int, handle: Handle) -> Turn:
        """Let the companion run until it sleeps; see `turns.Partner`."""
        # The companion waits in the middle of its turn for an answer.
        if self._interrupted:
            self._interrupted = False  # The turn continues, and its answer has arrived.
        else:
            # Input since the last barrier must be processed before the companion runs.
            if self._fed:
                self._settle(handle)
            # The released lock wakes the companion's thread.
            self._sent_before = self._setpoints_sent
            self._go.release()
        turn = self._work(handle)
        # A pending answer gives control back; the turn continues when the answer arrives.
        if isinstance(turn, threading.Event):
            self._interrupted = True
            return Turn(now_us + LONGEST_ANSWER_US, turn, self._sent_before)
        # Commands return after their answer; a setpoint may still be queued in MAVSDK.
        if turn.setpoints_sent != self._sent_before:
            self._settle(handle)
        return turn

    def _settle(self, handle: Handle) -> None:
        """Wait until MAVSDK has processed all input and sent all output."""
        # A PING is the barrier: MAVSDK processes its input in order and answers it last.
        number, self._fed = self._barriers, False
        self._barriers += 1
        ping = self._encoder.frame(_PING_LAYOUT, _PING_LAYOUT.payload((0, number, 0, 0)))
        wanted = number.to_bytes(4, "little")
        waited = Patience()
        again_s = 0.0
        while (so_far_s := waited.so_far_s()) < PATIENCE_S:
            if so_far_s >= again_s:
                # MAVSDK ignores a PING of a newly discovered vehicle: repeat it. Second answers are
                # ignored.
                self._feed(ping)
                again_s = so_far_s + PING_AGAIN_S
            try:
                item = self._inbox.get(timeout=PING_AGAIN_S)
            except Empty:
                continue
            if not isinstance(item, bytes):
                raise LockstepError("the companion gave back a turn that it did not have")
            # Bytes 18 to 21 hold the PING's sequence number.
            if _is_ping(item) and item[18:22] == wanted:
                return
            # Frames before the answer belong to the turn.
            handle(item)
        raise LockstepError(f"MAVSDK hangs: no answer to a PING in {PATIENCE_S} s")

    def _work(self, handle: Handle) -> Turn | threading.Event:
        """Wait for the end of the turn; return early with an event if an answer is pending."""
        waited = Patience()
        heartbeat_s = HEARTBEAT_S
        while waited.so_far_s() < self._patience_s:
            # The timeout bounds the wait for the next heartbeat.
            with suppress(Empty):
                item = self._inbox.get(timeout=HEARTBEAT_S)
                # Anything but bytes is the end of the turn.
                if not isinstance(item, bytes):
                    return item
                if (answered := handle(item)) is not None:
                    return answered
            if waited.so_far_s() >= heartbeat_s:
                # MAVSDK drops a vehicle after 3 s of wall time without a heartbeat, and then finds
                # no autopilot to connect to.
                self._feed(self._heartbeat)
                heartbeat_s += HEARTBEAT_S
        raise LockstepError(f"the companion hangs: its turn did not end in {self._patience_s:g} s")

    @property
    def _setpoints_sent(self) -> int:
        return 0 if self._link is None else self._link.setpoints_sent

    # --- the companion's thread

    def sleep(
        self, wake_us: int, interrupt: threading.Event | None = None, poll: Poll | None = None
    ) -> None:
        """End the turn until simulated `wake_us` [µs]; see `conducted.Sleep`."""
        self._inbox.put(Turn(wake_us, interrupt, self._setpoints_sent, poll))
        self._await_turn()

    def _await_turn(self) -> None:
        self._go.acquire()
        if self._abandoned:
            raise Abandoned

    def _run(self, program: Callable[[], None]) -> None:
        try:
            self._await_turn()
            program()
        except Abandoned:
            return
        except BaseException as error:  # raised by the stage
            self.error = error
        self._inbox.put(Turn(None, setpoints_sent=self._setpoints_sent))


def _is_ping(frame: bytes) -> bool:
    return len(frame) >= 24 and int.from_bytes(frame[7:10], "little") == _PING
