"""The vehicle, and its end of the companion's link, in lockstep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from airl_mav.faults.model import Fault, link_fails
from airl_mav.lockstep.vehicle_end import InMemory, RealFirmwareEnd, VehicleEnd
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.external.conducted import conducted_px4
from firmware_sim.faults.link import FailingEndpoint
from firmware_sim.firmware import BuiltinFlightStack, FlightStack
from firmware_sim.mavlink.endpoint import MemoryEndpoint, SharedEndpoint
from firmware_sim.mavlink.link import LinkConfig, onboard_link
from firmware_sim.mavlink.server import MavlinkServer

BOOT_UNIX_US = 1_767_225_600 * US_PER_S
"""Calendar time of simulated time 0: 2026-01-01T00:00Z, whenever that is [µs since 1970]."""

MAVSDK_HZ = {"EXTENDED_SYS_STATE": 1.0}
"""Rates that MAVSDK asks for by itself, at a moment that the wall clock decides [Hz]: here they are
set from the start, and its request changes nothing (`inbound`)."""


SLOW_EVERY_US = US_PER_S // 10
"""Grid of the slow streams [µs]."""

HEARTBEAT_US = US_PER_S
"""PX4 sends its heartbeat so often [µs]."""


def lockstep_link(endpoint: SharedEndpoint) -> LinkConfig:
    """Return the onboard link for a companion that is conducted.

    Answers have sequence numbers of their own: MAVSDK's requests come at any time, and must not
    change the bytes of the streams. The vehicle flies at once until slow streams are due.
    """
    link = onboard_link(endpoint)
    rates = {**link.rates_hz, **MAVSDK_HZ}
    return replace(link, rates_hz=rates, separate_replies=True, slow_every_us=SLOW_EVERY_US)


@dataclass(frozen=True)
class ConductedVehicle:
    """What flies under a conductor."""

    stack: FlightStack
    end: VehicleEnd
    """Its end of the companion's link."""
    failing: FailingEndpoint | None = None
    """That link, where it is to fail."""
    heard_after_us: int = 0
    """Longest time until its first heartbeat after an episode was loaded [µs]."""


def builtin_vehicle(clock: Clock, faults: Sequence[Fault] = ()) -> ConductedVehicle:
    """Return the built-in autopilot, whose link is in memory.

    Args:
        clock: The conductor's.
        faults: What will fail; those of the link need a place of their own.
    """
    endpoint = MemoryEndpoint()
    failing = None
    if link_fails(faults):
        failing = FailingEndpoint(endpoint, clock, conducted=True)
    link = lockstep_link(endpoint if failing is None else failing)
    server = MavlinkServer([link], boot_unix_us=BOOT_UNIX_US)
    return ConductedVehicle(BuiltinFlightStack(server), InMemory(endpoint), failing)


def real_vehicle(
    aircraft: Aircraft, vehicle: VehicleProfile, log: Path | None = None
) -> ConductedVehicle | None:
    """Return the real firmware that an aircraft is flown by; None: it is the built-in autopilot.

    Its ports are bound, nothing is started.

    Args:
        aircraft: What was asked of it.
        vehicle: What it flies.
        log: What real firmware prints goes here; None: to a file in its folder.

    Raises:
        UsageError: No instance of real firmware is free, or its program is not there.
    """
    if aircraft.firmware == "builtin":
        return None
    px4 = conducted_px4(aircraft, vehicle, log)
    end = RealFirmwareEnd(px4.link, px4.settle)
    return ConductedVehicle(px4.stack, end, heard_after_us=HEARTBEAT_US)
