"""PX4 SITL for a companion in lockstep: a PX4 instance and the companion's link.

Only PX4's boot runs by the wall clock. A busy host slows a flight down but never ends it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.scheduling import ask_for_short_slices
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import GREATEST_INSTANCE, Aircraft
from firmware_sim.external.boot_sequence import ExternalFlightStack
from firmware_sim.external.compose import Wanted, px4_parts
from firmware_sim.external.observer import FirmwareObserver
from firmware_sim.external.px4.onboard_link import OnboardLink
from firmware_sim.external.px4.program import check_free, find_px4
from firmware_sim.external.px4.sitl import Px4Bridge
from firmware_sim.mavlink.udp_links import UdpLinks

ANSWER_S = 60.0
"""Timeout of PX4's reply to a sample [wall s, while this process runs]."""


STATE_US = US_PER_S // 5
"""Minimum interval of the true state [µs]. PX4 requests 5 ms, only for its log."""


LOOK_US = US_PER_S // 50
"""Interval at which the observer's link is read [µs]; no message on it is faster."""


@dataclass(frozen=True)
class ConductedPx4:
    """PX4 with its links and functions for a lockstep scheduler."""

    stack: ExternalFlightStack
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
    ask_for_short_slices()
    real = aircraft.real
    wanted = Wanted(aircraft, vehicle, log, _no_ends)
    if real.px4_dir is None:
        return _instance(wanted, real.instance)
    find_px4(real.px4_dir)
    taken: UsageError | None = None
    for instance in range(real.instance, GREATEST_INSTANCE + 1):
        # Bind first, so that two concurrent processes do not take the same instance.
        try:
            found = _instance(wanted, instance)
        except UsageError as error:
            taken = error
            continue
        try:
            check_free(instance)
        except UsageError as error:
            taken = error
            found.stack.close()
            continue
        return found
    raise UsageError(
        f"no instance of PX4's from {real.instance} to {GREATEST_INSTANCE} is free (other "
        "simulators?): choose another with --instance, or fewer workers"
    ) from taken


def _instance(wanted: Wanted, instance: int) -> ConductedPx4:
    newest: list[Px4Bridge] = []

    def bridge(port: int) -> Px4Bridge:
        newest[:] = [Px4Bridge(port, answer_s=ANSWER_S, least_state_us=STATE_US)]
        return newest[0]

    def alive() -> None:
        for each in newest:
            each.alive()

    def settle() -> None:
        for each in newest:
            each.settle()

    launcher, endpoint = px4_parts(wanted, instance, bridge)
    try:
        link = OnboardLink(instance, alive)
    except UsageError:
        endpoint.close()
        launcher.close()
        raise
    stack = ExternalFlightStack(
        launcher,
        FirmwareObserver(endpoint, "observer", wanted.vehicle.told_origin),
        wanted.aircraft.real.firmware_timeout,
        on_close=link.close,
        look_every_us=LOOK_US,
    )
    return ConductedPx4(stack, link, settle, instance)


def _no_ends() -> UdpLinks:
    raise RuntimeError("PX4 SITL binds its own ends of its links")
