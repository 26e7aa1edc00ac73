"""Filter for the companion's MAVLink messages to the flight controller in lockstep.

MAVSDK's own threads repeat setpoints at 20 Hz, send heartbeats and request messages, all by wall
clock. Reproducible flights must not depend on them. Therefore repeated setpoints are dropped, and
repeated in simulated time instead. All other messages get simulated time stamps and new sequence
numbers. Signing happens in `wire`, with the key of the start.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from airl_mav.core.constants import US_PER_MS, US_PER_S
from firmware_sim.autopilot.mode_numbers import MAIN_OFFBOARD
from firmware_sim.mavlink.codec import (
    Decoder,
    Encoder,
    WireLayout,
    WireMessage,
    dialect,
    layout,
    payload,
    trimmed,
)

REPEAT_US = US_PER_S // 20
"""Interval at which MAVSDK repeats the newest setpoint [µs] (its offboard plugin: 20 Hz)."""

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
"""First byte of a MAVLink 2 frame."""
_MESSAGE = slice(7, 10)
"""Position of the message id in a MAVLink 2 frame."""
_IGNORED = frozenset(number.to_bytes(3, "little") for number in _BY_THE_WALL_CLOCK)
"""The same ids as bytes: most of MAVSDK's frames need no decoding."""
_TIME_BYTES = 4
"""Length of the time stamp at the start of a setpoint's payload."""
_ASKED_BY_THE_WALL_CLOCK = {
    (dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_HOME_POSITION): (
        dialect.MAV_RESULT_DENIED
    ),
    (dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE): (
        dialect.MAV_RESULT_ACCEPTED
    ),
}
"""Automatic requests of MAVSDK (command, message), and the answers sent here. MAVSDK requests
HOME_POSITION every second until it arrives with its stream. It requests EXTENDED_SYS_STATE at 1 Hz
at an arbitrary time, which is the stream's rate from the start."""

_RATES_AND_REQUESTS = (dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAV_CMD_SET_MESSAGE_INTERVAL)
"""Commands that MAVSDK sends in any order when it connects: excluded from the digest."""

_ENDS_OFFBOARD = (
    dialect.MAV_CMD_DO_SET_MODE,
    dialect.MAV_CMD_NAV_LAND,
    dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH,
    dialect.MAV_CMD_NAV_TAKEOFF,
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

Encoders: TypeAlias = "dict[tuple[int, int], Encoder]"
"""Encoders by sender: system and component id."""


class Inbound:
    """Filter for the companion's frames during one flight."""

    def __init__(self) -> None:
        self.next_repeat_us: int | None = None
        """Time of the next setpoint repetition [µs]; None = no repetition."""
        self._setpoint: tuple[tuple[int, int], WireLayout, bytes] | None = None
        """Newest setpoint: sender, layout, and payload after the time stamp."""
        self._counted = 0
        """Number of the companion's setpoints delivered so far."""
        self._decoder = Decoder(datagrams=True)
        self._numbered: Encoders = {}
        self._aside: Encoders = {}
        """Encoders with separate sequence numbers, for messages in any order."""
        self._own: Encoders = {}
        """Encoders of the flight controller, for answers on its behalf."""

    def take(self, frame: bytes, now_us: int) -> Passed:
        """Filter one frame.

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
        """Return the setpoint again if the companion sent an identical one; otherwise None.

        The frame on the wire does not differ from MAVSDK's repetition.

        Args:
            setpoints_sent: Number of setpoints that the companion has passed to MAVSDK so far.
            now_us: Simulated time [µs].
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
                # Offboard mode needs a fresh setpoint. MAVSDK has just sent one. If it equals the
                # last setpoint of the previous offboard flight, it was dropped as a repetition.
                before = (self.repeat(now_us),)
        elif message.command in _ENDS_OFFBOARD:
            self.next_repeat_us = None
        if message.command in _RATES_AND_REQUESTS:
            return Passed((self._pack(message, self._aside),), of_the_flight=False)
        return Passed((*before, self._pack(message)))

    def repeat(self, now_us: int) -> bytes:
        """Return the newest setpoint as a repetition; call when `next_repeat_us` is due."""
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
    """Return a sender's encoder, created on first use."""
    if sender not in encoders:
        encoders[sender] = Encoder(*sender)
    return encoders[sender]


def _enters_offboard(command: WireMessage) -> bool:
    mode = command.command == dialect.MAV_CMD_DO_SET_MODE
    return bool(mode and command.param2 == MAIN_OFFBOARD)
