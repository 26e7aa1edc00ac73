"""The companion of a simulator that waits for it (`airl-companion --lockstep`)."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing

from airl_mav.latency.samplers import FixedSampler
from airl_mav.lockstep.digest import SEEN, FlightDigest, WitnessedPolicy
from airl_mav.scenario.piloting import NATIVE_T2_US
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.camera import open_camera
from companion.conducted import ConductedClock
from companion.mavsdk_link import MavsdkLink
from companion.mission import MissionResult, check_camera, fly_mission
from companion.program import Mission
from companion.signing_proxy import signed
from companion.token_clock import TokenFrameSource, TokenTurns

ANSWER_TIMEOUT_S = 20.0
"""MAVSDK repeats a command that has not been answered for so long, four times at most [wall s]:
never in a flight, also when a process is stopped for a while, but it notices a simulator that is
gone."""


def fly_in_lockstep(
    asked: StandAloneCompanion,
    mission: Mission,
    stop: threading.Event,
    abandon: threading.Event,
    waiting: Callable[[], None],
    progress: Callable[[str, int], None],
) -> tuple[MissionResult, dict[str, str]]:
    """Fly one mission; the same simulator and mission give the same flight, bit by bit.

    Args:
        asked: How the simulator and the camera are reached, and how long to wait for the
            simulator, and for each turn.
        mission: What is flown.
        stop: Set to end the flight early; the simulator sets it, too.
        abandon: Set to end it without landing; the simulator sets it, too.
        waiting: Called once the simulator is waited for.
        progress: Called with the name of each phase as it begins, and the simulated time [µs].

    Returns:
        How it ended, and the fingerprint of what the policy saw.

    Raises:
        UsageError: The connection is none, the key cannot be used, or the policy cannot use the
            camera.
        LinkError: No flight controller is heard.
        Abandoned: The simulator gives no turn any more.
    """
    digest = FlightDigest()
    turns = TokenTurns(stop, abandon, asked.connect_timeout)
    clock = ConductedClock(turns.clock, turns.sleep)

    def announce(phase: str) -> None:
        turns.tell(phase)
        progress(phase, clock.time_us())

    with (
        closing(open_camera(asked.camera, clock)) as frames,
        signed(asked.connect, asked.signing_key) as url,
        # Who gives turns is heard, however long the wall clock says that it was silent.
        closing(MavsdkLink(url, clock, abandon, heard=lambda: True)) as link,
    ):
        waiting()
        # MAVSDK's own time-out ends the wait for a vehicle that rejects unsigned messages. It also
        # lets an order to end take effect. A retry is harmless.
        link.connect(asked.connect_timeout, stop)
        link.set_timeout(ANSWER_TIMEOUT_S)
        camera = TokenFrameSource(frames, turns, clock)
        with turns.taken(link):
            check_camera(mission.policy, camera, stop, mission.compensator)
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
                limit_settings=mission.limits,
                guard=clock,
                latency=mission.latency or FixedSampler(NATIVE_T2_US),
                compensator=mission.compensator,
                mount_pitch_up_rad=mission.mount_pitch_up_rad,
                mount_yaw_rad=mission.mount_yaw_rad,
            )
    return result, {SEEN: digest.lanes()[SEEN]}
