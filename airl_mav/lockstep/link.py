"""The vehicle, and its end of the companion's link, in lockstep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from airl_mav.core.constants import US_PER_S
from airl_mav.faults.model import Fault, link_fails
from airl_mav.lockstep.conductor import Conductor
from firmware_sim.faults.link import FailingEndpoint
from firmware_sim.firmware import BuiltinFlightStack, Firmware, FrameServer
from firmware_sim.mavlink.endpoint import MemoryEndpoint, SharedEndpoint
from firmware_sim.mavlink.link import LinkConfig, onboard_link
from firmware_sim.mavlink.server import MavlinkServer

BOOT_UNIX_US = 1_767_225_600 * US_PER_S
"""Calendar time of simulated time 0: 2026-01-01T00:00Z, whenever that is [µs since 1970]."""

MAVSDK_HZ = {"EXTENDED_SYS_STATE": 1.0}
"""Rates that MAVSDK asks for by itself, at a moment that the wall clock decides [Hz]: here they are
set from the start, and its request changes nothing (`inbound`)."""


def lockstep_link(endpoint: SharedEndpoint) -> LinkConfig:
    """Return the onboard link for a companion that is conducted.

    Answers have sequence numbers of their own: MAVSDK's requests come at any time, and must not
    change the bytes of the streams.
    """
    link = onboard_link(endpoint)
    rates = {**link.rates_hz, **MAVSDK_HZ}
    return replace(link, rates_hz=rates, separate_replies=True)


def conducted_firmware(
    endpoint: MemoryEndpoint,
    camera: FrameServer,
    conductor: Conductor,
    faults: Sequence[Fault] = (),
) -> Firmware:
    """Return the firmware whose companion is conducted, without an episode.

    Args:
        endpoint: The vehicle's end of the companion's link.
        camera: Where frames go.
        conductor: How simulated time passes.
        faults: What will fail; those of the link need a place of their own.
    """
    failing = None
    if link_fails(faults):
        failing = FailingEndpoint(endpoint, conductor.clock, conducted=True)
    link = lockstep_link(endpoint if failing is None else failing)
    server = MavlinkServer([link], boot_unix_us=BOOT_UNIX_US)
    return Firmware(BuiltinFlightStack(server), camera, conductor, failing=failing)
