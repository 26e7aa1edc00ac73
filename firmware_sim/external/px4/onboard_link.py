"""PX4's onboard link for a companion in lockstep: frames in, frames out, an echo.

PX4 reads the messages of a link in order, in a thread that runs by the wall clock while all other
threads sleep on simulated time. This thread answers a PING, so the reply proves that all earlier
messages have been received and stamped with the time at which they were sent.
"""

from __future__ import annotations

import select
from collections import deque
from collections.abc import Callable

from airl_mav.core.clock import Patience
from airl_mav.core.constants import LOOPBACK
from firmware_sim.external.observer import SYSTEM_ID
from firmware_sim.external.px4.px4_program import API_LOCAL_PORT, API_PORT
from firmware_sim.interfaces import FirmwareLostError
from firmware_sim.mavlink.codec import Encoder, dialect
from firmware_sim.mavlink.endpoint import UdpEndpoint

ECHO_S = 60.0
"""Timeout of an echo [wall s, while this process runs]."""

PING_AGAIN_S = 0.1
"""Interval of repeated PINGs without a reply [wall s]."""

COMPONENT_ID = dialect.MAV_COMP_ID_USER2
"""MAVLink component id of the sender of PINGs, to which PX4 addresses the reply."""

_MARKER, _ID, _PAYLOAD = 0xFD, slice(7, 10), 10
_PING: bytes = dialect.MAVLINK_MSG_ID_PING.to_bytes(3, "little")
_SEQUENCE = slice(_PAYLOAD + 8, _PAYLOAD + 12)
_TARGET = slice(_PAYLOAD + 12, _PAYLOAD + 14)
_US = bytes([SYSTEM_ID, COMPONENT_ID])


class OnboardLink:
    """Companion's end of the link: MAVSDK's port in a rehearsal with two processes."""

    def __init__(self, instance: int, alive: Callable[[], None]) -> None:
        """Bind the port of an instance; `alive` is polled in waits and raises if PX4 is lost."""
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
        """Send a MAVLink 2 frame; PX4 replies in this version from then on."""
        self._endpoint.send(frame)

    def take(self) -> list[bytes]:
        """Return the received datagrams, oldest first: complete MAVLink frames."""
        self._receive(None)
        heard = list(self._heard)
        self._heard.clear()
        return heard

    def close(self) -> None:
        """Close the port."""
        self._endpoint.close()

    def await_echo(self) -> None:
        """Wait until PX4 has processed all sent frames, or raise FirmwareLostError.

        Do not call while a command is pending: setting a message's rate, for example, blocks PX4's
        receiver for some milliseconds of simulated time.
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
        """Read all datagrams; return True if they contain the echo of the sequence number."""
        found = False
        for data in self._endpoint.receive():
            if len(data) <= _PAYLOAD or data[0] != _MARKER:
                continue  # PX4 sends MAVLink 1 until it has received a frame.
            if data[_ID] == _PING and data[_TARGET] == _US:
                found = found or data[_SEQUENCE] == wanted
                continue
            self._heard.append(data)
        return found
