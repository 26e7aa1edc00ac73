"""Composition of real firmware from its options: launcher, observer and links."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import LOOPBACK, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.scheduling import ask_for_short_slices
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import GREATEST_INSTANCE, Aircraft, FirmwareName
from firmware_sim.external import airframe_check
from firmware_sim.external.ardupilot import ardupilot_program
from firmware_sim.external.ardupilot.ardupilot_program import Links, find_arducopter
from firmware_sim.external.ardupilot.ardupilot_sitl import ArdupilotBridge
from firmware_sim.external.boot_sequence import ExternalFlightStack
from firmware_sim.external.launcher import Launcher
from firmware_sim.external.observer import FirmwareObserver
from firmware_sim.external.process import WorkingFolders
from firmware_sim.external.px4 import px4_program
from firmware_sim.external.px4.board_link import BoardLink
from firmware_sim.external.px4.hitl import HitlBridge
from firmware_sim.external.px4.onboard_link import OnboardLink
from firmware_sim.external.px4.px4_program import check_free, find_px4
from firmware_sim.external.px4.px4_sitl import Px4Bridge
from firmware_sim.external.transport.router import Router
from firmware_sim.mavlink.endpoint import Endpoint, UdpEndpoint
from firmware_sim.mavlink.px4_links import UdpLinks


@dataclass(frozen=True)
class Wanted:
    """Request for real firmware."""

    aircraft: Aircraft
    vehicle: VehicleProfile
    log: Path | None
    """Log file for the firmware's output; None = a file in its folder."""
    bind_ends: Callable[[], UdpLinks]
    """Bind the vehicle's ends of the links, if not bound by the firmware."""


def real_firmware(wanted: Wanted) -> ExternalFlightStack:
    """Bind the ports of real firmware and return it, not yet started. Raises UsageError."""
    launcher, endpoint = _PARTS[wanted.aircraft.firmware](wanted)
    observer = FirmwareObserver(endpoint, "observer", wanted.vehicle.told_origin)
    return ExternalFlightStack(launcher, observer, wanted.aircraft.real.firmware_timeout)


def _px4(wanted: Wanted) -> tuple[Launcher, Endpoint]:
    real = wanted.aircraft.real
    if real.px4_dir is not None:
        # With a taken port, PX4 would start without its links, or not at all, in every flight.
        px4_program.check_free(real.instance)
    return px4_parts(wanted, real.instance, Px4Bridge)


def px4_parts(
    wanted: Wanted, instance: int, bridge: Callable[[int], Px4Bridge]
) -> tuple[Launcher, Endpoint]:
    """Bind the observer's end of PX4's payload link. Return PX4's launcher and this endpoint.

    `instance` shifts the ports; `bridge` opens the simulator interface on a port.
    """
    options = wanted.aircraft.real
    airframe = airframe_check.px4_airframe(wanted.vehicle, airframe_check.SITL_OUTPUT)
    program = None if options.px4_dir is None else find_px4(options.px4_dir)
    endpoint = UdpEndpoint(
        (LOOPBACK, px4_program.PAYLOAD_PORT + instance),
        (LOOPBACK, px4_program.PAYLOAD_LOCAL_PORT + instance),
        local_option="--instance",
        remote_option="--instance",
    )
    launcher = Launcher(
        airframe,
        partial(bridge, px4_program.SIMULATOR_PORT + instance),
        options.firmware_timeout,
        reboots=False,
        program=None if program is None else partial(program.start, instance, airframe.autostart),
        folders=WorkingFolders("px4", options.firmware_dir, wanted.log),
    )
    return launcher, endpoint


def _ardupilot(wanted: Wanted) -> tuple[Launcher, Endpoint]:
    options, ports = wanted.aircraft.real, wanted.aircraft.ports
    instance = options.instance
    airframe = airframe_check.ardupilot_airframe(wanted.vehicle)
    airframe_check.refuse_untold(wanted.vehicle, "ardupilot")
    where = options.ardupilot_dir
    program = None if where is None else find_arducopter(where)
    # A program started here accepts any port.
    port = ardupilot_program.OBSERVER_PORT + instance if program is None else 0
    endpoint = UdpEndpoint(
        (LOOPBACK, port), None, local_option="--instance", remote_option="--instance"
    )
    links = Links(ports.api_port, ports.gcs_port, endpoint.local[1])
    start = ardupilot_program.start
    launcher = Launcher(
        airframe,
        partial(ArdupilotBridge, ardupilot_program.simulator_port(instance)),
        options.firmware_timeout,
        program=None
        if program is None
        else partial(start, program, instance, links, airframe.settings),
        folders=WorkingFolders("ardupilot", options.firmware_dir, wanted.log),
    )
    return launcher, endpoint


def _hitl(wanted: Wanted) -> tuple[Launcher, Endpoint]:
    options = wanted.aircraft.real
    airframe = airframe_check.px4_airframe(wanted.vehicle, airframe_check.HITL_OUTPUT)
    airframe_check.refuse_untold(wanted.vehicle, "px4-hitl")
    router = Router(wanted.bind_ends().by_name(), WallClock())
    try:
        link = BoardLink(router, options.serial or "", options.baud)
    except UsageError:
        router.close()
        raise
    return Launcher(airframe, partial(HitlBridge, link), options.firmware_timeout), router


_PARTS: dict[FirmwareName, Callable[[Wanted], tuple[Launcher, Endpoint]]] = {
    "px4": _px4,
    "ardupilot": _ardupilot,
    "px4-hitl": _hitl,
}


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
