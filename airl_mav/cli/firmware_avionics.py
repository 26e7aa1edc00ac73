"""Real firmware as asked for on the command line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from airl_mav.cli.firmware_options import FirmwareName, RealFirmwareOptions
from airl_mav.clock import WallClock
from airl_mav.errors import UsageError
from airl_mav.ports import LOOPBACK, Ports
from airl_mav.profiles.vehicle import RealFirmware, VehicleProfile
from firmware_sim.bridges import ardupilot_program, px4_program
from firmware_sim.bridges.ardupilot_program import Links, find_arducopter
from firmware_sim.bridges.avionics import BridgedAvionics, Launcher
from firmware_sim.bridges.launch_ardupilot import ArdupilotLauncher
from firmware_sim.bridges.launch_hitl import HitlLauncher, clients_of
from firmware_sim.bridges.launch_px4 import Px4Launcher
from firmware_sim.bridges.observer import Observer
from firmware_sim.bridges.px4_program import find_px4
from firmware_sim.bridges.router import Router, RouterEnd
from firmware_sim.bridges.workplace import Workplace
from firmware_sim.mavlink.endpoint import Endpoint, UdpEndpoint
from firmware_sim.mavlink.px4_links import Px4Ends


@dataclass(frozen=True)
class Wanted:
    """What is asked of real firmware."""

    options: RealFirmwareOptions
    """How it is started or reached."""
    vehicle: VehicleProfile
    """What it flies."""
    ports: Ports
    """Of the MAVLink links."""
    log: Path | None
    """What it prints goes here; None = a file in its folder."""
    bind_ends: Callable[[], Px4Ends]
    """Binds the vehicle's ends of the links, where they are ours."""


def real_avionics(firmware: FirmwareName, wanted: Wanted) -> BridgedAvionics:
    """Bind the ports of real firmware and return it, not yet started.

    Raises:
        UsageError: A port is taken, the program is not there, or the vehicle's profile lacks what
            this firmware needs.
    """
    launcher, endpoint = _PARTS[firmware](wanted)
    observer = Observer(endpoint, "observer")
    return BridgedAvionics(launcher, observer, wanted.options.firmware_timeout)


def _px4(wanted: Wanted) -> tuple[Launcher, Endpoint]:
    options = wanted.options
    program = None if options.px4_dir is None else find_px4(options.px4_dir)
    table = _table(wanted.vehicle.px4, "px4")
    endpoint = UdpEndpoint(
        (LOOPBACK, px4_program.PAYLOAD_PORT + options.instance),
        (LOOPBACK, px4_program.PAYLOAD_LOCAL_PORT + options.instance),
        local_option="--instance",
        remote_option="--instance",
    )
    workplace = Workplace("px4", options.firmware_dir, wanted.log)
    timeout_s = options.firmware_timeout
    return Px4Launcher(table.motors, program, options.instance, timeout_s, workplace), endpoint


def _ardupilot(wanted: Wanted) -> tuple[Launcher, Endpoint]:
    options, ports = wanted.options, wanted.ports
    where = options.ardupilot_dir
    program = None if where is None else find_arducopter(where)
    table = _table(wanted.vehicle.ardupilot, "ardupilot")
    # Who is started by us can be told any port.
    port = ardupilot_program.OBSERVER_PORT + options.instance if program is None else 0
    endpoint = UdpEndpoint(
        (LOOPBACK, port), None, local_option="--instance", remote_option="--instance"
    )
    links = Links(ports.api_port, ports.gcs_port, endpoint.local[1])
    workplace = Workplace("ardupilot", options.firmware_dir, wanted.log)
    timeout_s = options.firmware_timeout
    launcher = ArdupilotLauncher(
        table.motors, program, options.instance, links, timeout_s, workplace
    )
    return launcher, endpoint


def _hitl(wanted: Wanted) -> tuple[Launcher, Endpoint]:
    options = wanted.options
    table = _table(wanted.vehicle.px4, "px4")
    router = Router(clients_of(wanted.bind_ends()), WallClock())
    try:
        launcher = HitlLauncher(
            table.motors, router, options.serial or "", options.baud, options.firmware_timeout
        )
    except UsageError:
        router.close()
        raise
    return launcher, RouterEnd(router)


def _table(table: RealFirmware | None, name: str) -> RealFirmware:
    if table is None:
        raise UsageError(f"--firmware {name}: the vehicle's profile has no table [{name}]")
    return table


_PARTS: dict[FirmwareName, Callable[[Wanted], tuple[Launcher, Endpoint]]] = {
    "px4": _px4,
    "ardupilot": _ardupilot,
    "px4-hitl": _hitl,
}
