"""The vehicle, and its end of the companion's link, in lockstep."""

from __future__ import annotations

from dataclasses import replace

from airl_mav.core.constants import US_PER_S
from airl_mav.lockstep.conductor import Conductor
from firmware_sim.firmware import BuiltinFlightStack, Firmware, FrameServer
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.link import LinkConfig, onboard_link
from firmware_sim.mavlink.server import MavlinkServer

BOOT_UNIX_US = 1_767_225_600 * US_PER_S
"""Calendar time of simulated time 0: 2026-01-01T00:00Z, whenever that is [µs since 1970]."""

MAVSDK_HZ = {"EXTENDED_SYS_STATE": 1.0}
"""Rates that MAVSDK asks for by itself, at a moment that the wall clock decides [Hz]: here they are
set from the start, and its request changes nothing (`inbound`)."""


def lockstep_link(endpoint: MemoryEndpoint) -> LinkConfig:
    """Return the onboard link for a companion that is conducted.

    Answers have sequence numbers of their own: MAVSDK's requests come at any time, and must not
    change the bytes of the streams.
    """
    link = onboard_link(endpoint)
    rates = {**link.rates_hz, **MAVSDK_HZ}
    return replace(link, rates_hz=rates, separate_replies=True)


def conducted_firmware(
    endpoint: MemoryEndpoint, camera: FrameServer, conductor: Conductor
) -> Firmware:
    """Return the firmware whose companion is conducted, without an episode."""
    server = MavlinkServer([lockstep_link(endpoint)], boot_unix_us=BOOT_UNIX_US)
    return Firmware(BuiltinFlightStack(server), camera, conductor)
