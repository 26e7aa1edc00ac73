"""Companion for a simulator that waits for it (`airl-companion --lockstep`)."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace

from airl_mav.addons.remote_lockstep.turns import TokenFrameSource, TokenTurns
from airl_mav.latency.injection import FixedSampler
from airl_mav.lockstep.turns import SEEN, FlightDigest, WitnessedPolicy
from airl_mav.scenario import checks, stand_alone
from companion import frame_source, pilot, program, watchdog

ANSWER_TIMEOUT_S = 20.0
"""Timeout after which MAVSDK repeats a command, at most four times [wall s]. Long enough for all
flights, even if a process is suspended for a while, but MAVSDK notices a lost simulator."""


def fly_in_lockstep(
    asked: stand_alone.StandAloneCompanion,
    mission: program.MissionSetup,
    stop: threading.Event,
    abandon: threading.Event,
    waiting: Callable[[], None],
    progress: Callable[[str, int], None],
) -> tuple[pilot.MissionResult, dict[str, str]]:
    """Fly one mission; equal simulator and mission give a bit-identical flight.

    `stop` ends the flight early, `abandon` without landing; the simulator sets them, too. `waiting`
    is called when the wait for the simulator begins, `progress` at the start of each phase with its
    name and the simulated time [µs].

    Returns:
        The mission's result, and the digest of the policy's observations.

    Raises:
        UsageError: The connection or the key is invalid, or the policy cannot use the camera.
        LinkError: No flight controller was found.
        Abandoned: The simulator does not give turns any longer.
    """
    digest = FlightDigest()
    # The connection timeout also bounds each turn.
    turns = TokenTurns(stop, abandon, asked.connect_timeout)
    clock = watchdog.ConductedClock(turns.clock, turns.sleep)

    def announce(phase: str) -> None:
        turns.tell(phase)
        progress(phase, clock.time_us())

    with (
        closing(frame_source.open_camera(asked.camera, clock, asked.read_camera_key())) as frames,
        # The simulator controls time: ignore silence in wall time.
        closing(program.open_link(asked, clock, abandon, heard=lambda: True)) as link,
    ):
        waiting()
        # MAVSDK's timeout ends the wait for a vehicle that rejects unsigned messages, and lets an
        # order to end take effect. A retry is harmless.
        link.connect(asked.connect_timeout, stop)
        link.set_timeout(ANSWER_TIMEOUT_S)
        camera = TokenFrameSource(frames, turns, clock)
        # Turns start before the camera check, which needs frames.
        with turns.taken(link):
            pilot.check_camera(mission.policy, camera, stop, mission.compensator)
            flown = replace(
                mission,
                policy=WitnessedPolicy(mission.policy, digest),
                # Without injection a fixed t2: the measured one would differ in each flight.
                latency=mission.latency or FixedSampler(checks.NATIVE_T2_US),
                start="arm",
            )
            result = pilot.fly_mission(link, camera, flown, clock, stop, abandon, announce, clock)
    return result, {SEEN: digest.lanes()[SEEN]}
