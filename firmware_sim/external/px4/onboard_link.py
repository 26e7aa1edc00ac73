"""PX4's onboard link in the hands of who conducts the companion: frames in, frames out, an echo.

PX4 takes in the messages of a link one after the other, in a thread that runs by the wall clock
while all others sleep on simulated time. That thread answers a PING itself, so the answer proves
that everything sent before has been taken in, and stamped with the time at which it was sent.
"""

from __future__ import annotations

import select
from collections import deque
from collections.abc import Callable

from airl_mav.core.clock import Patience
from airl_mav.core.ports import LOOPBACK
from firmware_sim.external.observer import SYSTEM_ID
from firmware_sim.external.px4.program import API_LOCAL_PORT, API_PORT
from firmware_sim.flight_controller import FirmwareLostError
from firmware_sim.mavlink.codec import Encoder, dialect
from firmware_sim.mavlink.endpoint import UdpEndpoint

ECHO_S = 60.0
"""Longest wait for an echo [wall s, while this process runs]."""

PING_AGAIN_S = 0.1
"""A PING is repeated after so long without an answer [wall s]."""

COMPONENT_ID = dialect.MAV_COMP_ID_USER2
"""MAVLink component id of the echo's sender, which PX4's answer is addressed to."""

_MARKER, _ID, _PAYLOAD = 0xFD, slice(7, 10), 10
_PING: bytes = dialect.MAVLINK_MSG_ID_PING.to_bytes(3, "little")
_SEQUENCE = slice(_PAYLOAD + 8, _PAYLOAD + 12)
_TARGET = slice(_PAYLOAD + 12, _PAYLOAD + 14)
_US = bytes([SYSTEM_ID, COMPONENT_ID])


class OnboardLink:
    """One end of the link, the one that MAVSDK's port is in a rehearsal of two processes."""

    def __init__(self, instance: int, alive: Callable[[], None]) -> None:
        """Bind the port of an instance; `alive` is polled in waits and raises when PX4 is gone."""
        self._endpoint = UdpEndpoint(
            (LOOPBACK, API_PORT + instance),
            (LOOPBACK, API_LOCAL_PORT + instance),
            local_option="--instance",
            remote_option="--instance",
        )
        self._alive = alive
        self._encoder = Encoder(SYSTEM_ID, COMPONENT_ID)
        self._echoes = 0
        self._heard: deque[bytes] = deque()

    def send(self, frame: bytes) -> None:
        """Send a frame: MAVLink 2, so PX4 speaks that version from then on."""
        self._endpoint.send(frame)

    def take(self) -> list[bytes]:
        """Return the datagrams that have come, oldest first: whole MAVLink frames."""
        self._receive(None)
        heard = list(self._heard)
        self._heard.clear()
        return heard

    def close(self) -> None:
        """Close the port."""
        self._endpoint.close()

    def await_echo(self) -> None:
        """Return when PX4 has processed everything sent, or raise FirmwareLostError.

        Not while a command is pending: setting a message's rate, for one, blocks PX4's receiver for
        some milliseconds of simulated time.
        """
        number = self._echoes = (self._echoes + 1) & 0xFFFF_FFFF
        ping = self._encoder.pack(dialect.MAVLink_ping_message(0, number, 0, 0))
        wanted = number.to_bytes(4, "little")
        socket = self._endpoint.fileno()
        if socket is None:
            raise FirmwareLostError("the companion's link to PX4 is closed")
        waited, again_s = Patience(), 0.0
        while (so_far_s := waited.so_far_s()) < ECHO_S:
            if so_far_s >= again_s:
                self._endpoint.send(ping)
                again_s = so_far_s + PING_AGAIN_S
            ready, _, _ = select.select([socket], [], [], PING_AGAIN_S)
            if not ready:
                self._alive()
            elif self._receive(wanted):
                return
        raise FirmwareLostError(
            f"PX4's onboard link is silent: no answer to a PING in {ECHO_S:g} s"
        )

    def _receive(self, wanted: bytes | None) -> bool:
        """Take what has come; return whether the echo of that sequence number was among it."""
        found = False
        for data in self._endpoint.receive():
            if len(data) <= _PAYLOAD or data[0] != _MARKER:
                continue  # Version 1 is what PX4 speaks before it has heard anybody.
            if data[_ID] == _PING and data[_TARGET] == _US:
                found = found or data[_SEQUENCE] == wanted
                continue
            self._heard.append(data)
        return found
