"""A plan for tests in lockstep; as a script, flights in a process that a test may stop."""

from __future__ import annotations

import sys

from airl_mav.latency.injection import NOTHING_INJECTED
from airl_mav.lockstep.flight import LockstepPlan, Watching, fly
from airl_mav.policy.registry import load_policy
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from companion.pilot import PilotSettings
from companion.watchdog import WatchdogSettings
from firmware_sim.plant.wind import WindSettings

ARENA = POLICY = "static-obstacles"

SEED = 11
"""A short flight: two seconds to the goal."""

BEGINS = "begins"
"""Said by the script when a flight begins; its fingerprint follows at the end."""


def demo_plan() -> LockstepPlan:
    return LockstepPlan(
        vehicle=load_vehicle("quad"),
        arena_name=ARENA,
        arena=load_profile("arenas", ARENA, ArenaSpec),
        wind=WindSettings(),
        pilot=PilotSettings(goal_radius_m=2.4),
        watchdog=WatchdogSettings(),
        injection=NOTHING_INJECTED,
        native_t2_us=1_000,
        transport_us=5_000,
        goal_radius_m=3.0,
        time_limit_s=60.0,
        computer_watts=0.0,
    )


def main(flights: int) -> None:
    plan, policy = demo_plan(), load_policy(POLICY, 0.5)
    watching = Watching(begin=lambda _: say(BEGINS))
    fly(plan, policy, 0, 3)  # what is compiled or loaded late is, now
    for _ in range(flights):
        record = fly(plan, policy, 0, SEED, watching=watching).record
        assert record.sha256 is not None
        say(record.sha256["flight"])


def say(word: str) -> None:
    sys.stdout.write(f"{word}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]))
