"""Vehicles for lockstep flights, with their end of the companion's link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from airl_mav.faults.fault import Fault, link_fails
from airl_mav.lockstep.vehicle_end import InMemory, RealFirmwareEnd, VehicleEnd
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.external.compose import conducted_px4
from firmware_sim.faults.faulty_link import FailingEndpoint
from firmware_sim.firmware import BuiltinFlightStack, FlightStack
from firmware_sim.mavlink.endpoint import MemoryEndpoint, SharedEndpoint
from firmware_sim.mavlink.px4_links import LinkConfig, onboard_link
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


def lockstep_link(endpoint: SharedEndpoint) -> LinkConfig:
    """Return the onboard link configuration for a lockstep companion.

    Replies have separate sequence numbers: MAVSDK's requests come at any time, and must not change
    the bytes of the streams. The vehicle flies uninterrupted until slow streams are due.
    """
    link = onboard_link(endpoint)
    rates = {**link.rates_hz, **MAVSDK_HZ}
    return replace(link, rates_hz=rates, separate_replies=True, slow_every_us=SLOW_EVERY_US)


@dataclass(frozen=True)
class ConductedVehicle:
    """Vehicle for a lockstep flight."""

    stack: FlightStack
    end: VehicleEnd
    """Vehicle's end of the companion's link."""
    failing: FailingEndpoint | None = None
    """Link with simulated faults; None = no link faults."""
    heard_after_us: int = 0
    """Maximum time from loading an episode to the first heartbeat [µs]."""


def builtin_vehicle(clock: Clock, faults: Sequence[Fault] = ()) -> ConductedVehicle:
    """Return the built-in autopilot with an in-memory link.

    Args:
        clock: Clock of the conductor.
        faults: Faults of the flight; link faults add a `FailingEndpoint`.
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
    """Return the aircraft's real firmware; None for the built-in autopilot.

    Binds the ports, starts nothing.

    Args:
        aircraft: Options of the aircraft.
        vehicle: Vehicle profile.
        log: Path for the output of real firmware; None = a file in the firmware's folder.

    Raises:
        UsageError: No instance of real firmware is free, or its program is missing.
    """
    if aircraft.firmware == "builtin":
        return None
    px4 = conducted_px4(aircraft, vehicle, log)
    end = RealFirmwareEnd(px4.link, px4.settle)
    return ConductedVehicle(px4.stack, end, heard_after_us=HEARTBEAT_US)
