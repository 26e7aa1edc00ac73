"""From what `airl evaluate` was asked for to a run at level lockstep."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from typing import Any

from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.evaluate_settings import policy_part, seeds, settings
from airl_mav.cli.lockstep import lockstep_plan, policies
from airl_mav.cli.sitl_command import SitlCommand, check
from airl_mav.core.provenance import usable_cores
from airl_mav.experiments.executors import MAX_WORKERS
from airl_mav.experiments.lockstep_flier import LockstepFlier
from airl_mav.policy.registry import find_policy, load_policy
from airl_mav.profiles.computer import load_computer
from airl_mav.rehearsal.evaluation import Evaluation
from companion.pilot import PilotSettings

OF_THE_COMMAND = ("vehicle", "arena", "computer", "workload")
OF_THE_PLAN = (
    "wind",
    "pilot",
    "watchdog",
    "native_t2_us",
    "transport_us",
    "goal_radius_m",
    "time_limit_s",
    "latency_draw",
    "arena_seed",
)
"""What is written down, beside the values of the profiles: all that decides a flight."""


def plan_lockstep(
    command: EvaluateCommand, rehearsal: SitlCommand
) -> tuple[Evaluation, LockstepFlier, PilotSettings]:
    """Check everything that can be wrong before anything flies.

    Args:
        command: What was asked for.
        rehearsal: `airl-sitl --lockstep` with the same flights.

    Returns:
        The evaluation, how it is flown, and the settings of the pilot.

    Raises:
        UsageError: Names the option, its value and what is accepted.
    """
    setup, pilot = check(rehearsal)
    if command.ablate is not None:
        load_policy(rehearsal.policy, pilot.hold_s, ablate=command.ablate)
    policy = find_policy(rehearsal.policy)
    setup = replace(setup, policy=policy_part(command, policy))
    plan = lockstep_plan(rehearsal, setup, pilot)
    computer = load_computer(rehearsal.computer)
    workers = command.workers or min(usable_cores(), MAX_WORKERS)
    config: dict[str, Any] = {
        **settings(
            command,
            policy,
            rehearsal.policy,
            vehicle=plan.vehicle,
            arena=plan.arena,
            computer=computer,
            **({} if setup.injection.latency is None else {"latency": setup.injection.latency}),
        ),
        **{key: getattr(rehearsal, key) for key in OF_THE_COMMAND},
        **{key: value for key, value in asdict(plan).items() if key in OF_THE_PLAN},
        "workers": workers,
        "speed": command.speed,
        "tlogs": command.tlogs,
    }
    load = partial(policies, rehearsal, pilot.hold_s, command.ablate)
    flier = LockstepFlier(plan, load, command.tlogs)
    return Evaluation(setup, seeds(command), config), flier, pilot
