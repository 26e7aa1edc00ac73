"""`airl-companion`: what runs on the drone's onboard computer."""

from __future__ import annotations

import os
import queue
import signal
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
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
    Shutdown,
)
from airl_mav.cli.common import (
    EXIT_BROKEN,
    EXIT_INTERRUPTED,
    EXIT_USAGE,
    GREATEST_PORT,
    GREATEST_SEED,
    check_range,
    run_command,
)
from airl_mav.clock import Clock, WallClock
from airl_mav.errors import UsageError
from airl_mav.latency.injection import Injection, choose_injection
from airl_mav.latency.samplers import LatencySampler
from airl_mav.policy.actions import Policy
from airl_mav.policy.learned import LearnedPolicy
from airl_mav.policy.registry import DEFAULT_POLICY, PolicyInfo, find_policy, load_policy
from airl_mav.policy.runtime import RuntimeName
from airl_mav.profiles.computer import load_computer
from companion.camera import FrameSource, ZmqFrameSource
from companion.link import LinkError, MavsdkLink
from companion.mission import MissionResult, first_lens, fly_mission
from companion.pilot import PilotSettings
from companion.watchdog import WatchdogSettings

GREATEST_THREADS = 64

CHANCE_STREAM = 1
"""Second word of the seed of a policy's random actions: not the numbers that draw the latency."""


@dataclass(frozen=True)
class PilotOptions:
    """How the policy is flown; what is left out is as the policy's card says."""

    hold_s: float | None = None
    """t3: how long an action is held before the next observation, s. None: that of the policy's
    card, or 0.5."""

    goal_radius_m: float | None = None
    """The goal is reached closer than this, seen from above, m. None: that of the policy's card,
    or 2."""

    altitude_m: float | None = None
    """Height above the start that is held, m. None: that of the policy's card, or 2.5."""

    max_speed_m_s: float | None = None
    """Horizontal speed limit of all actions, m/s. None: the fastest action of the policy's card,
    or 5."""


@dataclass(frozen=True)
class CompanionCommand:
    """Fly a policy from take-off to a goal, through MAVSDK."""

    goal: tuple[float, float] = (20.0, 0.0)
    """Goal, north and east of the start, m."""

    policy: str = DEFAULT_POLICY
    """Policy that decides: a name, or a path to a folder with policy.onnx and card.json."""

    runtime: RuntimeName = "onnx"
    """What runs a learned policy; torch needs its policy.pt2."""

    threads: int = 1
    """Threads of one inference."""

    connect: str = "udpin://127.0.0.1:14540"
    """MAVSDK connection to the flight controller: udpin://HOST:PORT or serial://DEVICE:BAUD."""

    camera: str = "tcp://127.0.0.1:5600"
    """ZeroMQ address of the depth camera."""

    computer: str = "workstation"
    """Computer profile to fly as: a shipped name, or a path to a .toml."""

    workload: str | None = None
    """Workload of the computer profile whose latency t2 is injected; estimate: scaled to this
    policy. None: nothing is injected."""

    speed: float = 1.0
    """Simulated seconds per wall second of the simulator, > 0; 1 on a real aircraft."""

    seed: int = 1
    """Seed of the injected latency, and of random actions if the policy's card has any."""

    connect_timeout: float = 30.0
    """How long to wait for the flight controller, s."""

    pilot: tyro.conf.OmitArgPrefixes[PilotOptions] = field(default_factory=PilotOptions)
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


def check(command: CompanionCommand) -> PilotSettings:
    """Check everything that can be wrong before a connection is opened.

    Returns:
        How the policy will be flown.

    Raises:
        UsageError: Names the option, its value and what is accepted.
    """
    check_range("--speed", command.speed, 0.1, 100.0)
    check_range("--seed", command.seed, 0, GREATEST_SEED)
    check_range("--connect-timeout", command.connect_timeout, 0.1, 3600.0)
    for metres in command.goal:
        check_range("--goal", metres, -10_000.0, 10_000.0)
    check_range("--threads", command.threads, 1, GREATEST_THREADS)
    pilot = pilot_settings(command.pilot, find_policy(command.policy))
    check_range("--goal-radius-m", pilot.goal_radius_m, 0.1, 50.0)
    check_range("--altitude-m", pilot.altitude_m, 0.5, 100.0)
    check_range("--max-speed-m-s", pilot.max_speed_m_s, 0.1, 30.0)
    check_holding("--hold-s", pilot.hold_s, command.watchdog)
    if command.log is not None and not command.log.parent.is_dir():
        raise UsageError(f"--log {command.log}: no folder {command.log.parent}")
    sampler(command, command.seed)
    return pilot


def pilot_settings(options: PilotOptions, policy: PolicyInfo) -> PilotSettings:
    """Return how a policy is flown: as asked, else as its card says, else by default."""
    card = policy.card
    known = {}
    if card is not None:
        known = {
            "hold_s": card.hold_s,
            "goal_radius_m": card.goal_radius_m,
            "altitude_m": card.altitude_m,
            "max_speed_m_s": card.actions.max_speed_m_s,
        }
    asked = {name: value for name, value in asdict(options).items() if value is not None}
    return PilotSettings(**(known | asked))


def watchdog_settings(command: CompanionCommand) -> WatchdogSettings:
    """Return the bounds on silence: as asked, with what the policy's card says of hovering."""
    hover_s = hover_after_s(command.watchdog, find_policy(command.policy))
    return replace(command.watchdog, hover_after_s=hover_s)


def hover_after_s(asked: WatchdogSettings, policy: PolicyInfo) -> float | None:
    """Return when an action that nothing has followed is stopped: as asked, else as on the card."""
    if asked.hover_after_s is not None or policy.card is None:
        return asked.hover_after_s
    return policy.card.hover_after_s


def check_holding(option: str, hold_s: float, watchdog: WatchdogSettings) -> None:
    """Check the hold time and the watchdog's bounds against each other. Raises UsageError."""
    check_range(option, hold_s, 0.0, 10.0)
    check_range("--decision-timeout-s", watchdog.decision_timeout_s, 0.1, 60.0)
    check_range("--leave-after-s", watchdog.leave_after_s, 0.1, 60.0)
    if watchdog.hover_after_s is not None:
        check_range("--hover-after-s", watchdog.hover_after_s, 0.0, 60.0)
    if watchdog.decision_timeout_s <= hold_s:
        raise UsageError(
            f"--decision-timeout-s {watchdog.decision_timeout_s:g}: accepted: more than "
            f"{option} {hold_s:g}, or every decision is overdue"
        )


@contextmanager
def opened(
    command: CompanionCommand, clock: Clock, abandon: threading.Event
) -> Iterator[tuple[MavsdkLink, ZmqFrameSource]]:
    """Open link and camera for a while. Raises UsageError for an address that is none."""
    with (
        closing(open_camera(command.camera, clock)) as frames,
        closing(MavsdkLink(command.connect, clock, abandon)) as link,
    ):
        yield link, frames


def open_camera(endpoint: str, clock: Clock) -> ZmqFrameSource:
    """Connect to the camera. Raises UsageError for an address that is none."""
    port = endpoint.rpartition(":")[2]
    # libzmq would cut the number to 16 bits without a word.
    if endpoint.startswith("tcp:") and not (port.isdecimal() and 1 <= int(port) <= GREATEST_PORT):
        raise UsageError(f"--camera {endpoint}: accepted: tcp://HOST:PORT, port 1..{GREATEST_PORT}")
    try:
        return ZmqFrameSource(endpoint, clock)
    except ValueError as error:
        raise UsageError(f"--camera: {error}") from None


def sampler(command: CompanionCommand, seed: int) -> LatencySampler | None:
    """Return where t2 is drawn from. Raises UsageError for an unknown computer or workload."""
    return injection(command).sampler(np.random.default_rng(seed))


def injection(command: CompanionCommand) -> Injection:
    """Return the latency to fly with. Raises UsageError for an unknown computer or workload."""
    policy = find_policy(command.policy)
    return choose_injection(
        load_computer(command.computer),
        command.workload,
        # Alone it runs on the computer that it flies on: what was measured there is no addition.
        policy_sha256=policy.sha256 if command.control else None,
        macs=policy.macs,
    )


def load(command: CompanionCommand, pilot: PilotSettings) -> Policy:
    """Return the policy, ready to decide. Raises UsageError when it cannot be run as asked."""
    return load_policy(
        command.policy,
        pilot.hold_s,
        runtime=command.runtime,
        threads=command.threads,
        rng=_chance(command.seed),
    )


def check_camera(policy: Policy, frames: FrameSource, stop: threading.Event) -> None:
    """Look at the camera before take-off. Raises UsageError when the policy cannot use it."""
    if isinstance(policy, LearnedPolicy):
        lens = first_lens(frames, stop)
        if lens is not None and (reason := policy.refuses(lens)) is not None:
            raise UsageError(f"--policy {policy.card.name}: {reason}")


def _chance(seed: int) -> np.random.Generator:
    return np.random.default_rng((seed, CHANCE_STREAM))


def stand_alone(command: CompanionCommand) -> int:
    """Fly one mission."""
    pilot = check(command)
    console = Console()
    clock = WallClock(command.speed)
    stop, abandon = threading.Event(), threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    policy = load(command, pilot)
    bounds = watchdog_settings(command)
    latency = sampler(command, command.seed)
    try:
        with opened(command, clock, abandon) as (link, frames):
            console.print(f"waiting for a flight controller on {command.connect}", markup=False)
            link.connect(command.connect_timeout, stop)
            check_camera(policy, frames, stop)
            result = fly_mission(
                link,
                frames,
                policy,
                command.goal,
                clock,
                stop,
                abandon,
                lambda phase: console.print(f"{clock.time_us() / 1e6:8.2f} s  {phase}"),
                pilot_settings=pilot,
                watchdog_settings=bounds,
                latency=latency,
            )
    except LinkError as error:
        console.print(f"error: {error}", style="red", markup=False)
        return EXIT_INTERRUPTED if stop.is_set() else EXIT_BROKEN
    if command.log is not None:
        save_arrays(command.log, result.log.columns())
    for note in result.notes:
        console.print(note, style="yellow", markup=False)
    console.print(f"{result.reason}; {len(result.log)} decisions")
    if result.reason == "goal reached":
        return 0
    return EXIT_INTERRUPTED if stop.is_set() else EXIT_BROKEN


def serve(command: CompanionCommand) -> int:
    """Fly missions on request of a harness."""
    channel = ChildChannel.on_stdio()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests: queue.Queue[Any] = queue.Queue()
    stop, abandon = threading.Event(), threading.Event()
    try:
        pilot = check(command)
    except UsageError as error:
        channel.send(Failed(message=str(error)))
        return EXIT_USAGE
    clock = WallClock(command.speed)

    def handle(request: Any) -> None:
        if isinstance(request, Abort):
            (stop if request.land else abandon).set()
            stop.set()
            return
        if isinstance(request, Fly):
            stop.clear()
            abandon.clear()
            # Shared for one flight, then left alone: what lasts a while (holding an action, the
            # watchdog) must not jump when the simulator gives up time. The harness corrects the
            # stamps afterwards.
            clock.epoch_ns = clock.epoch_ns if request.epoch_ns is None else request.epoch_ns
        requests.put(request)

    # Without its harness a companion has no business in the air, whatever it is doing: its
    # setpoints end and the flight controller's offboard-loss failsafe takes over.
    channel.listen(handle, lambda: os._exit(EXIT_BROKEN))
    try:
        policy, t2 = load(command, pilot), injection(command)
        bounds = watchdog_settings(command)
        with opened(command, clock, abandon) as (link, frames):
            channel.send(Ready())
            while not isinstance(request := requests.get(), Shutdown):
                if not link.connected:
                    link.connect(command.connect_timeout)
                check_camera(policy, frames, stop)
                result = fly_mission(
                    link,
                    frames,
                    _fresh(policy, command, pilot, request.latency_seed),
                    request.goal,
                    clock,
                    stop,
                    abandon,
                    _announce(channel, clock),
                    pilot_settings=pilot,
                    watchdog_settings=bounds,
                    latency=t2.sampler(np.random.default_rng(request.latency_seed)),
                )
                channel.send(_ended(result, request))
    except (UsageError, LinkError) as error:
        channel.send(Failed(message=str(error)))
        return EXIT_USAGE if isinstance(error, UsageError) else EXIT_BROKEN
    return 0


def _fresh(policy: Policy, command: CompanionCommand, pilot: PilotSettings, seed: int) -> Policy:
    """Return the policy as it begins a flight: nothing remembered, chance by the seed alone."""
    if isinstance(policy, LearnedPolicy):
        return policy.with_generator(_chance(seed))
    return load(command, pilot)


def _announce(channel: ChildChannel, clock: Clock) -> Any:
    return lambda phase: channel.send(Progress(phase=phase, time_us=clock.time_us()))


def _ended(result: MissionResult, request: Fly) -> Ended:
    """Save the decision log and return the event that says so."""
    save_arrays(Path(request.record), result.log.columns())
    return Ended(reason=result.reason, notes=result.notes, path=request.record)


if __name__ == "__main__":
    main()
