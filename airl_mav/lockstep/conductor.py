"""Scheduler of vehicle and companion on one simulated clock.

Runs where the firmware waits for the time of a tick (`firmware_sim.pacing.Pacing`). Before each
tick it processes all earlier events in order: the companion's turns, at its wake-up times, and
MAVSDK's repetitions of the newest setpoint. Firmware and companion run unmodified.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from airl_mav.core.clock import SimClock, WallClock
from airl_mav.core.constants import TICK_US, US_PER_MS, US_PER_S
from airl_mav.lockstep.turns import FlightDigest, Partner, Turn
from airl_mav.lockstep.vehicle import VehicleEnd, acknowledged, command_of
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.interfaces import FirmwareLostError
from firmware_sim.mavlink import codec

REPEAT_US = US_PER_S // 20
"""Interval at which MAVSDK repeats the newest setpoint [µs] (its offboard plugin: 20 Hz)."""

_SETPOINTS = (
    codec.dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
    codec.dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT,
    codec.dialect.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET,
)
_BY_THE_WALL_CLOCK = (
    codec.dialect.MAVLINK_MSG_ID_HEARTBEAT,
    codec.dialect.MAVLINK_MSG_ID_PING,
    codec.dialect.MAVLINK_MSG_ID_TIMESYNC,
    codec.dialect.MAVLINK_MSG_ID_SYSTEM_TIME,
)
_MAVLINK_2 = b"\xfd"
"""First byte of a MAVLink 2 frame."""
_MESSAGE = slice(7, 10)
"""Position of the message id in a MAVLink 2 frame."""
_IGNORED = frozenset(number.to_bytes(3, "little") for number in _BY_THE_WALL_CLOCK)
"""The same ids as bytes: most of MAVSDK's frames need no decoding."""
_TIME_BYTES = 4
"""Length of the time stamp at the start of a setpoint's payload."""
_ASKED_BY_THE_WALL_CLOCK = {
    (codec.dialect.MAV_CMD_REQUEST_MESSAGE, codec.dialect.MAVLINK_MSG_ID_HOME_POSITION): (
        codec.dialect.MAV_RESULT_DENIED
    ),
    (codec.dialect.MAV_CMD_SET_MESSAGE_INTERVAL, codec.dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE): (
        codec.dialect.MAV_RESULT_ACCEPTED
    ),
}
"""Automatic requests of MAVSDK (command, message), and the answers sent here. MAVSDK requests
HOME_POSITION every second until it arrives with its stream. It requests EXTENDED_SYS_STATE at 1 Hz
at an arbitrary time, which is the stream's rate from the start."""

_RATES_AND_REQUESTS = (
    codec.dialect.MAV_CMD_REQUEST_MESSAGE,
    codec.dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
)
"""Commands that MAVSDK sends in any order when it connects: excluded from the digest."""

_ENDS_OFFBOARD = (
    codec.dialect.MAV_CMD_DO_SET_MODE,
    codec.dialect.MAV_CMD_NAV_LAND,
    codec.dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH,
    codec.dialect.MAV_CMD_NAV_TAKEOFF,
)


@dataclass(frozen=True)
class Passed:
    """Result of filtering one frame of the companion."""

    deliver: tuple[bytes, ...] = ()
    """Frames for the flight controller."""
    of_the_flight: bool = True
    """True if the frames are part of the flight's digest."""
    answer: bytes | None = None
    """Answer to the companion on behalf of the flight controller; None = no answer."""


NOTHING = Passed()

Encoders: TypeAlias = "dict[tuple[int, int], codec.Encoder]"
"""Encoders by sender: system and component id."""


class Inbound:
    """Filter for the companion's frames during one flight."""

    def __init__(self) -> None:
        self.next_repeat_us: int | None = None
        """Time of the next setpoint repetition [µs]; None = no repetition."""
        self._setpoint: tuple[tuple[int, int], codec.WireLayout, bytes] | None = None
        """Newest setpoint: sender, layout, and payload after the time stamp."""
        self._counted = 0
        """Number of the companion's setpoints delivered so far."""
        self._decoder = codec.Decoder(datagrams=True)
        self._numbered: Encoders = {}
        self._aside: Encoders = {}
        """Encoders with separate sequence numbers, for messages in any order."""
        self._own: Encoders = {}
        """Encoders of the flight controller, for answers on its behalf."""

    def take(self, frame: bytes, now_us: int) -> Passed:
        """Filter one MAVLink frame of the companion, at simulated `now_us` [µs]."""
        # Filtered by the header alone, before decoding: these messages are frequent.
        if frame[:1] == _MAVLINK_2 and frame[_MESSAGE] in _IGNORED:
            return NOTHING
        messages = self._decoder.feed(frame)
        if len(messages) != 1:
            return NOTHING
        message = messages[0]
        number = message.get_msgId()
        # Messages that MAVSDK sends at wall times would make the flight irreproducible.
        if number in _BY_THE_WALL_CLOCK or number == codec.dialect.MAVLINK_MSG_ID_SETUP_SIGNING:
            return NOTHING
        if number in _SETPOINTS:
            return self._take_setpoint(message, now_us)
        if number == codec.dialect.MAVLINK_MSG_ID_COMMAND_LONG:
            return self._take_command(message, now_us)
        # Repacked with a new sequence number: dropped frames must leave no gap.
        return Passed((self._pack(message),))

    def renewed(self, setpoints_sent: int, now_us: int) -> bytes | None:
        """Return the setpoint again if the companion sent an identical one; otherwise None.

        The frame on the wire does not differ from MAVSDK's repetition. `setpoints_sent` counts the
        setpoints that the companion has passed to MAVSDK so far.
        """
        again = setpoints_sent > self._counted and self._setpoint is not None
        self._counted = setpoints_sent
        return self.repeat(now_us) if again else None

    def resume(self, now_us: int) -> None:
        """Resume repetitions at simulated `now_us` [µs], without making up for missed ones."""
        if self.next_repeat_us is not None:
            self.next_repeat_us = max(self.next_repeat_us, now_us)

    def end(self) -> None:
        """Stop all repetitions: the companion and MAVSDK have ended."""
        self.next_repeat_us = None

    def _take_setpoint(self, message: codec.WireMessage, now_us: int) -> Passed:
        sender = message.get_srcSystem(), message.get_srcComponent()
        values = codec.payload(message)[_TIME_BYTES:].rstrip(b"\0")
        setpoint = sender, codec.layout(message.get_type()), values
        if setpoint == self._setpoint:
            return NOTHING
        self._setpoint = setpoint
        self._counted += 1
        return Passed((self.repeat(now_us),))

    def _take_command(self, message: codec.WireMessage, now_us: int) -> Passed:
        # Commands that MAVSDK sends at wall times are answered here, not by the vehicle.
        result = _ASKED_BY_THE_WALL_CLOCK.get((message.command, message.param1))
        if result is not None:
            return Passed(answer=self._answer(message, result))
        before: tuple[bytes, ...] = ()
        if _enters_offboard(message):
            if self.next_repeat_us is None and self._setpoint is not None:
                # Offboard mode needs a fresh setpoint. MAVSDK has just sent one. If it equals the
                # last setpoint of the previous offboard flight, it was dropped as a repetition.
                before = (self.repeat(now_us),)
        # Leaving offboard ends the repetition of setpoints.
        elif message.command in _ENDS_OFFBOARD:
            self.next_repeat_us = None
        # Requests of rates use separate sequence numbers, because their order may vary.
        if message.command in _RATES_AND_REQUESTS:
            return Passed((self._pack(message, self._aside),), of_the_flight=False)
        return Passed((*before, self._pack(message)))

    def repeat(self, now_us: int) -> bytes:
        """Return the newest setpoint as a repetition; call when `next_repeat_us` is due."""
        assert self._setpoint is not None  # noqa: S101 (there is one whenever it is due)
        self.next_repeat_us = now_us + REPEAT_US
        sender, kind, values = self._setpoint
        stamp = (now_us // US_PER_MS).to_bytes(_TIME_BYTES, "little")
        return _encoder(self._numbered, sender).frame(kind, codec.trimmed(stamp + values))

    def _pack(self, message: codec.WireMessage, encoders: Encoders | None = None) -> bytes:
        encoders = self._numbered if encoders is None else encoders
        sender = message.get_srcSystem(), message.get_srcComponent()
        return _encoder(encoders, sender).pack(message)

    def _answer(self, command: codec.WireMessage, result: int) -> bytes:
        sender = command.get_srcSystem(), command.get_srcComponent()
        vehicle = command.target_system, codec.dialect.MAV_COMP_ID_AUTOPILOT1
        return _encoder(self._own, vehicle).pack(
            codec.dialect.MAVLink_command_ack_message(command.command, result, 0, 0, *sender)
        )


def _encoder(encoders: Encoders, sender: tuple[int, int]) -> codec.Encoder:
    """Return a sender's encoder, created on first use."""
    if sender not in encoders:
        encoders[sender] = codec.Encoder(*sender)
    return encoders[sender]


def _enters_offboard(command: codec.WireMessage) -> bool:
    mode = command.command == codec.dialect.MAV_CMD_DO_SET_MODE
    return bool(mode and command.param2 == Mode.OFFBOARD.spec.main)


FEED_US = US_PER_S
"""Interval at which telemetry is forwarded between turns [µs]. MAVSDK drops a vehicle after 3 s of
wall time without a heartbeat."""

SHOWN_US = US_PER_S // 10
"""Maximum simulated time flown in one step when a viewer is connected [µs]."""

SILENCE_US = 3 * US_PER_S
"""Silence after which the flight controller counts as lost, as in MAVSDK [µs]."""


class Conductor:
    """Scheduler of one flight. Implements `firmware_sim.pacing.Pacing`."""

    epoch_ns = None
    slipped_us = 0

    def __init__(
        self,
        vehicle: VehicleEnd,
        partner: Partner,
        digest: FlightDigest | None = None,
        speed: float | None = None,
        clock: SimClock | None = None,
    ) -> None:
        """Connect the vehicle's end of the link and the companion; the clock is advanced here.

        `digest` receives all traffic on the link. `speed` is the maximum of simulated seconds per
        wall second; None = unlimited.
        """
        self.clock = clock or SimClock()
        self.ended = False
        """True after the companion has ended."""
        self._suspended = False
        """True while the companion is suspended."""
        self._vehicle = vehicle
        self._partner = partner
        self._digest = digest or FlightDigest()
        self._speed = speed
        self.is_shown = speed is not None
        """True if a viewer is connected."""
        self.orders_us: Callable[[], float] = lambda: math.inf
        """Returns the time of the next time-based order to the companion [µs]."""
        self._wall: WallClock | None = None
        self._inbound = Inbound()
        self._turn = Turn(None)
        self._waiting: list[bytes] = []
        """Telemetry that is not forwarded yet."""
        self._heard_us = self._passed_us = 0
        self._asked: int | None = None
        """Command whose acknowledgement the companion is waiting for; None = no command."""
        self._answered = threading.Event()
        self._readable: Callable[[int], object] = lambda _time_us: None

    def begin(self, at_us: int) -> None:
        """Give the companion its first turn at simulated time `at_us` [µs]."""
        if self._vehicle.answers_later:
            self._vehicle.take()  # Discard messages that real firmware sent during boot.
        self._turn = Turn(at_us)

    def suspend(self) -> None:
        """Suspend the companion: turns and MAVSDK's setpoint repetitions stop."""
        self._suspended = True

    def resume(self) -> None:
        """Resume the companion: it gets the overdue turn and all telemetry since at once."""
        if self._suspended:
            self._suspended = False
            self._turn = replace(self._turn, poll=None)
            self._inbound.resume(self.clock.time_us())

    @property
    def heard(self) -> bool:
        """True if the companion receives the flight controller's messages."""
        return self.clock.time_us() - self._heard_us <= SILENCE_US

    # --- firmware_sim.pacing.Pacing

    @property
    def quiet_until_us(self) -> float:
        """Time of the companion's next turn [µs]; `arrivals` handles MAVSDK's repetitions."""
        turn = self._turn
        # 0: the conductor must check each tick.
        if self._suspended or self._asked is not None or turn.wake_us is None:
            return 0.0
        if turn.interrupt is not None and turn.interrupt.is_set():
            return 0.0
        # Between checks of a condition the vehicle may run uninterrupted.
        wake_us, poll = float(turn.wake_us), turn.poll
        if poll is not None and poll.quiet_us is not None and not poll.due(self._waiting):
            # At most to the tick of the next heartbeat: the vehicle's uninterrupted run ends there.
            checks = poll.quiet_us(self._waiting) / poll.every_us
            wake_us += poll.every_us * (checks if math.isinf(checks) else max(0, int(checks) - 1))
        # A viewer needs frames at a minimum rate.
        if self.is_shown:
            wake_us = min(wake_us, self.clock.time_us() + SHOWN_US)
        # A time-based order may come first.
        return min(wake_us, self.orders_us())

    @property
    def arrivals(self) -> Conductor:
        """The scheduler, which also repeats setpoints."""
        return self

    @property
    def next_us(self) -> float:
        """Time of MAVSDK's next setpoint repetition [µs]; inf = never."""
        repeat_us = self._inbound.next_repeat_us
        return math.inf if repeat_us is None else repeat_us

    def arrive(self, tick_us: int) -> None:
        """Deliver all repetitions that are due up to simulated `tick_us` [µs]."""
        while (repeat_us := self._inbound.next_repeat_us) is not None and repeat_us <= tick_us:
            self.clock.sleep_until(repeat_us)
            self._deliver(self._inbound.repeat(repeat_us), self._readable)

    def restart(self, tick_us: int) -> None:
        """Set the clock to simulated `tick_us` [µs]."""
        self.clock.sleep_until(tick_us)
        if self._speed is not None:
            self._wall = WallClock(self._speed)
            self._wall.epoch_ns -= int(tick_us * 1_000 / self._speed)

    def wait(self, tick_us: int, sockets: Sequence[int], readable: Callable[[int], object]) -> int:
        """Process all events up to the next tick at simulated `tick_us` [µs]; return that time.

        `readable` lets the vehicle process received messages at a given time.
        """
        del sockets  # the vehicle's messages are read after each tick
        self._readable = readable
        if self._wall is not None:
            # With pacing, the tick waits for the wall clock here.
            self._wall.sleep_until(tick_us)
        self._pass_over_polls(tick_us)
        self.clock.sleep_until(tick_us - TICK_US)  # start of the newest tick
        # All telemetry of the tick is kept, and forwarded with the next turn.
        self._keep(self._vehicle.after_tick(expected=self._asked is not None))
        # A suspended companion gets no turn, only time.
        if self._suspended:
            self.clock.sleep_until(tick_us)
            return tick_us
        # An interrupt ends the companion's sleep at the start of this tick.
        interrupt = self._turn.interrupt
        if interrupt is not None and interrupt.is_set():
            self._turn = Turn(self.clock.time_us())
        while True:
            # Events of the tick in order: turns and setpoint repetitions, whichever comes first.
            wake_us, repeat_us = self._turn.wake_us, self._inbound.next_repeat_us
            first_us = wake_us if repeat_us is None else repeat_us
            if wake_us is not None and repeat_us is not None:
                first_us = min(wake_us, repeat_us)
            if first_us is None or first_us > tick_us:
                break
            self.clock.sleep_until(first_us)
            # At equal times the turn has precedence.
            if first_us == wake_us:
                self._vehicle.settle()
                self._keep(self._vehicle.take())
                poll = self._turn.poll
                # A condition that still fails costs the companion no turn.
                if poll is None or poll.due(self._waiting):
                    self._give_turn(readable)
                else:
                    self._turn = replace(self._turn, wake_us=first_us + poll.every_us)
            else:
                self._deliver(self._inbound.repeat(first_us), readable)
        self.clock.sleep_until(tick_us)
        return tick_us

    def _pass_over_polls(self, tick_us: int) -> None:
        """Skip all polls before the start of the newest tick: their condition is not met there."""
        wake_us, poll = self._turn.wake_us, self._turn.poll
        if wake_us is None or poll is None or poll.quiet_us is None:
            return
        missed_us = tick_us - TICK_US - wake_us
        if missed_us >= 0:
            wake_us += (missed_us // poll.every_us + 1) * poll.every_us
            self._turn = replace(self._turn, wake_us=wake_us)

    def read_by(self, began_us: int) -> int:
        """Return `began_us`: reading takes no simulated time."""
        return began_us

    # --- one turn

    def _give_turn(self, readable: Callable[[int], object]) -> None:
        now_us = self.clock.time_us()

        def handle(frame: bytes) -> threading.Event | None:
            # Frames that MAVSDK sends during the turn pass the filter one by one.
            passed = self._inbound.take(frame, now_us)
            if passed.answer is not None:
                self._partner.send([passed.answer])
            waits = False
            for wanted in passed.deliver:
                waits = self._deliver(wanted, readable, of_the_flight=passed.of_the_flight) or waits
            return self._answered if waits else None

        # The turn has reached its time limit while the companion still waits for an answer.
        if self._asked is not None and self._turn.interrupt is self._answered:
            raise FirmwareLostError(
                f"the flight controller did not answer command {self._asked} of the companion"
            )
        # Telemetry reaches the companion before its turn starts.
        self._pass_telemetry()
        self._turn = self._partner.turn(now_us, handle)
        # No wake time: the companion has ended.
        if self._turn.wake_us is None:
            self.ended = True
            self._inbound.end()
            return
        # A setpoint equal to the last one was dropped as a repetition and must count.
        again = self._inbound.renewed(self._turn.setpoints_sent, now_us)
        if again is not None:
            self._deliver(again, readable)

    def _deliver(
        self, frame: bytes, readable: Callable[[int], object], *, of_the_flight: bool = True
    ) -> bool:
        """Let the vehicle process one frame now, and forward its answers.

        Returns True if the frame is a command without an acknowledgement yet.
        """
        now_us, vehicle = self.clock.time_us(), self._vehicle
        # The digest contains frames of the flight, not requests that depend on the wall clock.
        if of_the_flight:
            self._digest.add("commands", now_us, frame)
        # Real firmware answers later: the companion waits for the acknowledgement.
        if vehicle.answers_later and (command := command_of(frame)) is not None:
            self._asked = command
            self._answered.clear()
        # A command may block the vehicle's input for some simulated time: request no echo then.
        vehicle.deliver(frame, lambda: readable(now_us), echo=self._asked is None)
        answers = vehicle.take()
        # Older telemetry first, then the answers, in the order of sending.
        if answers:
            self._pass_telemetry()
            self._pass(answers)
        return self._asked is not None

    # --- telemetry

    def _keep(self, frames: Sequence[bytes]) -> None:
        """Store frames received from the vehicle."""
        if not frames:
            return
        self._heard_us = self.clock.time_us()
        self._digest.extend("telemetry", b"".join(frames))
        self._waiting += frames
        if self._asked is not None or self._heard_us - self._passed_us >= FEED_US:
            self._pass_telemetry()

    def _pass_telemetry(self) -> None:
        self._passed_us = self.clock.time_us()
        poll = self._turn.poll
        if poll is not None and poll.due(self._waiting):
            self._turn = replace(self._turn, poll=None)
        if self._waiting:
            self._pass(self._waiting)
            self._waiting.clear()

    def _pass(self, frames: Sequence[bytes]) -> None:
        self._partner.send(frames)
        if self._asked is not None and self._asked in map(acknowledged, frames):
            self._asked = None
            self._answered.set()
