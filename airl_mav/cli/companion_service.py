"""`airl-companion --control stdio`: missions on request of a harness."""

from __future__ import annotations

import os
import queue
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from airl_mav.cli import companion_lockstep
from airl_mav.cli.common import (
    EXIT_BROKEN,
    EXIT_USAGE,
)
from airl_mav.cli.companion_command import (
    CompanionCommand,
    chance,
    check,
    injection,
    load,
    lockstep_mission,
    open_camera,
    opened,
    watchdog_settings,
)
from airl_mav.core.clock import WallClock
from airl_mav.core.cpu_quota import held_to
from airl_mav.core.errors import UsageError
from airl_mav.core.files import save_arrays
from airl_mav.latency.samplers import latency_generator
from airl_mav.policy.actions import Policy
from airl_mav.policy.learned import LearnedPolicy
from airl_mav.rehearsal.channel import (
    Abort,
    ChildChannel,
    Ended,
    Failed,
    Fly,
    Progress,
    Ready,
    Shutdown,
)
from companion.conducted import Abandoned
from companion.guard import ThreadGuard
from companion.interfaces import LinkError
from companion.mission import MissionResult, check_camera, fly_mission
from companion.pilot import PilotSettings


def serve(command: CompanionCommand) -> int:
    """Fly missions on request of a harness."""
    channel = ChildChannel.on_stdio()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests: queue.Queue[Any] = queue.Queue()
    stop, abandon = threading.Event(), threading.Event()
    try:
        pilot = check(command)
    except UsageError as error:
        channel.send(Failed(message=str(error), usage=True))
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
    missions = _missions_in_lockstep if command.lockstep else _missions
    try:
        with (
            held_to(command.cpu_quota),
            missions(command, pilot, clock, stop, abandon, channel) as fly,
        ):
            channel.send(Ready())
            while not isinstance(request := requests.get(), Shutdown):
                channel.send(fly(request))
    except (UsageError, LinkError, Abandoned) as error:
        usage = isinstance(error, UsageError)
        channel.send(Failed(message=str(error), usage=usage))
        return EXIT_USAGE if usage else EXIT_BROKEN
    return 0


@contextmanager
def _missions(
    command: CompanionCommand,
    pilot: PilotSettings,
    clock: WallClock,
    stop: threading.Event,
    abandon: threading.Event,
    channel: ChildChannel,
) -> Iterator[Callable[[Fly], Ended]]:
    """Give what flies a mission; link and camera stay open for all."""
    policy, t2 = load(command, pilot), injection(command)
    bounds = watchdog_settings(command)
    with opened(command, clock, abandon) as (link, frames):

        def fly(request: Fly) -> Ended:
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
                lambda phase: channel.send(Progress(phase=phase, time_us=clock.time_us())),
                pilot_settings=pilot,
                watchdog_settings=bounds,
                guard=ThreadGuard(clock),
                latency=t2.sampler(latency_generator(request.latency_seed, command.latency_seed)),
            )
            return _ended(result, request, {})

        yield fly


@contextmanager
def _missions_in_lockstep(
    command: CompanionCommand,
    pilot: PilotSettings,
    _: WallClock,
    stop: threading.Event,
    abandon: threading.Event,
    channel: ChildChannel,
) -> Iterator[Callable[[Fly], Ended]]:
    """Give what flies a mission; everything but the policy is new in each, as in the simulator."""
    policy = load(command, pilot)

    def fly(request: Fly) -> Ended:
        seed = request.latency_seed
        fresh = _fresh(policy, command, pilot, seed)
        result, sha256 = companion_lockstep.fly(
            lockstep_mission(command, pilot, fresh, request.goal, seed),
            command.connect,
            command.connect_timeout,
            lambda clock: open_camera(command.camera, clock),
            stop,
            abandon,
            lambda phase, time_us: channel.send(Progress(phase=phase, time_us=time_us)),
        )
        return _ended(result, request, sha256)

    yield fly


def _fresh(policy: Policy, command: CompanionCommand, pilot: PilotSettings, seed: int) -> Policy:
    """Return the policy as it begins a flight: nothing remembered, chance by the seed alone."""
    if isinstance(policy, LearnedPolicy):
        return policy.with_generator(chance(seed))
    return load(command, pilot)


def _ended(result: MissionResult, request: Fly, sha256: dict[str, str]) -> Ended:
    """Save the decision log and return the event that says so."""
    save_arrays(Path(request.record), result.log.columns())
    return Ended(reason=result.reason, notes=result.notes, path=request.record, sha256=sha256)
