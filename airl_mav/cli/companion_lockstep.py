"""`airl-companion --lockstep`: the companion of a simulator that waits for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

from airl_mav.core.constants import US_PER_MS
from airl_mav.envs.spec import Delay
from airl_mav.latency.samplers import FixedSampler, LatencySampler
from airl_mav.lockstep.digest import SEEN, FlightDigest, WitnessedPolicy
from airl_mav.policy.actions import Policy
from companion.camera import ZmqFrameSource
from companion.conducted import ConductedClock
from companion.mavsdk_link import MavsdkLink
from companion.mission import MissionResult, check_camera, fly_mission
from companion.pilot import PilotSettings
from companion.token_camera import TokenFrameSource
from companion.token_clock import TokenTurns
from companion.watchdog import WatchdogSettings

ANSWER_TIMEOUT_S = 20.0
"""MAVSDK repeats a command that has not been answered for so long, four times at most [wall s]:
never in a flight, also when a process is stopped for a while, but it notices a simulator that is
gone."""


@dataclass(frozen=True)
class Mission:
    """What is flown."""

    goal: tuple[float, float]
    """North, east [m] from the start."""
    policy: Policy
    pilot: PilotSettings
    watchdog: WatchdogSettings
    latency: LatencySampler | None
    """t2; None: as in training, nothing is timed here."""


def fly(
    mission: Mission,
    connect: str,
    timeout_s: float,
    open_camera: Callable[[ConductedClock], ZmqFrameSource],
    stop: threading.Event,
    abandon: threading.Event,
    progress: Callable[[str, int], None],
) -> tuple[MissionResult, dict[str, str]]:
    """Fly one mission; the same simulator and mission give the same flight, bit by bit.

    Args:
        mission: What is flown.
        connect: MAVSDK connection to the simulator.
        timeout_s: How long to wait for it, and for each turn [wall s].
        open_camera: Connects to the camera.
        stop: Set to end the flight early; the simulator sets it, too.
        abandon: Set to end it without landing; the simulator sets it, too.
        progress: Called with the name of each phase as it begins, and the simulated time [µs].

    Returns:
        How it ended, and the fingerprint of what the policy saw.

    Raises:
        UsageError: The connection is none, or the policy cannot use the camera.
        LinkError: No flight controller is heard.
        Abandoned: The simulator gives no turn any more.
    """
    digest = FlightDigest()
    turns = TokenTurns(stop, abandon, timeout_s)
    clock = ConductedClock(turns.clock, turns.sleep)

    def announce(phase: str) -> None:
        turns.tell(phase)
        progress(phase, clock.time_us())

    with (
        closing(open_camera(clock)) as frames,
        # Who gives turns is heard, however long the wall clock says that it was silent.
        closing(MavsdkLink(connect, clock, abandon, heard=lambda: True)) as link,
    ):
        link.set_timeout(ANSWER_TIMEOUT_S)
        link.connect(timeout_s, stop)
        camera = TokenFrameSource(frames, turns, clock)
        with turns.taken(link):
            check_camera(mission.policy, camera, stop)
            result = fly_mission(
                link,
                camera,
                WitnessedPolicy(mission.policy, digest),
                mission.goal,
                clock,
                stop,
                abandon,
                announce,
                pilot_settings=mission.pilot,
                watchdog_settings=mission.watchdog,
                guard=clock,
                latency=mission.latency or FixedSampler(round(Delay().native_ms * US_PER_MS)),
            )
    return result, {SEEN: digest.lanes()[SEEN]}
