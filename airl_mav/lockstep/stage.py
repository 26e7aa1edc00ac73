"""Vehicle, flight controller, MAVSDK and companion, connected on one simulated clock.

Either the conductor's thread or the companion's thread runs at any moment. MAVSDK's threads run all
the time; a barrier detects when they are idle. MAVSDK handles incoming and outgoing messages in one
queue, in order. An answer to a PING therefore proves two things: its getters return all data fed
before, and all earlier requests have been sent.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from queue import Empty, SimpleQueue

from airl_mav.core import constants, errors
from airl_mav.core.clock import Patience, SimClock
from airl_mav.faults import LINKS, Fault
from airl_mav.lockstep.conductor import Conductor
from airl_mav.lockstep.turns import COMPANION_STARTS_US, FlightDigest, Handle, LockstepError, Turn
from airl_mav.lockstep.vehicle import BOOT_UNIX_US, ConductedVehicle, MemoryCamera, builtin_vehicle
from companion.link_interface import LinkError
from companion.mavsdk_connection import RAW_TIMEOUT_S, RAW_URL
from companion.mavsdk_link import MavsdkLink
from companion.watchdog import Abandoned, ConductedClock, Poll
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.fault_timeline import FaultTimeline
from firmware_sim.firmware import Firmware
from firmware_sim.mavlink import codec, px4_links
from firmware_sim.simulation import EpisodeSetup, Simulation

FIRST_BARRIER = 0x8000_0000
"""Sequence number of the first barrier's PING, above the autopilot's sequence numbers."""

PATIENCE_S = 60
"""Maximum duration of a turn by default [s of wall time, while this process runs]."""

PING_AGAIN_S = 0.1
"""Interval at which an unanswered PING is repeated [wall s]."""

HEARTBEAT_S = 1.0
"""Interval at which the newest heartbeat is repeated in a long turn [wall s]."""

LONGEST_ANSWER_US = 10 * constants.US_PER_S
"""Maximum time until a command is answered [µs of simulated time]."""

_PING: int = codec.dialect.MAVLINK_MSG_ID_PING
_PING_LAYOUT = codec.layout("PING")


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
        self._encoder = codec.Encoder()
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


HEARD_TIMEOUT_S = 10.0
"""Companion's timeout for the first heartbeat, which has been fed already [wall s]."""

CUT_TIMEOUT_S = 0.5
"""MAVSDK's timeout for a command before it retries [wall s]."""

STOPPED = "stopped"


class LockstepStage:
    """One flight with any companion program. Use as a context manager."""

    def __init__(
        self,
        *,
        transport_us: int = 0,
        digest: FlightDigest | None = None,
        speed: float | None = None,
        faults: Sequence[Fault] = (),
        vehicle: ConductedVehicle | None = None,
        patience_s: float = PATIENCE_S,
    ) -> None:
        """Connect all parts; nothing is started.

        Args:
            transport_us: Time from a frame's exposure to the decoded frame in the companion [µs].
            digest: Digest of all traffic on the link; None = not needed.
            speed: Maximum simulated seconds per wall second; None = unlimited.
            faults: Faults of the episode's aircraft; only link faults are used here.
            vehicle: Vehicle, closed with the stage; None = the built-in autopilot.
            patience_s: Maximum duration of the companion's turn [s of wall time].
        """
        # The order of creation follows the dependencies: clock, vehicle, partner, conductor.
        clock = SimClock()
        self._vehicle = vehicle = vehicle or builtin_vehicle(clock, faults)
        self._partner = ThreadPartner(patience_s)
        self.abandon = threading.Event()
        """Event that aborts all waits of the link."""
        self.conductor = Conductor(vehicle.end, self._partner, digest, speed, clock)
        self.clock = ConductedClock(self.conductor.clock, self._partner.sleep)
        """Clock of the companion, also the guard of its watchdog."""
        self.camera = MemoryCamera(transport_us)
        """Frame source of the companion."""
        self.camera.clock = self.clock
        self.firmware = Firmware(
            vehicle.stack, self.camera, self.conductor, failing=vehicle.failing
        )
        self.unheard = ""
        """Reason if a fault kept the companion from receiving the vehicle; otherwise empty."""
        self.out = ""
        """Fault that ended the companion for good, such as `companion killed`; otherwise empty."""
        self._open = ExitStack()

    def __enter__(self) -> LockstepStage:
        """Create the link."""
        # Reverse order of closing: the companion's thread ends before its link.
        self._open.enter_context(closing(self.firmware))
        self.link = MavsdkLink(
            *(RAW_URL, self.clock, self.abandon),
            # Silence in wall time means nothing in lockstep.
            heard=lambda: self.conductor.heard,
            poll=self.clock.poll,
        )
        """Link of the companion, connected by `run`."""
        self._open.enter_context(closing(self.link))
        self._open.enter_context(closing(self._partner))
        self._partner.attach(self.link)
        return self

    def __exit__(self, *_: object) -> None:
        """End the companion and release all resources."""
        self._open.close()

    def run(
        self,
        setup: EpisodeSetup,
        program: Callable[[], None],
        *,
        tlog: Path | None = None,
        begun: Callable[[int], None] = lambda _started_us: None,
        stop: threading.Event | None = None,
        judged: Callable[[], bool] = lambda: False,
    ) -> Simulation:
        """Fly until the companion's program ends.

        A program that a fault has killed or stopped for good never ends. The flight then ends at
        its verdict, or when the motors stop.

        Args:
            setup: Episode to fly.
            program: The companion's program. It runs on a separate thread with `link` connected.
                Simulated time advances only while the program sleeps on `clock`.
            tlog: Path of the MAVLink log; None = no log.
            begun: Called with the simulated time of the reset [µs].
            stop: Event that ends the program early; None = not supported.
            judged: Polled after the companion has stopped for good; True = there is a verdict.

        Returns:
            The simulation in its final state; closed with the stage.

        Raises:
            UsageError: The program rejects its input.
            LockstepError: The companion hangs or raised an error.
        """
        firmware, conductor = self.firmware, self.conductor
        started_us = firmware.load(setup, tlog, BOOT_UNIX_US).time_us
        begun(started_us)
        simulation = firmware.simulation
        if simulation is not None and simulation.faults is not None:
            # Registered before the first tick, so that a fault at time 0 acts.
            self._give_up_when_cut(simulation.faults)
            self._let_companion_fail(simulation.faults)

        def connected() -> None:
            try:
                self.link.connect(HEARD_TIMEOUT_S)
            # Without faults, a vehicle that cannot be heard is an error of the setup.
            except LinkError as error:
                if not setup.aircraft.faults:
                    raise
                self.unheard = str(error)
                return
            program()

        self._partner.start(connected)
        conductor.begin(started_us + self._vehicle.heard_after_us + COMPANION_STARTS_US)
        # A companion that is out for good ends the flight at the verdict or when disarmed.
        while not conductor.ended and not (self.out and (judged() or self._down())):
            firmware.step()
        if self.out.endswith(STOPPED):
            # The companion reports its results without flying.
            self.abandon.set()
            if stop is not None:
                stop.set()
            conductor.resume()
            while not conductor.ended:
                firmware.step()
        # Errors of the companion's thread are raised here, on the caller's thread.
        self._raise_what_broke()
        assert firmware.simulation is not None  # noqa: S101 (loaded above)
        return firmware.simulation

    def _give_up_when_cut(self, faults: FaultTimeline) -> None:
        """Use MAVSDK's short command timeout while the link is cut, as outside of lockstep.

        On an intact link an answer is certain, and MAVSDK waits for it even on a slow host.
        """

        def changed() -> None:
            cut = any(each.fault.kind == "cut" for each in faults.acting(*LINKS))
            self.link.set_timeout(CUT_TIMEOUT_S if cut else RAW_TIMEOUT_S)

        faults.on_change(changed)

    def _let_companion_fail(self, faults: FaultTimeline) -> None:
        """Suspend the companion's turns during its faults, and for good after it is killed."""

        def changed() -> None:
            # Several faults may overlap; a permanent fault wins.
            acting = [each.fault for each in faults.acting("companion")]
            for_good = next((fault for fault in acting if fault.for_good), None)
            if for_good is not None:
                self.out = self.out or f"{for_good.part} {for_good.kind}"
            if acting:
                self.conductor.suspend()
            elif not self.out:
                self.conductor.resume()

        # Called once for faults that act from the start.
        changed()
        faults.on_change(changed)

    def _down(self) -> bool:
        """Return True if the motors are stopped."""
        simulation = self.firmware.simulation
        return simulation is None or simulation.autopilot.flight.phase < FlightPhase.GROUND

    def _raise_what_broke(self) -> None:
        error = self._partner.error
        if isinstance(error, errors.UsageError):
            raise error
        if error is not None:
            raise LockstepError(f"the companion broke: {type(error).__name__}: {error}") from error


_MESSAGE = slice(7, 10)
"""Position of the message id in a frame."""


_SENT_BY = slice(5, 10)
"""Position of system id, component id and message id in a frame."""


_PER_INSTANCE = ("DISTANCE_SENSOR",)
"""Streams of several devices, distinguished by a field."""


STATES = frozenset(
    codec.layout(name).id_bytes
    for name, rate_hz in px4_links.ONBOARD_HZ.items()
    if rate_hz > 1.0 and name not in _PER_INSTANCE
)
"""Messages that replace older ones: state streams, and TIMESYNC, whose answer is not sent to the
vehicle (`conductor`). Answers, events, texts and slow streams such as HEARTBEAT are excluded."""


UNREAD = frozenset(
    codec.layout(name).id_bytes
    for name in (
        *("HIGHRES_IMU", "ODOMETRY", "ALTITUDE", "ATTITUDE_TARGET", "SERVO_OUTPUT_RAW", "VFR_HUD"),
        *("POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_GLOBAL_INT", "ESC_INFO", "ESC_STATUS"),
    )
)
"""Messages that the companion never reads from MAVSDK."""


def newest(frames: Sequence[bytes]) -> list[bytes]:
    """Return frames without `UNREAD` messages, and only the newest of each of the `STATES`."""
    kept: list[bytes] = []
    replaced: set[bytes] = set()
    # From the newest to the oldest: the first frame of each state is the one to keep.
    for frame in reversed(frames):
        if frame[_MESSAGE] in UNREAD:
            continue
        if frame[_MESSAGE] in STATES:
            # States of several systems are kept separately.
            sent_by = frame[_SENT_BY]
            if sent_by in replaced:
                continue
            replaced.add(sent_by)
        kept.append(frame)
    kept.reverse()
    return kept


def newest_heartbeat(frames: Sequence[bytes]) -> bytes | None:
    """Return the last HEARTBEAT of some frames, or None."""
    return next((frame for frame in reversed(frames) if frame[_MESSAGE] == b"\0\0\0"), None)
