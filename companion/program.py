"""The companion as a program of its own: connects, flies one mission, and says how it went."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

from airl_mav.core.clock import WallClock
from airl_mav.core.cpu_quota import held_to
from airl_mav.latency.samplers import LatencySampler
from airl_mav.policy.actions import Policy
from airl_mav.scenario.model import PilotSettings, WatchdogSettings
from companion.camera import open_camera
from companion.guard import ThreadGuard
from companion.mavsdk_link import MavsdkLink
from companion.mission import MissionResult, check_camera, fly_mission


@dataclass(frozen=True)
class Mission:
    """What is flown, and how."""

    goal: tuple[float, float]
    """North, east of the start [m]."""
    policy: Policy
    pilot: PilotSettings
    watchdog: WatchdogSettings
    latency: LatencySampler | None
    """Where t2 is drawn from; None injects nothing."""


def fly_alone(
    mission: Mission,
    *,
    connect: str,
    camera: str,
    connect_timeout_s: float,
    speed: float,
    cpu_quota: float | None,
    stop: threading.Event,
    abandon: threading.Event,
    progress: Callable[[str, int], None],
) -> MissionResult:
    """Fly one mission against whatever answers.

    Args:
        mission: What is flown.
        connect: MAVSDK connection to the flight controller.
        camera: ZeroMQ address of the depth camera.
        connect_timeout_s: Longest wait for the flight controller [wall s].
        speed: Simulated seconds per wall second; 1 on a real aircraft.
        cpu_quota: Share of one core that this program is held to [%]; None: no limit.
        stop: Set to land and end.
        abandon: Set to end without landing.
        progress: Called with each phase as it begins, and its time [µs].

    Raises:
        UsageError: An address is unusable, or the policy cannot use the camera.
        LinkError: No flight controller is heard, or it was lost.
    """
    clock = WallClock(speed)
    with (
        held_to(cpu_quota),
        closing(open_camera(camera, clock)) as frames,
        closing(MavsdkLink(connect, clock, abandon)) as link,
    ):
        link.connect(connect_timeout_s, stop)
        check_camera(mission.policy, frames, stop)
        return fly_mission(
            link,
            frames,
            mission.policy,
            mission.goal,
            clock,
            stop,
            abandon,
            lambda phase: progress(phase, clock.time_us()),
            pilot_settings=mission.pilot,
            watchdog_settings=mission.watchdog,
            guard=ThreadGuard(clock),
            latency=mission.latency,
        )
