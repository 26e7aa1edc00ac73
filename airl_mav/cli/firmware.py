"""`airl-firmware`: flight controller, vehicle and camera alone, for any client."""

from __future__ import annotations

import contextlib
import queue
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.channel import (
    ChildChannel,
    Failed,
    FinishEpisode,
    Loaded,
    LoadEpisode,
    Ready,
    Saved,
    Shutdown,
    State,
    Text,
)
from airl_mav.cli.common import (
    EXIT_USAGE,
    GREATEST_SEED,
    check_ports,
    check_range,
    check_wind,
    run_command,
)
from airl_mav.clock import WallClock, utc_now
from airl_mav.constants import US_PER_S
from airl_mav.errors import UsageError
from airl_mav.frames import quat_yaw
from airl_mav.ports import LOOPBACK, Ports
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from firmware_sim.autopilot.commander import Flight, Phase
from firmware_sim.autopilot.state import Message, Mode
from firmware_sim.firmware import Firmware
from firmware_sim.mavlink.px4_links import px4_server
from firmware_sim.pacing import Pacing, Unpaced, WallPacing
from firmware_sim.plant.camera_server import CameraServer
from firmware_sim.plant.plant import Collision
from firmware_sim.plant.wind import WindSettings
from firmware_sim.plant.world import FLOOR
from firmware_sim.simulation import EpisodeSetup, Simulation
from firmware_sim.warm_up import warm_up

MAX_SPEED = 100.0
"""Greatest --speed; what a host cannot keep up with is given up and reported."""

TOUCHDOWN_M_S = 2.0
"""A slower touch of the floor is a landing: PX4 comes down with 0.7 to 1.5 m/s [m/s]."""

STATE_EVERY = 10
"""The harness hears the true state every so many ticks: 25 Hz."""


@dataclass(frozen=True)
class FirmwareCommand:
    """Run the flight controller with its vehicle, until Ctrl-C."""

    vehicle: str = "quad"
    """Vehicle profile: a shipped name, or a path to a .toml."""

    arena: str = "static-obstacles"
    """Arena profile: a shipped name, or a path to a .toml."""

    seed: int = 1
    """Seed of arena, sensors and wind."""

    speed: float | Literal["max"] = 1.0
    """Simulated seconds per wall second, > 0; max: as fast as it goes, for clients that do not
    live by the wall clock."""

    duration: float | None = None
    """End after so much simulated time, s. None: on Ctrl-C."""

    wind: WindSettings = field(default_factory=WindSettings)
    """Wind; calm by default."""

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

    tlog: Path | None = None
    """Write the MAVLink log of the onboard link to this file. None: no log."""

    control: Literal["stdio"] | None = None
    """stdio: take requests from a harness, JSON lines on standard input. None: stand alone."""


def build(command: FirmwareCommand) -> Firmware:
    """Bind all ports and return the firmware without an episode.

    Raises:
        UsageError: An option is out of range, a port taken, an address unusable.
    """
    check_ports(command.ports, free=True)
    check_range("--seed", command.seed, 0, GREATEST_SEED)
    if command.duration is not None:
        check_range("--duration", command.duration, 0.0, 1e6)
    check_wind(command.wind)
    if command.tlog is not None and not command.tlog.parent.is_dir():
        raise UsageError(f"--tlog {command.tlog}: no folder {command.tlog.parent}")
    pacing = pacing_of(command.speed)
    ports = command.ports
    server = px4_server(
        bind=command.bind,
        api_remote=(command.companion_host, ports.api_port),
        api_local_port=ports.api_local_port,
        gcs_remote=(command.gcs_host, ports.gcs_port),
        gcs_local_port=ports.gcs_local_port,
        insecure=command.insecure,
        boot_unix_us=unix_us(),
    )
    try:
        camera = CameraServer(f"tcp://{command.bind}:{ports.camera_port or '*'}")
    except UsageError:
        server.close()
        raise
    return Firmware(server, camera, pacing)


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
    return EpisodeSetup(vehicle, concrete, seed, command.wind)


def unix_us() -> int:
    """Return the calendar time [µs since 1970], for log headers."""
    return int(utc_now().timestamp() * US_PER_S)


def main() -> None:
    """Entry point of `airl-firmware`."""
    command = tyro.cli(FirmwareCommand, prog="airl-firmware")
    run_command(lambda: serve(command) if command.control else stand_alone(command))


def stand_alone(command: FirmwareCommand) -> int:
    """Fly whatever the clients ask for, until Ctrl-C."""
    console = Console()
    vehicle = load_vehicle(command.vehicle)
    firmware = build(command)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    firmware.on_message = lambda m: console.print(
        f"[{m.severity.name.lower()}] {m.text}", markup=False
    )
    try:
        episode = setup(command, vehicle, command.arena, command.seed, command.seed)
        warm_up(vehicle)
        firmware.load(episode, command.tlog, unix_us())
        arena: Arena | None = episode.arena
        console.print(
            f"MAVSDK            udpin://{command.companion_host}:{command.ports.api_port}"
        )
        console.print(f"QGroundControl    UDP port {command.ports.gcs_port} (connects by itself)")
        console.print(f"depth camera      {firmware.camera_endpoint}")
        if arena is not None:
            console.print(
                f"goal              {arena.goal[0]:.1f} {arena.goal[1]:.1f} (north east, m)"
            )
        console.print("Ctrl-C ends it.")
        fly(firmware, stop, command.duration, console)
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
    for name, link in firmware.server.counters().items():
        console.print(
            f"{name:<8} received {link.rx}, malformed {link.malformed}, ignored {link.ignored}, "
            f"sent {link.tx}, not sent {link.send_errors}"
        )


def serve(command: FirmwareCommand) -> int:
    """Fly episodes on request of a harness."""
    channel = ChildChannel.on_stdio()
    # The harness decides when to end, also on Ctrl-C: it closes the pipe.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests: queue.Queue[Any] = queue.Queue()
    channel.listen(requests.put, lambda: requests.put(Shutdown()))
    try:
        vehicle = load_vehicle(command.vehicle)
        firmware = build(command)
        warm_up(vehicle)
    except UsageError as error:
        channel.send(Failed(message=str(error)))
        return EXIT_USAGE
    service = _Service(command, vehicle, firmware, channel)
    channel.send(Ready(details={"camera": firmware.camera_endpoint}))
    try:
        while service.handle_all(requests):
            firmware.step()
    except UsageError as error:
        channel.send(Failed(message=str(error)))
        return EXIT_USAGE
    finally:
        firmware.close()
    return 0


def is_crash(hit: Collision, flight: Flight) -> bool:
    """Return whether a contact ends a flight: all do but what happens on the ground.

    On the way up and down that includes a gentle touch of the floor, in the modes that fly there.
    """
    if hit.what != FLOOR:
        return True
    gentle = flight.mode not in (Mode.OFFBOARD, Mode.HOLD) and hit.speed_m_s < TOUCHDOWN_M_S
    return flight.phase is Phase.AIR and not gentle


class _Service:
    """Requests of the harness on a firmware."""

    def __init__(
        self,
        command: FirmwareCommand,
        vehicle: VehicleProfile,
        firmware: Firmware,
        channel: ChildChannel,
    ) -> None:
        self._command = command
        self._vehicle = vehicle
        self._firmware = firmware
        self._channel = channel
        self._episode = -1
        self._record = Path()
        self._ticks = 0
        self._hits = 0
        """Contacts looked at so far."""
        self._crash: str | None = None
        """The first thing hit in flight."""
        self._handlers: dict[type, Callable[[Any], None]] = {
            LoadEpisode: self._load,
            FinishEpisode: self._finish,
        }
        firmware.on_tick = self._report
        firmware.on_message = self._tell

    def handle_all(self, requests: queue.Queue[Any]) -> bool:
        """Handle what has arrived; False when it is time to end."""
        with contextlib.suppress(queue.Empty):
            while True:
                request = requests.get_nowait()
                if isinstance(request, Shutdown):
                    return False
                self._handlers[type(request)](request)
        return True

    def _load(self, request: LoadEpisode) -> None:
        command = self._command
        episode = setup(command, self._vehicle, request.arena, request.arena_seed, request.seed)
        tlog = Path(request.tlog) if request.tlog else None
        loaded = self._firmware.load(episode, tlog, unix_us())
        self._episode, self._record = request.episode, Path(request.record)
        self._hits, self._crash = 0, None
        goal = episode.arena.goal if episode.arena is not None else np.zeros(2)
        self._channel.send(
            Loaded(
                episode=request.episode,
                time_us=loaded.time_us,
                epoch_ns=loaded.epoch_ns,
                slipped_us=self._firmware.slipped_us,
                goal=(float(goal[0]), float(goal[1])),
            )
        )

    def _finish(self, _: FinishEpisode) -> None:
        self._firmware.save(self._record)
        self._channel.send(Saved(path=str(self._record)))
        self._firmware.discard()

    def _report(self, simulation: Simulation) -> None:
        self._ticks += 1
        truth, flight = simulation.truth, simulation.autopilot.flight
        hits = simulation.plant.collisions
        crashes = [hit.what for hit in hits[self._hits :] if is_crash(hit, flight)]
        self._hits = len(hits)
        if crashes and self._crash is None:
            self._crash = crashes[0]
        elif self._ticks % STATE_EVERY:
            return
        x, y, z = (float(c) for c in truth.position)
        self._channel.send(
            State(
                time_us=truth.time_us,
                position=(x, y, z),
                speed_m_s=float(np.linalg.norm(truth.velocity)),
                yaw=quat_yaw(truth.quaternion),
                battery=truth.battery_remaining,
                collision=self._crash,
                mode=flight.mode.name.lower(),
                armed=flight.phase >= Phase.GROUND,
                landed=flight.phase < Phase.AIR,
                slipped_us=self._firmware.slipped_us,
            )
        )

    def _tell(self, message: Message) -> None:
        simulation = self._firmware.simulation
        time_us = simulation.time_us if simulation is not None else 0
        self._channel.send(Text(time_us=time_us, severity=int(message.severity), text=message.text))


if __name__ == "__main__":
    main()
