"""From what `airl evaluate` was asked for to a plan at level gym."""

from __future__ import annotations

from functools import partial
from typing import Any

from airl_mav.cli.common import check_range
from airl_mav.cli.companion_command import PilotOptions, chance, pilot_settings
from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.evaluate_settings import policy_part, seeds, settings
from airl_mav.core.errors import UsageError
from airl_mav.envs.evaluation import LearnedPilots, Pilots, SinglePilots
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from airl_mav.experiments.gym_flier import GymFlier
from airl_mav.flight.judge import GOAL_RADIUS_M, TIME_LIMIT_S
from airl_mav.flight.setup import Part, Setup
from airl_mav.latency.injection import without_timing
from airl_mav.latency.source import select_injection
from airl_mav.policy.card import vehicle_mismatch
from airl_mav.policy.learned import LearnedPolicy
from airl_mav.policy.registry import PolicyInfo, find_policy, load_policy
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.vehicle import Camera, load_vehicle
from airl_mav.rehearsal.evaluation import Evaluation

GREATEST_SLOTS = 4096
"""Flights at a time: more would fill gigabytes with paths."""


def plan_evaluation(
    command: EvaluateCommand, policy: str, arena: str
) -> tuple[Evaluation, GymFlier]:
    """Check everything that can be wrong before anything flies.

    Raises:
        UsageError: Names the option, its value and what is accepted.
    """
    check_range("--slots", command.slots, 1, GREATEST_SLOTS)
    info = find_policy(policy)
    vehicle, computer = load_vehicle(command.vehicle), load_computer(command.computer)
    if info.card is not None and (reason := vehicle_mismatch(info.card, vehicle.camera)):
        raise UsageError(f"policy {policy}: vehicle {command.vehicle}: {reason}")
    environment = _environment(command, info, arena, vehicle.camera)
    _pilots(command, policy, environment)
    injection = without_timing(
        select_injection(
            command.latency,
            command.computer,
            command.workload,
            policy_sha256=info.sha256,
            macs=info.macs,
        ),
        environment.delay.native_ms,
        command.level,
    )
    # What cannot be flown is better found here: makes an arena, and looks at camera and hold.
    trial = Navigation(environment, 1, injection=injection, arena_seed=command.arena_seed)
    trial.begin([0], [command.seed])
    hover_s = environment.episode.hover_after_s
    setup = Setup(
        level="gym",
        vehicle=Part(command.vehicle, vehicle.description),
        arena=Part(arena, trial.arena_spec.description),
        policy=policy_part(command, info),
        computer=Part(command.computer, computer.description),
        computer_watts=computer.watts,
        injection=injection,
        speed=None,
        between_commands="persist" if hover_s is None else f"hover-after {1e3 * hover_s:g} ms",
    )
    config = {
        **settings(
            command,
            info,
            policy,
            vehicle=vehicle,
            arena=trial.arena_spec,
            computer=computer,
            **({} if injection.latency is None else {"latency": injection.latency}),
        ),
        "slots": command.slots,
        "environment": environment.model_dump(mode="json"),
    }
    evaluation = Evaluation(setup, seeds(command), config)
    return evaluation, GymFlier(
        environment,
        injection,
        computer.watts,
        partial(_pilots, command, policy, environment),
        command.slots,
        latency_draw=command.latency_seed,
        arena_seed=command.arena_seed,
    )


def _environment(
    command: EvaluateCommand, policy: PolicyInfo, arena: str, camera: Camera
) -> EnvironmentSpec:
    """Return the environment: as asked, else as the policy's card says, else by default."""
    card = policy.card
    radius, hover_s = command.goal_radius, command.hover_after
    shape: dict[str, Any]
    if card is None:
        radius = GOAL_RADIUS_M if radius is None else radius
        # It looks at the camera's own image.
        shape = {"image_width_px": camera.width_px, "image_height_px": camera.height_px}
    else:
        hover_s = card.hover_after_s if hover_s is None else hover_s
        shape = {
            "layout": card.observation.layout,
            "image_width_px": card.observation.width_px,
            "image_height_px": card.observation.height_px,
            "actions": card.actions.set,
            "max_speed_m_s": card.actions.max_speed_m_s,
        }
    options = PilotOptions(hold_s=command.hold, altitude_m=command.altitude, goal_radius_m=radius)
    pilot = pilot_settings(options, policy)
    limit_s = TIME_LIMIT_S if command.time_limit is None else command.time_limit
    return spec_of(
        None,
        {
            "vehicle": command.vehicle,
            "arena": arena,
            **shape,
            "episode": {
                "goal_radius_m": pilot.goal_radius_m,
                "time_limit_s": limit_s,
                "hold_s": pilot.hold_s,
                "hover_after_s": hover_s,
                "altitude_m": pilot.altitude_m,
            },
            "delay": {
                "computer": command.computer,
                "workload": command.workload,
                "latency": () if command.latency is None else (command.latency,),
            },
        },
    )


def _pilots(command: EvaluateCommand, policy: str, environment: EnvironmentSpec) -> Pilots:
    """Return who decides."""
    hold_s = environment.episode.hold_s
    loaded = load_policy(policy, hold_s, ablate=command.ablate)
    if isinstance(loaded, LearnedPolicy):
        # As the companion draws them.
        return LearnedPilots(loaded, chance)
    return SinglePilots(lambda: load_policy(policy, hold_s), environment.max_speed_m_s)
