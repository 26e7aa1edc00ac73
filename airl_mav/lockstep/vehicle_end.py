"""The vehicle's end of the companion's link: in memory, or real firmware's on a socket."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from firmware_sim.external.px4.onboard_link import OnboardLink
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint

SETTLE_EVERY = 5
"""Ticks between two waits for real firmware. A turn begins with a wait, too. Telemetry is read
then: it is at most 20 ms old."""

_HEADER = 10
_COMMANDS = {
    dialect.MAVLINK_MSG_ID_COMMAND_LONG: slice(_HEADER + 28, _HEADER + 30),
    dialect.MAVLINK_MSG_ID_COMMAND_INT: slice(_HEADER + 28, _HEADER + 30),
}
"""Where the number of a command lies in its frame: behind seven fields of four bytes."""


class VehicleEnd(Protocol):
    """What the conductor needs of a vehicle."""

    answers_later: bool
    """Whether it answers commands in simulated time, which has to go on meanwhile."""

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        """Have it take in a frame of the companion's.

        Args:
            frame: A MAVLink frame.
            carry_out: Makes a vehicle of this process read what has arrived.
            echo: Whether to return only when it has. That must not be asked while a command is
                under way: it may take simulated time until it takes in anything else.
        """
        ...

    def take(self) -> list[bytes]:
        """Return what it has sent since the last call: whole MAVLink frames, oldest first."""
        ...

    def after_tick(self, *, expected: bool) -> list[bytes]:
        """Return the same, once a tick; nobody needs it at once unless an answer is `expected`."""
        ...

    def settle(self) -> None:
        """Return when it has done, and sent, all that is due by now."""
        ...


class InMemory:
    """A vehicle of this process, which answers within the tick. Implements `VehicleEnd`."""

    answers_later = False

    def __init__(self, endpoint: MemoryEndpoint) -> None:
        """Take the vehicle's end."""
        self._endpoint = endpoint
        self.take = endpoint.take

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        """Have it carry out a frame, at once: there is nothing to wait for."""
        del echo
        self._endpoint.inbox.append(frame)
        carry_out()

    def after_tick(self, *, expected: bool) -> list[bytes]:
        """Return what it has sent."""
        del expected
        return self.take()

    def settle(self) -> None:
        """Return: it has no threads of its own."""


class RealFirmwareEnd:
    """Real firmware on its own link. Implements `VehicleEnd`."""

    answers_later = True

    def __init__(self, link: OnboardLink, settle: Callable[[], None]) -> None:
        """Take its link, and what waits until it has done all that is due."""
        self._link = link
        self._settle = settle
        self._ticks = 0

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        """Send a frame; return when the firmware has taken it in, if `echo`."""
        del carry_out  # Its own threads do that.
        self._link.send(frame)
        if echo:
            self._link.await_echo()

    def take(self) -> list[bytes]:
        """Return what has come."""
        return self._link.take()

    def after_tick(self, *, expected: bool) -> list[bytes]:
        """Return what has come, now and then; the firmware is waited for then."""
        self._ticks += 1
        if self._ticks % SETTLE_EVERY == 0:
            self._settle()
        elif not expected:
            return []
        return self._link.take()

    def settle(self) -> None:
        """Return when it has done all that is due."""
        self._settle()


def command_of(frame: bytes) -> int | None:
    """Return the number of the command that a MAVLink 2 frame is; None: it is none."""
    where = _COMMANDS.get(int.from_bytes(frame[7:10], "little"))
    return None if where is None else int.from_bytes(frame[where], "little")


def acknowledged(frame: bytes) -> int | None:
    """Return the number of the command whose final COMMAND_ACK a MAVLink 2 frame is, or None."""
    if int.from_bytes(frame[7:10], "little") != dialect.MAVLINK_MSG_ID_COMMAND_ACK:
        return None
    payload = frame[_HEADER : _HEADER + frame[1]].ljust(3, b"\0")
    if payload[2] == dialect.MAV_RESULT_IN_PROGRESS:
        return None
    return int.from_bytes(payload[:2], "little")
