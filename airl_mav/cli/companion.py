"""`airl-companion`: what runs on the drone's onboard computer."""

from __future__ import annotations

import os
import queue
import signal
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console

from airl_mav.atomic import save_arrays
from airl_mav.channel import (
    Abort,
    ChildChannel,
    Ended,
    Failed,
    Fly,
    Progress,
    Ready,
    Resync,
    Shutdown,
)
from airl_mav.cli.common import EXIT_BROKEN, EXIT_USAGE, run_command
from airl_mav.clock import Clock, WallClock
from airl_mav.errors import UsageError
from airl_mav.latency.injection import choose_injection
from airl_mav.latency.samplers import LatencySampler
from airl_mav.policy.registry import load_policy
from airl_mav.profiles.computer import load_computer
from companion.camera import ZmqFrameSource
from companion.link import LinkError, MavsdkLink
from companion.mission import MissionResult, fly_mission
from companion.pilot import PilotSettings
from companion.watchdog import WatchdogSettings


@dataclass(frozen=True)
class CompanionCommand:
    """Fly a policy from take-off to a goal, through MAVSDK."""

    goal: tuple[float, float] = (20.0, 0.0)
    """Goal, north and east of the start, m."""

    policy: str = "greedy"
    """Policy that decides."""

    connect: str = "udpin://127.0.0.1:14540"
    """MAVSDK connection to the flight controller: udpin://HOST:PORT or serial://DEVICE:BAUD."""

    camera: str = "tcp://127.0.0.1:5600"
    """ZeroMQ address of the depth camera."""

    computer: str = "workstation"
    """Computer profile to fly as: a shipped name, or a path to a .toml."""

    workload: str | None = None
    """Workload of the computer profile whose latency t2 is injected. None: nothing is injected."""

    speed: float = 1.0
    """Simulated seconds per wall second of the simulator, > 0; 1 on a real aircraft."""

    seed: int = 1
    """Seed of the injected latency."""

    connect_timeout: float = 30.0
    """How long to wait for the flight controller, s."""

    pilot: tyro.conf.OmitArgPrefixes[PilotSettings] = field(default_factory=PilotSettings)
    """How the policy is flown."""

    watchdog: tyro.conf.OmitArgPrefixes[WatchdogSettings] = field(default_factory=WatchdogSettings)
    """Bounds on silence."""

    log: Path | None = None
    """Write the stamps of every decision to this .npz file. None: no file."""

    control: Literal["stdio"] | None = None
    """stdio: take requests from a harness, JSON lines on standard input. None: stand alone."""


def main() -> None:
    """Entry point of `airl-companion`."""
    command = tyro.cli(CompanionCommand, prog="airl-companion")
    run_command(lambda: serve(command) if command.control else stand_alone(command))


def sampler(command: CompanionCommand, seed: int) -> LatencySampler | None:
    """Return where t2 is drawn from. Raises UsageError for an unknown computer or workload."""
    injection = choose_injection(load_computer(command.computer), command.workload)
    return injection.sampler(np.random.default_rng(seed))


def stand_alone(command: CompanionCommand) -> int:
    """Fly one mission."""
    console = Console()
    clock = WallClock(command.speed)
    stop, abandon = threading.Event(), threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    policy = load_policy(command.policy, command.pilot.hold_s)
    latency = sampler(command, command.seed)
    link = MavsdkLink(command.connect, clock, abandon)
    frames = ZmqFrameSource(command.camera, clock)
    try:
        link.connect(command.connect_timeout)
        result = fly_mission(
            link,
            frames,
            policy,
            command.goal,
            clock,
            stop,
            abandon,
            lambda phase: console.print(f"{clock.time_us() / 1e6:8.2f} s  {phase}"),
            pilot_settings=command.pilot,
            watchdog_settings=command.watchdog,
            latency=latency,
        )
    except LinkError as error:
        console.print(f"error: {error}", style="red", markup=False)
        return EXIT_BROKEN
    finally:
        frames.close()
        link.close()
    if command.log is not None:
        save_arrays(command.log, result.log.columns())
    for note in result.notes:
        console.print(note, style="yellow", markup=False)
    console.print(f"{result.reason}; {len(result.log)} decisions")
    return 0 if result.reason == "goal reached" else EXIT_BROKEN


def serve(command: CompanionCommand) -> int:
    """Fly missions on request of a harness."""
    channel = ChildChannel.on_stdio()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests: queue.Queue[Any] = queue.Queue()
    stop, abandon = threading.Event(), threading.Event()
    clock = WallClock(command.speed)

    def handle(request: Any) -> None:
        if isinstance(request, Fly | Resync) and request.epoch_ns is not None:
            clock.epoch_ns = request.epoch_ns
        if isinstance(request, Abort):
            (stop if request.land else abandon).set()
            stop.set()
        elif isinstance(request, Fly):
            stop.clear()
            abandon.clear()
        if isinstance(request, Fly | Shutdown):
            requests.put(request)

    # Without its harness a companion has no business in the air, whatever it is doing: its
    # setpoints end and the flight controller's offboard-loss failsafe takes over.
    channel.listen(handle, lambda: os._exit(EXIT_BROKEN))
    try:
        policy = load_policy(command.policy, command.pilot.hold_s)
        sampler(command, command.seed)
        link = MavsdkLink(command.connect, clock, abandon)
        frames = ZmqFrameSource(command.camera, clock)
        channel.send(Ready())
    except UsageError as error:
        channel.send(Failed(message=str(error)))
        return EXIT_USAGE
    while not isinstance(request := requests.get(), Shutdown):
        try:
            if not link.connected:
                link.connect(command.connect_timeout)
        except LinkError as error:
            channel.send(Failed(message=str(error)))
            return EXIT_BROKEN
        result = fly_mission(
            link,
            frames,
            policy,
            request.goal,
            clock,
            stop,
            abandon,
            _announce(channel, clock),
            pilot_settings=command.pilot,
            watchdog_settings=command.watchdog,
            latency=sampler(command, request.latency_seed),
        )
        channel.send(_ended(result, request))
    frames.close()
    link.close()
    return 0


def _announce(channel: ChildChannel, clock: Clock) -> Any:
    return lambda phase: channel.send(Progress(phase=phase, time_us=clock.time_us()))


def _ended(result: MissionResult, request: Fly) -> Ended:
    """Save the decision log and return the event that says so."""
    save_arrays(Path(request.record), result.log.columns())
    return Ended(reason=result.reason, notes=result.notes, path=request.record)


if __name__ == "__main__":
    main()
