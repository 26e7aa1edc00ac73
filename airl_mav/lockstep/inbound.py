"""What of the companion's MAVLink reaches the flight controller in lockstep.

MAVSDK repeats setpoints at 20 Hz, sends heartbeats and asks for messages by the wall clock, from
threads of its own. None of that may reach a flight that is to be the same every time. So here a
setpoint that only repeats the last one is dropped, and repeated in simulated time instead; what
passes is stamped with simulated time and numbered anew. Nothing is signed here: that is the
wire's matter (`wire`), and its key stays the one of the start.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from airl_mav.core.constants import US_PER_MS, US_PER_S
from firmware_sim.autopilot.mode_numbers import MAIN_OFFBOARD
from firmware_sim.mavlink.codec import (
    Decoder,
    Encoder,
    Layout,
    WireMessage,
    dialect,
    layout,
    payload,
    trimmed,
)

REPEAT_US = US_PER_S // 20
"""MAVSDK repeats the newest setpoint so often [µs] (its offboard plugin: 20 Hz)."""

_SETPOINTS = (
    dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
    dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT,
    dialect.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET,
)
_BY_THE_WALL_CLOCK = (
    dialect.MAVLINK_MSG_ID_HEARTBEAT,
    dialect.MAVLINK_MSG_ID_PING,
    dialect.MAVLINK_MSG_ID_TIMESYNC,
    dialect.MAVLINK_MSG_ID_SYSTEM_TIME,
)
_MAVLINK_2 = b"\xfd"
"""How a MAVLink 2 frame begins."""
_MESSAGE = slice(7, 10)
"""Where a MAVLink 2 frame has the number of its message."""
_IGNORED = frozenset(number.to_bytes(3, "little") for number in _BY_THE_WALL_CLOCK)
"""The same numbers as a frame has them: most of what MAVSDK sends need not be decoded."""
_TIME_BYTES = 4
"""Length of the time stamp with which the payload of a setpoint begins."""
_ASKED_BY_THE_WALL_CLOCK = {
    (dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_HOME_POSITION): (
        dialect.MAV_RESULT_DENIED
    ),
    (dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE): (
        dialect.MAV_RESULT_ACCEPTED
    ),
}
"""What MAVSDK asks of its own accord (command, message), and the answer here. HOME_POSITION it
wants every second until it has it: it comes with its stream. EXTENDED_SYS_STATE it wants at 1 Hz,
at some moment of its choice: it is streamed at that rate from the start."""

_RATES_AND_REQUESTS = (dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAV_CMD_SET_MESSAGE_INTERVAL)
"""MAVSDK sends these in any order when it connects: no part of a flight's fingerprint."""

_ENDS_OFFBOARD = (
    dialect.MAV_CMD_DO_SET_MODE,
    dialect.MAV_CMD_NAV_LAND,
    dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH,
    dialect.MAV_CMD_NAV_TAKEOFF,
)


@dataclass(frozen=True)
class Passed:
    """What becomes of one frame of the companion."""

    deliver: tuple[bytes, ...] = ()
    """For the flight controller."""
    of_the_flight: bool = True
    """Whether it belongs to the flight's fingerprint."""
    answer: bytes | None = None
    """For the companion, in the flight controller's place."""


NOTHING = Passed()

Encoders: TypeAlias = "dict[tuple[int, int], Encoder]"
"""By sender: system and component id."""


class Inbound:
    """Sorts the companion's frames. One flight."""

    def __init__(self) -> None:
        self.next_repeat_us: int | None = None
        """When the newest setpoint is due again [µs]; None: nothing is repeated."""
        self._setpoint: tuple[tuple[int, int], Layout, bytes] | None = None
        """The newest setpoint: its sender, and its payload behind the time stamp."""
        self._counted = 0
        """Setpoints of the companion that have been delivered."""
        self._decoder = Decoder(datagrams=True)
        self._numbered: Encoders = {}
        self._aside: Encoders = {}
        """Numbers apart, for what comes in any order."""
        self._own: Encoders = {}
        """Of the flight controller, for what is answered in its place."""

    def take(self, frame: bytes, now_us: int) -> Passed:
        """Sort one frame.

        Args:
            frame: A MAVLink frame of the companion.
            now_us: Simulated time [µs].
        """
        if frame[:1] == _MAVLINK_2 and frame[_MESSAGE] in _IGNORED:
            return NOTHING
        messages = self._decoder.feed(frame)
        if len(messages) != 1:
            return NOTHING
        message = messages[0]
        number = message.get_msgId()
        if number in _BY_THE_WALL_CLOCK or number == dialect.MAVLINK_MSG_ID_SETUP_SIGNING:
            return NOTHING
        if number in _SETPOINTS:
            return self._take_setpoint(message, now_us)
        if number == dialect.MAVLINK_MSG_ID_COMMAND_LONG:
            return self._take_command(message, now_us)
        return Passed((self._pack(message),))

    def renewed(self, setpoints_sent: int, now_us: int) -> bytes | None:
        """Return the setpoint again when the companion sent the very same once more.

        On the wire that cannot be told from MAVSDK's repetition.

        Args:
            setpoints_sent: How many it has handed to MAVSDK so far.
            now_us: Simulated time [µs].
        """
        again = setpoints_sent > self._counted and self._setpoint is not None
        self._counted = setpoints_sent
        return self.repeat(now_us) if again else None

    def resume(self, now_us: int) -> None:
        """Nothing has been repeated for a while: once at simulated `now_us` [µs], not for all."""
        if self.next_repeat_us is not None:
            self.next_repeat_us = max(self.next_repeat_us, now_us)

    def end(self) -> None:
        """The companion has gone, and MAVSDK with it: nothing is repeated any more."""
        self.next_repeat_us = None

    def _take_setpoint(self, message: WireMessage, now_us: int) -> Passed:
        sender = message.get_srcSystem(), message.get_srcComponent()
        values = payload(message)[_TIME_BYTES:].rstrip(b"\0")
        setpoint = sender, layout(message.get_type()), values
        if setpoint == self._setpoint:
            return NOTHING
        self._setpoint = setpoint
        self._counted += 1
        return Passed((self.repeat(now_us),))

    def _take_command(self, message: WireMessage, now_us: int) -> Passed:
        result = _ASKED_BY_THE_WALL_CLOCK.get((message.command, message.param1))
        if result is not None:
            return Passed(answer=self._answer(message, result))
        before: tuple[bytes, ...] = ()
        if _enters_offboard(message):
            if self.next_repeat_us is None and self._setpoint is not None:
                # Offboard needs a setpoint that is fresh. MAVSDK has just sent one; should it be
                # the same as in the last offboard flight, it was taken for a repetition.
                before = (self.repeat(now_us),)
        elif message.command in _ENDS_OFFBOARD:
            self.next_repeat_us = None
        if message.command in _RATES_AND_REQUESTS:
            return Passed((self._pack(message, self._aside),), of_the_flight=False)
        return Passed((*before, self._pack(message)))

    def repeat(self, now_us: int) -> bytes:
        """Return the newest setpoint as MAVSDK repeats it; call when `next_repeat_us` is due."""
        assert self._setpoint is not None  # noqa: S101 (there is one whenever it is due)
        self.next_repeat_us = now_us + REPEAT_US
        sender, kind, values = self._setpoint
        stamp = (now_us // US_PER_MS).to_bytes(_TIME_BYTES, "little")
        return _encoder(self._numbered, sender).frame(kind, trimmed(stamp + values))

    def _pack(self, message: WireMessage, encoders: Encoders | None = None) -> bytes:
        encoders = self._numbered if encoders is None else encoders
        sender = message.get_srcSystem(), message.get_srcComponent()
        return _encoder(encoders, sender).pack(message)

    def _answer(self, command: WireMessage, result: int) -> bytes:
        sender = command.get_srcSystem(), command.get_srcComponent()
        vehicle = command.target_system, dialect.MAV_COMP_ID_AUTOPILOT1
        return _encoder(self._own, vehicle).pack(
            dialect.MAVLink_command_ack_message(command.command, result, 0, 0, *sender)
        )


def _encoder(encoders: Encoders, sender: tuple[int, int]) -> Encoder:
    """Return a sender's encoder, made when it is first needed."""
    if sender not in encoders:
        encoders[sender] = Encoder(*sender)
    return encoders[sender]


def _enters_offboard(command: WireMessage) -> bool:
    mode = command.command == dialect.MAV_CMD_DO_SET_MODE
    return bool(mode and command.param2 == MAIN_OFFBOARD)
