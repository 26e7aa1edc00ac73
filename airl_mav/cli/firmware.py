"""`airl-firmware`: flight controller, vehicle and camera alone, for any client."""

from __future__ import annotations

import queue
import signal
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console

from airl_mav.arena.generate import generate
from airl_mav.cli import firmware_lockstep
from airl_mav.cli.common import (
    EXIT_BROKEN,
    EXIT_USAGE,
    GREATEST_SEED,
    check_ports,
    check_range,
    check_wind,
    run_command,
)
from airl_mav.cli.firmware_avionics import Wanted, real_avionics
from airl_mav.cli.firmware_lockstep import LockstepBench, LockstepOptions, Sockets, remote_plan
from airl_mav.cli.firmware_options import (
    TITLES,
    FirmwareName,
    RealFirmwareOptions,
    api_port,
    check_firmware,
    how_to_start,
)
from airl_mav.cli.firmware_service import Bench, Service, WallBench, unix_us
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.ports import LOOPBACK, Ports
from airl_mav.lockstep.errors import LockstepError
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.rehearsal.channel import ChildChannel, Failed, LoadEpisode, Ready, Shutdown
from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.autopilot.filters import FilterName
from firmware_sim.firmware import BuiltinFlightStack, Firmware, FlightStack
from firmware_sim.flight_controller import FirmwareLostError
from firmware_sim.mavlink.udp_links import UdpLinks, bind_udp_links, udp_server
from firmware_sim.pacing import Pacing, Unpaced, WallPacing
from firmware_sim.plant.camera_server import CameraServer
from firmware_sim.plant.wind import WindSettings
from firmware_sim.simulation import EpisodeSetup
from firmware_sim.warm_up import warm_up

MAX_SPEED = 100.0
"""Greatest --speed; what a host cannot keep up with is given up and reported."""


@dataclass(frozen=True)
class FirmwareCommand:
    """Run the flight controller with its vehicle, until Ctrl-C."""

    vehicle: str = "quad"
    """Vehicle profile: a shipped name, or a path to a .toml."""

    arena: str = "static-obstacles"
    """Arena profile: a shipped name, or a path to a .toml."""

    seed: int = 1
    """Seed of arena, sensors and wind."""

    speed: float | Literal["max"] | None = None
    """Simulated seconds per wall second, > 0; max: as fast as it goes, for clients that do not
    live by the wall clock. None: 1, or with --lockstep max."""

    duration: float | None = None
    """End after so much simulated time, s. None: on Ctrl-C."""

    wind: WindSettings = field(default_factory=WindSettings)
    """Wind; calm by default."""

    estimator: FilterName = "kernel"
    """Filter of the estimator: compiled, or filterpy's, the reference, some twenty times slower."""

    firmware: FirmwareName = "builtin"
    """What flies: the built-in autopilot, or real firmware on this vehicle and its sensors; see
    docs/real-firmware.md."""

    real: tyro.conf.OmitArgPrefixes[RealFirmwareOptions] = field(
        default_factory=RealFirmwareOptions
    )
    """Real firmware."""

    firmware_log: Path | None = None
    """With real firmware that is started here: what it prints goes to this file. None: to one in
    its folder."""

    ports: tyro.conf.OmitArgPrefixes[Ports] = field(default_factory=Ports)
    """Ports."""

    bind: str = LOOPBACK
    """IPv4 address that the links and the camera bind."""

    companion_host: str = LOOPBACK
    """IPv4 address of the companion computer: MAVLink goes there unasked."""

    gcs_host: str = LOOPBACK
    """IPv4 address of the ground station."""

    insecure: bool = False
    """Allow addresses that other machines can reach. MAVLink has no authentication here yet."""

    lockstep: bool = False
    """Simulated time waits for one companion that passes turns (airl-companion --lockstep, or any
    program that keeps to docs/lockstep.md): the same flight every time, bit by bit. There is no
    ground station then, and the end of the companion ends the flight."""

    turns: tyro.conf.OmitArgPrefixes[LockstepOptions] = field(default_factory=LockstepOptions)
    """Lockstep."""

    tlog: Path | None = None
    """Write the MAVLink log of the onboard link to this file. None: no log."""

    control: Literal["stdio"] | None = None
    """stdio: take requests from a harness, JSON lines on standard input. None: stand alone."""


def check(command: FirmwareCommand) -> None:
    """Check what can be wrong before a port is bound. Raises UsageError."""
    check_ports(command.ports, free=True)
    check_range("--seed", command.seed, 0, GREATEST_SEED)
    hosts = {command.bind, command.companion_host, command.gcs_host}
    if command.firmware in ("px4", "ardupilot") and hosts != {LOOPBACK}:
        raise UsageError(
            f"--firmware {command.firmware} with --bind, --companion-host or --gcs-host: accepted: "
            "without; its links are its own, on this machine"
        )
    if command.duration is not None:
        check_range("--duration", command.duration, 0.0, 1e6)
    check_wind(command.wind)
    check_firmware(command)
    if command.tlog is not None and not command.tlog.parent.is_dir():
        raise UsageError(f"--tlog {command.tlog}: no folder {command.tlog.parent}")


def build(command: FirmwareCommand) -> Firmware:
    """Bind all ports and return the firmware without an episode.

    Raises:
        UsageError: An option is out of range, a port taken, an address unusable.
    """
    check(command)
    pacing = pacing_of(1.0 if command.speed is None else command.speed)
    flight_stack = _flight_stack(command)
    try:
        camera = CameraServer(f"tcp://{command.bind}:{command.ports.camera_port or '*'}")
    except UsageError:
        flight_stack.close()
        raise
    # Stand alone it flies for days, and nobody collects what was recorded.
    return Firmware(flight_stack, camera, pacing, recording=command.control is not None)


def _flight_stack(command: FirmwareCommand) -> FlightStack:
    """Bind the MAVLink ports and return what flies. Raises UsageError as `build`."""
    if command.firmware != "builtin":
        wanted = Wanted(
            command.real,
            load_vehicle(command.vehicle),
            command.ports,
            command.firmware_log,
            lambda: _ends(command),
        )
        return real_avionics(command.firmware, wanted)
    return BuiltinFlightStack(udp_server(_ends(command), unix_us()))


def _ends(command: FirmwareCommand) -> UdpLinks:
    """Bind the ports of the onboard and the ground station's link. Raises UsageError."""
    ports = command.ports
    return bind_udp_links(
        bind=command.bind,
        api_remote=(command.companion_host, ports.api_port),
        api_local_port=ports.api_local_port,
        gcs_remote=(command.gcs_host, ports.gcs_port),
        gcs_local_port=ports.gcs_local_port,
        insecure=command.insecure,
    )


def open_sockets(command: FirmwareCommand) -> Sockets:
    """Bind the ports of a flight in lockstep. Raises UsageError as `build`."""
    check(command)
    return Sockets.open(
        command.ports, command.bind, command.companion_host, insecure=command.insecure
    )


def pacing_of(speed: float | Literal["max"]) -> Pacing:
    """Return the pacing of a --speed. Raises UsageError when it is not positive."""
    if isinstance(speed, str):
        return Unpaced()
    if not 0.0 < speed <= MAX_SPEED:
        raise UsageError(f"--speed {speed:g}: accepted: 0 < value <= {MAX_SPEED:g}, or max")
    return WallPacing(speed)


def setup(
    command: FirmwareCommand, vehicle: VehicleProfile, arena: str, arena_seed: int, seed: int
) -> EpisodeSetup:
    """Return the episode of an arena and its seeds. Raises UsageError for a bad profile."""
    spec = load_profile("arenas", arena, ArenaSpec)
    concrete = generate(spec, arena_seed, name=arena, vehicle_width_m=vehicle.body.width_m)
    return EpisodeSetup(vehicle, concrete, seed, command.wind, command.estimator)


def main() -> None:
    """Entry point of `airl-firmware`."""
    command = tyro.cli(FirmwareCommand, prog="airl-firmware")
    alone = lockstep if command.lockstep else stand_alone
    run_command(lambda: serve(command) if command.control else alone(command))


def stand_alone(command: FirmwareCommand) -> int:
    """Fly whatever the clients ask for, until Ctrl-C."""
    console = Console()
    vehicle = load_vehicle(command.vehicle)
    firmware = build(command)
    stop = _stopped_by_signals()
    firmware.on_message = _printer(console)
    try:
        episode = setup(command, vehicle, command.arena, command.seed, command.seed)
        warm_up(vehicle)
        hint = how_to_start(command, vehicle)
        if hint is not None:
            console.print(f"waiting for {hint}", soft_wrap=True, markup=False, highlight=False)
        firmware.load(episode, command.tlog, unix_us())
        _print_addresses(command, firmware.camera_endpoint, episode, console)
        console.print("Ctrl-C ends it.")
        fly(firmware, stop, command.duration, console)
    except FirmwareLostError as error:
        console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
        return EXIT_BROKEN
    finally:
        firmware.close()
    return 0


def fly(
    firmware: Firmware, stop: threading.Event, duration_s: float | None, console: Console
) -> None:
    """Run ticks until told to stop, or for a duration of simulated time [s]; say how it went."""
    start_us, stopwatch = firmware.clock.time_us(), WallClock()
    end_us = None if duration_s is None else start_us + int(duration_s * US_PER_S)
    while not stop.is_set() and (end_us is None or firmware.clock.time_us() < end_us):
        firmware.step()
    flown_s = (firmware.clock.time_us() - start_us) / US_PER_S
    wall_s = max(stopwatch.time_us(), 1) / US_PER_S
    console.print(
        f"{flown_s:.1f} s simulated in {wall_s:.1f} s: {flown_s / wall_s:.2f} x real time"
    )
    if firmware.slipped_us:
        given_up_s = firmware.slipped_us / US_PER_S
        console.print(f"{given_up_s:.2f} s given up: this host could not keep up", style="yellow")
    for name, link in firmware.flight_stack.counters().items():
        console.print(
            f"{name:<8} received {link.rx}, malformed {link.malformed}, ignored {link.ignored}, "
            f"sent {link.tx}, not sent {link.send_errors}"
        )


def lockstep(command: FirmwareCommand) -> int:
    """Fly with one companion that passes turns, until it has ended."""
    console = Console(soft_wrap=True)
    vehicle = load_vehicle(command.vehicle)
    plan = remote_plan(command.turns, command.speed)
    with closing(open_sockets(command)) as sockets:
        stop = _stopped_by_signals()
        episode = setup(command, vehicle, command.arena, command.seed, command.seed)
        warm_up(vehicle)
        with closing(sockets.stage(plan, stop.is_set)) as stage:
            stage.firmware.on_message = _printer(console)
            started_us = stage.load(episode, command.tlog).time_us
            _print_addresses(command, sockets.camera.endpoint, episode, console)
            console.print("waiting for a companion that passes turns. Ctrl-C ends it.")
            end_us = None
            if command.duration is not None:
                end_us = started_us + int(command.duration * US_PER_S)
            try:
                firmware_lockstep.fly(stage, stop, end_us, console)
            except LockstepError as error:
                console.print(f"error: {error}", style="red", markup=False)
                return EXIT_BROKEN
    return 0


def _stopped_by_signals() -> threading.Event:
    """Return an event that Ctrl-C sets."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop


def _printer(console: Console) -> Callable[[Message], None]:
    """Return what prints the autopilot's texts."""
    return lambda m: console.print(f"[{m.severity.name.lower()}] {m.text}", markup=False)


def _print_addresses(
    command: FirmwareCommand, camera: str, episode: EpisodeSetup, console: Console
) -> None:
    """Say where to connect, and where to fly."""
    port = api_port(command.firmware, command.real, command.ports)
    console.print(f"MAVSDK            udpin://{command.companion_host}:{port}")
    if not command.lockstep:
        console.print(f"QGroundControl    UDP port {command.ports.gcs_port} (connects by itself)")
    console.print(f"depth camera      {camera}")
    if command.firmware != "builtin":
        console.print(f"firmware          {TITLES[command.firmware]}")
    if episode.arena is not None:
        goal = [float(metres) for metres in episode.arena.goal]
        # In lockstep the last digit counts.
        north, east = (repr(m) if command.lockstep else f"{m:.1f}" for m in goal)
        console.print(f"goal              {north} {east} (north east, m)", highlight=False)


def serve(command: FirmwareCommand) -> int:
    """Fly episodes on request of a harness."""
    channel = ChildChannel.on_stdio()
    # The harness decides when to end, also on Ctrl-C: it closes the pipe.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests: queue.Queue[Any] = queue.Queue()
    channel.listen(requests.put, lambda: requests.put(Shutdown()))

    def episode(request: LoadEpisode) -> EpisodeSetup:
        return setup(command, vehicle, request.arena, request.arena_seed, request.seed)

    try:
        vehicle = load_vehicle(command.vehicle)
        # A request while the companion is waited for: the harness has given it up.
        bench = _bench(command, broken_off=lambda: not requests.empty())
        with closing(bench):
            warm_up(vehicle)
            channel.send(Ready(details={"camera": bench.camera_endpoint}))
            Service(bench, channel, episode).run(requests)
    except (UsageError, LockstepError, FirmwareLostError) as error:
        usage = isinstance(error, UsageError)
        channel.send(Failed(message=str(error), usage=usage))
        return EXIT_USAGE if usage else EXIT_BROKEN
    return 0


def _bench(command: FirmwareCommand, *, broken_off: Callable[[], bool]) -> Bench:
    """Bind all ports and return what flies. Raises UsageError as `build`."""
    if not command.lockstep:
        return WallBench(build(command))
    plan = remote_plan(command.turns, command.speed)
    return LockstepBench(open_sockets(command), plan, broken_off)


if __name__ == "__main__":
    main()
