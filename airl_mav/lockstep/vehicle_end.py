"""Vehicle's end of the companion's link: in memory, or a socket of real firmware."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from firmware_sim.external.px4.onboard_link import OnboardLink
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint

SETTLE_EVERY = 5
"""Ticks between two synchronizations with real firmware. Each turn begins with one, too. Telemetry
is read then and is at most 20 ms old."""

_HEADER = 10
_COMMANDS = {
    dialect.MAVLINK_MSG_ID_COMMAND_LONG: slice(_HEADER + 28, _HEADER + 30),
    dialect.MAVLINK_MSG_ID_COMMAND_INT: slice(_HEADER + 28, _HEADER + 30),
}
"""Position of a command's number in its frame, after seven fields of four bytes."""


class VehicleEnd(Protocol):
    """Interface between the conductor and a vehicle."""

    answers_later: bool
    """True if the vehicle needs simulated time to answer commands."""

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        """Deliver a frame of the companion to the vehicle.

        Args:
            frame: A MAVLink frame.
            carry_out: Callback that lets an in-process vehicle process its input.
            echo: True = return after the vehicle has read the frame. Must be False while a command
                is pending, as the vehicle may need simulated time until it reads again.
        """
        ...

    def take(self) -> list[bytes]:
        """Return all MAVLink frames sent since the last call, oldest first."""
        ...

    def after_tick(self, *, expected: bool) -> list[bytes]:
        """Return new frames once per tick; they may be delayed unless an answer is `expected`."""
        ...

    def settle(self) -> None:
        """Wait until the vehicle has finished all due work and sent its messages."""
        ...


class InMemory:
    """Vehicle in this process, which answers within the tick. Implements `VehicleEnd`."""

    answers_later = False

    def __init__(self, endpoint: MemoryEndpoint) -> None:
        """Set the vehicle's endpoint."""
        self._endpoint = endpoint
        self.take = endpoint.take

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        """Let the vehicle process a frame immediately."""
        del echo
        self._endpoint.inbox.append(frame)
        carry_out()

    def after_tick(self, *, expected: bool) -> list[bytes]:
        """Return all frames sent since the last call."""
        del expected
        return self.take()

    def settle(self) -> None:
        """Do nothing: the vehicle has no threads."""


class RealFirmwareEnd:
    """Real firmware with its own link. Implements `VehicleEnd`."""

    answers_later = True

    def __init__(self, link: OnboardLink, settle: Callable[[], None]) -> None:
        """Set the link, and a function that waits until the firmware has finished all due work."""
        self._link = link
        self._settle = settle
        self._ticks = 0

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        """Send a frame; with `echo`, wait until the firmware has read it."""
        del carry_out  # The firmware's threads process the frame.
        self._link.send(frame)
        if echo:
            self._link.await_echo()

    def take(self) -> list[bytes]:
        """Return all received frames."""
        return self._link.take()

    def after_tick(self, *, expected: bool) -> list[bytes]:
        """Return received frames every `SETTLE_EVERY` ticks, after a synchronization."""
        self._ticks += 1
        if self._ticks % SETTLE_EVERY == 0:
            self._settle()
        elif not expected:
            return []
        return self._link.take()

    def settle(self) -> None:
        """Wait until the firmware has finished all due work."""
        self._settle()


def command_of(frame: bytes) -> int | None:
    """Return the command number of a MAVLink 2 frame; None if it is not a command."""
    where = _COMMANDS.get(int.from_bytes(frame[7:10], "little"))
    return None if where is None else int.from_bytes(frame[where], "little")


def acknowledged(frame: bytes) -> int | None:
    """Return the command number of a final COMMAND_ACK, None for any other MAVLink 2 frame."""
    if int.from_bytes(frame[7:10], "little") != dialect.MAVLINK_MSG_ID_COMMAND_ACK:
        return None
    payload = frame[_HEADER : _HEADER + frame[1]].ljust(3, b"\0")
    if payload[2] == dialect.MAV_RESULT_IN_PROGRESS:
        return None
    return int.from_bytes(payload[:2], "little")
