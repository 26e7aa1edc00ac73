"""A scenario for tests in lockstep; as a script, flights in a process that a test may stop."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from typing import Any

from airl_mav.core.frames import Goal
from airl_mav.latency.injection import FixedSampler
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.lockstep.stage import LockstepStage
from airl_mav.policy.actions import Policy
from airl_mav.rehearsal.observer import Observer
from airl_mav.scenario.checks import NATIVE_T2_US
from airl_mav.scenario.model import LimitSettings, PilotSettings, Scenario, WatchdogSettings
from airl_mav.scenario.resolve import ResolvedScenario, resolve
from companion.pilot import Mission, MissionResult, SentDecision, Start, fly_mission

SEED = 11
"""A short flight: two seconds to the goal."""

BEGINS = "begins"
"""Printed by the script at the start of a flight; the fingerprint follows at the end."""


class Speaking(Observer):
    """Says when a flight begins."""

    def episode(self, index: int, seed: int, goal: Goal) -> None:
        say(BEGINS)


def demo_scenario(**changes: Any) -> ResolvedScenario:
    """Return a short flight in lockstep by a policy that decides every half a second.

    `changes` are fields of the scenario.
    """
    usual = {"policy": "static-obstacles", "level": "lockstep", "time_limit_s": 60.0}
    return resolve(Scenario(**(usual | changes)))


def fly_as_companion(
    stage: LockstepStage,
    policy: Policy,
    goal: Goal,
    *,
    stop: threading.Event | None = None,
    phase: Callable[[str], None] = lambda _: None,
    start: Start = "arm",
    decided: Callable[[SentDecision], None] | None = None,
) -> MissionResult:
    """Fly a mission on a stage with default settings; called by `LockstepStage.run`.

    `stop` ends it early; `phase` receives its phases, and `decided` its decisions.
    """
    mission = Mission(
        goal,
        policy,
        PilotSettings(),
        WatchdogSettings(),
        LimitSettings(),
        latency=FixedSampler(NATIVE_T2_US),
        start=start,
    )
    clock, abandon = stage.clock, stage.abandon
    return fly_mission(
        stage.link, stage.camera, mission, clock, stop or abandon, abandon, phase, clock, decided
    )


def main(flights: int) -> None:
    resolved = demo_scenario()
    fly(resolved, resolved.fresh_policy(3), 0, 3)  # compile and load everything now
    for _ in range(flights):
        policy = resolved.fresh_policy(SEED)
        record = fly(resolved, policy, 0, SEED, observer=Speaking()).record
        assert record.sha256 is not None
        say(record.sha256["flight"])


def say(word: str) -> None:
    sys.stdout.write(f"{word}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]))
