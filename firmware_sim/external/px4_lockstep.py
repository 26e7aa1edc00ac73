"""PX4 SITL in lockstep with a companion: a free instance, and its onboard link with an echo.

PX4 reads the messages of a link in order, in a thread that runs by the wall clock while all other
threads sleep on simulated time. This thread answers a PING, so the reply proves that all earlier
messages have been received and stamped with the time at which they were sent.
"""

from __future__ import annotations

import select
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from airl_mav.core import clock, constants, errors, scheduling
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import GREATEST_INSTANCE, Aircraft
from firmware_sim.external import flight_stack, observer, programs, px4_sitl
from firmware_sim.interfaces import FirmwareLostError
from firmware_sim.mavlink import codec, px4_links

ECHO_S = 60.0
"""Timeout of an echo [wall s, while this process runs]."""

PING_AGAIN_S = 0.1
"""Interval of repeated PINGs without a reply [wall s]."""

COMPONENT_ID = codec.dialect.MAV_COMP_ID_USER2
"""MAVLink component id of the sender of PINGs, to which PX4 addresses the reply."""

_MARKER, _ID, _PAYLOAD = 0xFD, slice(7, 10), 10
_PING: bytes = codec.dialect.MAVLINK_MSG_ID_PING.to_bytes(3, "little")
_SEQUENCE = slice(_PAYLOAD + 8, _PAYLOAD + 12)
_TARGET = slice(_PAYLOAD + 12, _PAYLOAD + 14)
_US = bytes([observer.SYSTEM_ID, COMPONENT_ID])


class OnboardLink:
    """Companion's end of the link: MAVSDK's port in a rehearsal with two processes."""

    def __init__(self, instance: int, alive: Callable[[], None]) -> None:
        """Bind the port of an instance; `alive` is polled in waits and raises if PX4 is lost."""
        self._endpoint = flight_stack.instance_endpoint(
            programs.API_PORT + instance, programs.API_LOCAL_PORT + instance
        )
        self._alive = alive
        self._encoder = codec.Encoder(observer.SYSTEM_ID, COMPONENT_ID)
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
        ping = self._encoder.pack(codec.dialect.MAVLink_ping_message(0, number, 0, 0))
        wanted = number.to_bytes(4, "little")
        socket = self._endpoint.fileno()
        if socket is None:
            raise FirmwareLostError("the companion's link to PX4 is closed")
        waited, again_s = clock.Patience(), 0.0
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


ANSWER_S = 60.0
"""Timeout of PX4's reply to a sample [wall s, while this process runs]."""


STATE_US = constants.US_PER_S // 5
"""Minimum interval of the true state [µs]. PX4 requests 5 ms, only for its log."""


LOOK_US = constants.US_PER_S // 50
"""Interval at which the observer's link is read [µs]; no message on it is faster."""


@dataclass(frozen=True)
class ConductedPx4:
    """PX4 with its links and functions for a lockstep scheduler."""

    stack: flight_stack.ExternalFlightStack
    link: OnboardLink
    """Companion's link; closed with the stack."""
    settle: Callable[[], None]
    """Wait until PX4 has done all work due by its clock."""
    instance: int


def conducted_px4(aircraft: Aircraft, vehicle: VehicleProfile, log: Path | None) -> ConductedPx4:
    """Bind the ports of an instance of PX4 and return it, not yet started.

    PX4 started here gets the first free instance from the requested instance on, so that parallel
    flights use different instances. `log` receives PX4's output; None = a file in its folder.
    Raises UsageError if no instance is free or the program does not exist.
    """
    scheduling.ask_for_short_slices()
    real = aircraft.real
    request = flight_stack.FirmwareRequest(aircraft, vehicle, log, _no_ends)
    if real.px4_dir is None:
        return _instance(request, real.instance)
    programs.find_px4(real.px4_dir)
    taken: errors.UsageError | None = None
    for instance in range(real.instance, GREATEST_INSTANCE + 1):
        # Bind first, so that two concurrent processes do not take the same instance.
        try:
            found = _instance(request, instance)
        except errors.UsageError as error:
            taken = error
            continue
        try:
            programs.check_free(instance)
        except errors.UsageError as error:
            taken = error
            found.stack.close()
            continue
        return found
    raise errors.UsageError(
        f"no instance of PX4's from {real.instance} to {GREATEST_INSTANCE} is free (other "
        "simulators?): choose another with --instance, or fewer workers"
    ) from taken


def _instance(request: flight_stack.FirmwareRequest, instance: int) -> ConductedPx4:
    newest: list[px4_sitl.Px4Bridge] = []

    def bridge(port: int) -> px4_sitl.Px4Bridge:
        newest[:] = [px4_sitl.Px4Bridge(port, answer_s=ANSWER_S, least_state_us=STATE_US)]
        return newest[0]

    def alive() -> None:
        for each in newest:
            each.alive()

    def settle() -> None:
        for each in newest:
            each.settle()

    launcher, watching = px4_sitl.px4_parts(request, instance, bridge)
    try:
        link = OnboardLink(instance, alive)
    except errors.UsageError:
        watching.close()
        launcher.close()
        raise
    stack = flight_stack.ExternalFlightStack(
        launcher,
        watching,
        request.aircraft.real.firmware_timeout,
        on_close=link.close,
        look_every_us=LOOK_US,
    )
    return ConductedPx4(stack, link, settle, instance)


def _no_ends() -> px4_links.UdpLinks:
    raise RuntimeError("PX4 SITL binds its own ends of its links")
