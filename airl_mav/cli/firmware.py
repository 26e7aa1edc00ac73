"""`airl-firmware`, `airl firmware`: flight controller, vehicle and camera alone, for any client."""

from __future__ import annotations

import signal
import threading
from contextlib import closing
from pathlib import Path
from typing import Literal

from pydantic import Field
from rich.console import Console

from airl_mav.arena.generate import generate
from airl_mav.cli.options import run_command
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import EXIT_BROKEN, FieldError
from airl_mav.core.fields import quantity
from airl_mav.core.ports import LOOPBACK
from airl_mav.lockstep.errors import LockstepError
from airl_mav.lockstep.remote import RemotePlan, Sockets, fly_stage
from airl_mav.lockstep.tokens import LONGEST_REST_US, TokenSettings
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.rehearsal.firmware_process import build_firmware, unix_us
from airl_mav.scenario.model import DEFAULT_ARENA, GREATEST_SEED, Aircraft, Scenario
from airl_mav.scenario.resolve import check_firmware, check_ports
from airl_mav.scenario.resolved import FIRMWARE_TITLES, TRANSPORT_US
from firmware_sim.autopilot.state import Message
from firmware_sim.external.programs import how_to_start
from firmware_sim.flight_controller import FirmwareLostError
from firmware_sim.pacing import Unpaced, WallPacing
from firmware_sim.simulation import EpisodeSetup
from firmware_sim.stand_alone import fly
from firmware_sim.warm_up import warm_up

SPEEDS = 0.0, 100.0
"""Limits of the pace; what a host cannot keep up with is given up and reported."""

LOCKSTEP_SPEEDS = 0.1, 1000.0
"""The same in lockstep; slower, the companion would take the vehicle for gone between two turns."""


class FirmwareOptions(Aircraft):
    """Run the flight controller with its vehicle, until Ctrl-C.

    Examples:
        airl-firmware --arena static-obstacles --seed 3
        airl-firmware --speed max --duration 60
        airl-firmware --lockstep          (with airl-companion --lockstep)
        airl-firmware --firmware px4 --px4-dir ~/PX4-Autopilot
    """

    arena: str = Field(
        default=DEFAULT_ARENA, description="arena profile: a shipped name, or a path to a .toml"
    )
    seed: int = quantity("seed of arena, sensors and wind", "1", ge=0, le=GREATEST_SEED, default=1)
    speed: float | Literal["max"] | None = Field(
        default=None,
        description="simulated seconds per wall second, above 0, at most 100; max: as fast as it"
        " goes, for clients that do not live by the wall clock; by default 1, in lockstep max",
    )
    duration: float | None = quantity(
        "end after this simulated time; by default on Ctrl-C", "s", ge=0, le=1e6, default=None
    )
    firmware_log: Path | None = Field(
        default=None,
        description="with real firmware that is started here: what it prints goes to this file",
    )
    bind: str = Field(default=LOOPBACK, description="IPv4 address that links and camera bind")
    companion_host: str = Field(
        default=LOOPBACK, description="IPv4 address of the companion computer"
    )
    gcs_host: str = Field(default=LOOPBACK, description="IPv4 address of the ground station")
    insecure: bool = Field(
        default=False,
        description="allow addresses that other machines can reach; MAVLink has no authentication"
        " here yet",
    )
    lockstep: bool = Field(
        default=False,
        description="simulated time waits for one companion that passes turns (airl-companion"
        " --lockstep, or any program that keeps to docs/lockstep.md): the same flight every time,"
        " bit by bit; there is no ground station then, and the companion's end ends the flight",
    )
    transport_ms: float = quantity(
        "in lockstep: from a frame's exposure until the companion sees it",
        "ms",
        ge=0,
        le=1000,
        default=TRANSPORT_US / US_PER_MS,
    )
    turn_us: int = quantity(
        "in lockstep: a companion that does not say when it wants its next turn has it this long"
        " after the last, in simulated time",
        "us",
        ge=1,
        le=LONGEST_REST_US,
        default=TokenSettings().turn_us,
    )
    companion_timeout: float = quantity(
        "in lockstep: longest turn of the companion, wall time",
        "s",
        ge=1,
        le=3600,
        default=TokenSettings().patience_s,
    )
    goal_radius_m: float | None = quantity(
        "in lockstep: judge the flight, and tell the companion when it is lost; the goal is reached"
        " closer than this, seen from above; by default nobody judges",
        "m",
        ge=0.2,
        le=50,
        default=None,
    )
    time_limit_s: float = quantity(
        "with a goal radius: longest flight from the start of navigation",
        "s",
        ge=1,
        le=3600,
        default=120.0,
    )
    tlog: Path | None = Field(
        default=None, description="write the MAVLink log of the onboard link to this file"
    )


OPTIONS = FirmwareOptions


def run(options: FirmwareOptions, console: Console | None = None) -> int:
    """Fly whatever the clients ask for, until Ctrl-C; in lockstep until the companion has ended.

    Returns:
        Exit status: 0, or 1 when real firmware or the companion in lockstep was lost.

    Raises:
        UsageError: The input cannot be used.
    """
    console = console or Console(soft_wrap=True)
    _check(options)
    vehicle = load_vehicle(options.vehicle)
    stop = threading.Event()
    try:
        if options.lockstep:
            _fly_in_lockstep(options, vehicle, stop, console)
        else:
            _fly_alone(options, vehicle, stop, console)
    except (FirmwareLostError, LockstepError) as error:
        console.print(f"error: {error}", style="red", markup=False)
        return EXIT_BROKEN
    return 0


def _check(options: FirmwareOptions) -> None:
    """Raise FieldError for what can be seen to be wrong before a port is bound."""
    check_ports(options.ports, any_camera=True)
    speed = options.speed
    shared = Aircraft.model_fields
    level = "lockstep" if options.lockstep else "sitl"
    check_firmware(
        Scenario(
            **{name: getattr(options, name) for name in shared},
            level=level,
            speed=speed if isinstance(speed, float) and 0.01 <= speed <= 1000 else None,
        )
    )
    low, high = LOCKSTEP_SPEEDS if options.lockstep else SPEEDS
    if isinstance(speed, float) and not (low < speed <= high or low == speed > 0.0):
        sign = "<=" if options.lockstep else "<"
        raise FieldError("speed", speed, f"{low:g} {sign} value <= {high:g}, or max")
    hosts = {options.bind, options.companion_host, options.gcs_host}
    if options.firmware in ("px4", "ardupilot") and hosts != {LOOPBACK}:
        raise FieldError(
            "firmware",
            options.firmware,
            "without bind, companion-host and gcs-host; its links are its own, on this machine",
        )
    if options.tlog is not None and not options.tlog.parent.is_dir():
        raise FieldError("tlog", options.tlog, problem=f"no folder {options.tlog.parent}")


def _fly_alone(
    options: FirmwareOptions, vehicle: VehicleProfile, stop: threading.Event, console: Console
) -> None:
    speed = 1.0 if options.speed is None else options.speed
    firmware = build_firmware(
        options,
        vehicle,
        WallPacing(speed) if isinstance(speed, float) else Unpaced(),
        bind=options.bind,
        companion_host=options.companion_host,
        gcs_host=options.gcs_host,
        insecure=options.insecure,
        log=options.firmware_log,
    )
    with closing(firmware):
        _stop_on_signals(stop)
        firmware.on_message = lambda message: _print_text(message, console)
        episode = _episode(options, vehicle)
        warm_up(vehicle)
        if (hint := how_to_start(options, vehicle)) is not None:
            console.print(f"waiting for {hint}", markup=False, highlight=False)
        firmware.load(episode, options.tlog, unix_us())
        _print_addresses(options, firmware.camera_endpoint, episode, console)
        console.print("Ctrl-C ends it.")
        fly(firmware, stop, options.duration, lambda line: console.print(line, markup=False))


def _fly_in_lockstep(
    options: FirmwareOptions, vehicle: VehicleProfile, stop: threading.Event, console: Console
) -> None:
    plan = RemotePlan(
        transport_us=round(options.transport_ms * US_PER_MS),
        tokens=TokenSettings(options.turn_us, options.companion_timeout),
        speed=options.speed if isinstance(options.speed, float) else None,
        goal_radius_m=options.goal_radius_m,
        time_limit_s=options.time_limit_s,
    )
    with closing(
        Sockets.open(options.ports, options.bind, options.companion_host, insecure=options.insecure)
    ) as sockets:
        _stop_on_signals(stop)
        episode = _episode(options, vehicle)
        warm_up(vehicle)
        with closing(sockets.stage(plan, stop.is_set)) as stage:
            stage.firmware.on_message = lambda message: _print_text(message, console)
            started_us = stage.load(episode, options.tlog).time_us
            _print_addresses(options, sockets.camera.endpoint, episode, console)
            console.print("waiting for a companion that passes turns. Ctrl-C ends it.")
            end_us = None
            if options.duration is not None:
                end_us = started_us + int(options.duration * US_PER_S)
            fly_stage(
                stage,
                stop,
                end_us,
                lambda line: console.print(line, markup=False, highlight=False),
            )


def _episode(options: FirmwareOptions, vehicle: VehicleProfile) -> EpisodeSetup:
    spec = load_profile("arenas", options.arena, ArenaSpec)
    width_m = vehicle.body.width_m
    arena = generate(spec, options.seed, name=options.arena, vehicle_width_m=width_m)
    return EpisodeSetup(vehicle, arena, options.seed, options)


def _stop_on_signals(stop: threading.Event) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())


def _print_text(message: Message, console: Console) -> None:
    console.print(f"[{message.severity.name.lower()}] {message.text}", markup=False)


def _print_addresses(
    options: FirmwareOptions, camera: str, episode: EpisodeSetup, console: Console
) -> None:
    """Say where to connect, and where to fly."""
    console.print(f"MAVSDK            udpin://{options.companion_host}:{options.companion_port}")
    if not options.lockstep:
        console.print(f"QGroundControl    UDP port {options.ports.gcs_port} (connects by itself)")
    console.print(f"depth camera      {camera}")
    if options.firmware != "builtin":
        console.print(f"firmware          {FIRMWARE_TITLES[options.firmware]}")
    if episode.arena is not None:
        goal = [float(metres) for metres in episode.arena.goal]
        # In lockstep the last digit counts.
        north, east = (repr(m) if options.lockstep else f"{m:.1f}" for m in goal)
        console.print(f"goal              {north} {east} (north east, m)", highlight=False)


if __name__ == "__main__":
    run_command("airl-firmware", "airl_mav.cli.firmware")
