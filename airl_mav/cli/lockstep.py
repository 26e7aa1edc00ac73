"""From what a flight in lockstep was asked for to a plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from airl_mav.cli.companion_command import chance, hover_after_s
from airl_mav.cli.sitl_command import ARRIVAL_SHARE, SitlCommand
from airl_mav.core.constants import US_PER_MS
from airl_mav.envs.spec import Delay
from airl_mav.flight.setup import Setup
from airl_mav.lockstep.flight import LockstepPlan
from airl_mav.policy.actions import Policy
from airl_mav.policy.learned import LearnedPolicy
from airl_mav.policy.registry import find_policy, load_policy
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.model import PilotSettings


def lockstep_plan(command: SitlCommand, setup: Setup, pilot: PilotSettings) -> LockstepPlan:
    """Return the plan of a checked command; `setup` and `pilot` are what `sitl_command.check` gave.

    Where a machine's own time would count, the training environment's values stand.
    """
    hover_s = hover_after_s(command.watchdog, find_policy(command.policy))
    delay = Delay()
    return LockstepPlan(
        vehicle=load_vehicle(command.vehicle),
        arena_name=command.arena,
        arena=load_profile("arenas", command.arena, ArenaSpec),
        wind=command.wind,
        # The companion goes closer: it knows its place only by estimate.
        pilot=replace(pilot, goal_radius_m=ARRIVAL_SHARE * pilot.goal_radius_m),
        watchdog=replace(command.watchdog, hover_after_s=hover_s),
        injection=setup.injection,
        native_t2_us=round(delay.native_ms * US_PER_MS),
        transport_us=round(delay.transport_ms * US_PER_MS),
        goal_radius_m=pilot.goal_radius_m,
        time_limit_s=command.time_limit,
        computer_watts=setup.computer_watts,
        speed=command.speed,
        estimator=command.estimator,
        latency_draw=command.latency_seed,
        arena_seed=command.arena_seed,
    )


def policies(
    command: SitlCommand, hold_s: float, ablate: str | None = None
) -> Callable[[int], Policy]:
    """Return what gives the policy as it begins a flight with a seed: nothing remembered.

    Args:
        command: What was asked for.
        hold_s: How long an action is held [s].
        ablate: Input of the network that is made zero; None: none.
    """

    def load(seed: int) -> Policy:
        return load_policy(
            command.policy,
            hold_s,
            runtime=command.runtime,
            threads=command.threads,
            rng=chance(seed),
            ablate=ablate,
        )

    loaded = load(command.seed)
    if isinstance(loaded, LearnedPolicy):
        # Loaded once; what it remembers is its source of chance.
        return lambda seed: loaded.with_generator(chance(seed))
    return load
