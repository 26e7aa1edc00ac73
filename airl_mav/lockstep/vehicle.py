"""Vehicles for lockstep flights, with their end of the companion's link."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from airl_mav.camera.frame import Frame
from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from airl_mav.faults import Fault, link_fails
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft
from companion.frame_source import ReceivedFrame
from firmware_sim import fault_timeline, firmware
from firmware_sim.external.px4_lockstep import OnboardLink, conducted_px4
from firmware_sim.mavlink import codec, px4_links
from firmware_sim.mavlink.endpoint import MemoryEndpoint, SharedEndpoint
from firmware_sim.mavlink.server import MavlinkServer

BOOT_UNIX_US = 1_767_225_600 * US_PER_S
"""Calendar time of simulated time 0: always 2026-01-01T00:00Z [µs since 1970]."""

MAVSDK_HZ = {"EXTENDED_SYS_STATE": 1.0}
"""Rates that MAVSDK requests automatically, at a wall-clock dependent time [Hz]. They are set from
the start, so the request has no effect (`conductor`)."""


SLOW_EVERY_US = US_PER_S // 10
"""Grid of the slow streams [µs]."""

HEARTBEAT_US = US_PER_S
"""Heartbeat interval of PX4 [µs]."""


def lockstep_link(endpoint: SharedEndpoint) -> px4_links.LinkConfig:
    """Return the onboard link configuration for a lockstep companion.

    Replies have separate sequence numbers: MAVSDK's requests come at any time, and must not change
    the bytes of the streams. The vehicle flies uninterrupted until slow streams are due.
    """
    link = px4_links.onboard_link(endpoint)
    rates = {**link.rates_hz, **MAVSDK_HZ}
    return replace(link, rates_hz=rates, separate_replies=True, slow_every_us=SLOW_EVERY_US)


@dataclass(frozen=True)
class ConductedVehicle:
    """Vehicle for a lockstep flight."""

    stack: firmware.FlightStack
    end: VehicleEnd
    """Vehicle's end of the companion's link."""
    failing: fault_timeline.FailingLink | None = None
    """Link with simulated faults; None = no link faults."""
    heard_after_us: int = 0
    """Maximum time from loading an episode to the first heartbeat [µs]."""


def builtin_vehicle(clock: Clock, faults: Sequence[Fault] = ()) -> ConductedVehicle:
    """Return the built-in autopilot with an in-memory link; link faults act on the clock."""
    endpoint = MemoryEndpoint()
    failing = None
    if link_fails(faults):
        failing = fault_timeline.failing_link(endpoint, clock, conducted=True)
    link = lockstep_link(endpoint if failing is None else failing)
    server = MavlinkServer([link], boot_unix_us=BOOT_UNIX_US)
    return ConductedVehicle(firmware.BuiltinFlightStack(server), InMemory(endpoint), failing)


def real_vehicle(
    aircraft: Aircraft, vehicle: VehicleProfile, log: Path | None = None
) -> ConductedVehicle | None:
    """Return the aircraft's real firmware; None for the built-in autopilot.

    Binds the ports, starts nothing. The firmware's output goes to `log`; None = a file in its
    folder. Raises UsageError if no instance is free, or the program is missing.
    """
    if aircraft.firmware == "builtin":
        return None
    px4 = conducted_px4(aircraft, vehicle, log)
    end = RealFirmwareEnd(px4.link, px4.settle)
    return ConductedVehicle(px4.stack, end, heard_after_us=HEARTBEAT_US)


SETTLE_EVERY = 5
"""Ticks between two synchronizations with real firmware. Each turn begins with one, too. Telemetry
is read then and is at most 20 ms old."""

_HEADER = 10
_COMMANDS = {
    codec.dialect.MAVLINK_MSG_ID_COMMAND_LONG: slice(_HEADER + 28, _HEADER + 30),
    codec.dialect.MAVLINK_MSG_ID_COMMAND_INT: slice(_HEADER + 28, _HEADER + 30),
}
"""Position of a command's number in its frame, after seven fields of four bytes."""


class VehicleEnd(Protocol):
    """Interface between the conductor and a vehicle; by default for one in this process."""

    answers_later: bool
    """True if the vehicle needs simulated time to answer commands."""

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        """Deliver a MAVLink frame of the companion; `carry_out` lets an in-process vehicle read it.

        With `echo`, return after the vehicle has read the frame. Must be False while a command is
        pending, as the vehicle may need simulated time until it reads again.
        """

    def take(self) -> list[bytes]:
        """Return all MAVLink frames sent since the last call, oldest first."""

    def after_tick(self, *, expected: bool) -> list[bytes]:
        """Return new frames once per tick; they may be delayed unless an answer is `expected`."""
        del expected
        return self.take()

    def settle(self) -> None:
        """Wait until the vehicle has finished all due work and sent its messages."""


class InMemory(VehicleEnd):
    """Vehicle in this process, which answers within the tick. Implements `VehicleEnd`."""

    answers_later = False

    def __init__(self, endpoint: MemoryEndpoint) -> None:
        """Set the vehicle's endpoint."""
        self._endpoint = endpoint

    def take(self) -> list[bytes]:
        """Return all MAVLink frames sent since the last call, oldest first."""
        return self._endpoint.take()

    def settle(self) -> None:
        """Do nothing: the vehicle has no threads."""

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        """Let the vehicle process a frame immediately."""
        del echo
        self._endpoint.inbox.append(frame)
        carry_out()


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
    if int.from_bytes(frame[7:10], "little") != codec.dialect.MAVLINK_MSG_ID_COMMAND_ACK:
        return None
    payload = frame[_HEADER : _HEADER + frame[1]].ljust(3, b"\0")
    if payload[2] == codec.dialect.MAV_RESULT_IN_PROGRESS:
        return None
    return int.from_bytes(payload[:2], "little")


class DelayedFrames:
    """Queue of frames in transit from exposure to the companion."""

    def __init__(self, transport_us: int) -> None:
        """Set the transport latency [µs]: from exposure to the decoded frame in the companion."""
        self.transport_us = transport_us
        self.published = threading.Event()
        """Set by each sent frame; a waiting thread clears the event first."""
        self._frames: deque[Frame] = deque()

    def publish(self, frame: Frame) -> None:
        """Queue a frame for delivery, in simulated time."""
        frames, arrived_us = self._frames, frame.capture_time_us - self.transport_us
        while len(frames) > 1 and frames[1].capture_time_us <= arrived_us:
            frames.popleft()  # A newer frame has arrived: this one can no longer be read.
        frames.append(frame)
        if not self.published.is_set():
            self.published.set()

    def arrived(self, now_us: int) -> Frame | None:
        """Remove all frames that arrived by `now_us` [µs]; return the newest or None."""
        newest = None
        while (next_us := self.next_us) is not None and next_us <= now_us:
            newest = self._frames.popleft()
        return newest

    @property
    def next_us(self) -> int | None:
        """Arrival time of the next frame [µs]; None = no frame is in transit."""
        return self._frames[0].capture_time_us + self.transport_us if self._frames else None

    @property
    def awaited(self) -> bool:
        """True if the companion waits for the next exposure."""
        return not self.published.is_set()

    def close(self) -> None:
        """Discard all frames."""
        self._frames.clear()


class MemoryCamera(DelayedFrames):
    """In-process camera: `firmware.FrameServer` and, with `latest`, `frame_source.FrameSource`."""

    endpoint = "memory"

    def __init__(self, transport_us: int) -> None:
        """Set the transport latency from exposure to arrival [µs]."""
        super().__init__(transport_us)
        self.clock: Clock | None = None
        """Clock of the companion; None = not connected yet."""
        self._newest: ReceivedFrame | None = None

    def latest(self) -> ReceivedFrame | None:
        """Return the newest frame that has arrived, without blocking; None before the first."""
        now_us = 0 if self.clock is None else self.clock.time_us()
        if (arrived := self.arrived(now_us)) is not None:
            self._newest = ReceivedFrame(arrived, now_us)
        return self._newest

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        """Wait for a frame with another sequence number; see `companion.frame_source.FrameSource`.

        The timeout is in simulated time.
        """
        clock = self.clock
        if clock is None:
            raise RuntimeError("nobody looks: the camera has no companion's clock")
        # The timeout counts in simulated time: wall time must not affect the flight.
        deadline_us = clock.time_us() + int(timeout_s * US_PER_S)
        while True:
            newest = self.latest()
            if newest is not None and newest.frame.sequence != newer_than_sequence:
                return newest
            if clock.time_us() >= deadline_us:
                return None
            # A frame in transit has a known arrival; otherwise its publication ends the sleep.
            if self.next_us is not None:
                clock.sleep_until(min(deadline_us, self.next_us))
            else:
                self.published.clear()
                clock.sleep_until(deadline_us, self.published)
