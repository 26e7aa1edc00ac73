"""From what `airl evaluate` was asked for to a run at level lockstep."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.evaluate_settings import policy_part, seeds, settings
from airl_mav.cli.lockstep import lockstep_plan, policies
from airl_mav.cli.sitl_command import SitlCommand, check
from airl_mav.core.provenance import usable_cores
from airl_mav.lockstep.flight import LockstepPlan, fly
from airl_mav.policy.registry import find_policy, load_policy
from airl_mav.profiles.computer import load_computer
from airl_mav.rehearsal.evaluation import Evaluation, Job
from airl_mav.rehearsal.evaluation_lockstep import Fly, LockstepRun
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
from airl_mav.rehearsal.workers import GREATEST_WORKERS
from airl_mav.scenario.model import PilotSettings
from firmware_sim.warm_up import warm_up

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


@dataclass(frozen=True)
class LockstepFlier:
    """Flies the episodes of a plan. Implements `evaluation_lockstep.Flier`."""

    plan: LockstepPlan
    rehearsal: SitlCommand
    """The rehearsal with the same flights."""
    hold_s: float
    ablate: str | None

    def start(self, tlogs: RunFolder | None) -> Fly:
        """Load everything; see `evaluation_lockstep.Flier`."""
        warm_up(self.plan.vehicle)
        fresh_policy = policies(self.rehearsal, self.hold_s, self.ablate)

        def fly_one(job: Job) -> FlownEpisode:
            tlog = None if tlogs is None else tlogs.tlog_path(job.index)
            return fly(self.plan, fresh_policy(job.seed), job.index, job.seed, tlog=tlog)

        return fly_one


def plan_lockstep(
    command: EvaluateCommand, rehearsal: SitlCommand
) -> tuple[LockstepRun, PilotSettings]:
    """Check everything that can be wrong before anything flies.

    Args:
        command: What was asked for.
        rehearsal: `airl-sitl --lockstep` with the same flights.

    Returns:
        The run, and how the policy is flown.

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
    workers = command.workers or min(usable_cores(), GREATEST_WORKERS)
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
    return (
        LockstepRun(
            Evaluation(setup, seeds(command), config),
            LockstepFlier(plan, rehearsal, pilot.hold_s, command.ablate),
            workers,
            command.tlogs,
        ),
        pilot,
    )
