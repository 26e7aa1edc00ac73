"""Resolution of a scenario. Reads every profile and the policy exactly once."""

from __future__ import annotations

from dataclasses import replace

from airl_mav.core.errors import FieldError
from airl_mav.core.first_start import CompileJob, CompilePlan, compile_shown
from airl_mav.flight.judge import GOAL_RADIUS_M
from airl_mav.latency.injection import Injection, select_injection, without_timing
from airl_mav.policy.registry import PolicyInfo, camera_refused, find_policy
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.camera import check_noise, check_renderer
from airl_mav.profiles.conditions import check_spread, equipped
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.projections import CameraKind
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import PlantName
from airl_mav.scenario.checks import (
    check_firmware,
    check_fitted,
    check_level,
    check_plant,
    check_ports,
    check_start,
)
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.piloting import (
    NATIVE_T2_US,
    check_commands,
    check_compensated,
    check_goal_height,
    check_quota,
    decide_piloting,
)
from airl_mav.scenario.resolved import ResolvedScenario

_FLIGHT = "firmware_sim.warm_up"
_VECTORIZED = "airl_mav.envs.navigation"


def plan_of(scenario: ResolvedScenario) -> CompilePlan:
    """Return the compile plan of a scenario at its level."""
    if scenario.level == "gym":
        return vectorized_plan(scenario.vehicle.camera.kind)
    return flight_plan(scenario.vehicle, scenario.scenario.plant)


def flight_plan(vehicle: VehicleProfile, plant: PlantName) -> CompilePlan:
    """Return the compile plan of a vehicle at levels sitl and lockstep."""
    profile = vehicle.model_dump_json()
    cameras = {each.kind for each in (vehicle.camera, *vehicle.cameras.values())}
    sensors = {name for name, value in vehicle.sensors if value is not None}
    return CompilePlan(
        "flight",
        "-".join((plant, *sorted(cameras), *sorted(sensors))),
        (
            CompileJob(f"{_FLIGHT}:compile_ticks", {"vehicle": profile, "plant": plant}, 128),
            CompileJob(f"{_FLIGHT}:compile_others", {"vehicle": profile}, 92),
        ),
        CompileJob(f"{_FLIGHT}:compile_flight", {"vehicle": profile, "plant": plant}, 5),
    )


def vectorized_plan(kind: CameraKind) -> CompilePlan:
    """Return the kernels of level gym and of a training, by the main camera's kind."""
    return CompilePlan(
        "vectorized",
        kind,
        (
            CompileJob(f"{_VECTORIZED}:compile_images", {"kind": kind}, 51),
            CompileJob(f"{_VECTORIZED}:compile_dynamics", {}, 100),
        ),
        CompileJob(f"{_VECTORIZED}:compile_vectorized", {"kind": kind}, 23),
    )


def resolve(scenario: Scenario, policy: PolicyInfo | None = None) -> ResolvedScenario:
    """Validate a scenario before anything starts, and load all referenced profiles.

    `policy` replaces the scenario's. Raises UsageError if fields contradict each other, a profile
    or the policy cannot be used, or the first seed has no valid arena. `FieldError`s name the
    field.
    """
    check_level(scenario)
    if scenario.level != "gym":
        check_plant(scenario)
    check_firmware(scenario, scenario.level, scenario.speed)
    check_start(scenario)
    if scenario.level == "sitl":
        # The companion connects to the camera by its number: 0, any free port, is invalid here.
        check_ports(scenario.open_ports, any_camera=False)
    policy = policy or find_policy(scenario.policy, trust=scenario.trust)
    check_commands(policy, scenario.policy, level=scenario.level, firmware=scenario.firmware)
    pilot, watchdog = decide_piloting(scenario, policy, GOAL_RADIUS_M)
    vehicle, computer = equipped(scenario.vehicle, scenario.computer, scenario.payload)
    check_spread(vehicle, scenario.spread)
    further = vehicle.cameras.values()
    check_noise(vehicle.camera, scenario.sensors, scenario.faults, further=further)
    check_fitted(vehicle.sensors, scenario.faults)
    if reason := camera_refused(policy, vehicle):
        raise FieldError(
            "policy", scenario.policy, problem=f"does not fit vehicle {scenario.vehicle}: {reason}"
        )
    check_compensated(pilot, policy, vehicle)
    arena = load_profile("arenas", scenario.arena, ArenaSpec)
    injection = select_injection(
        scenario.latency, computer, scenario.workload, policy_sha256=policy.sha256, macs=policy.macs
    )
    check_renderer(vehicle.camera, scenario.renderer, arena, further)
    check_quota(scenario, injection, scenario.level)
    resolved = ResolvedScenario(
        scenario=scenario,
        vehicle=vehicle,
        arena=arena,
        computer=computer,
        policy=policy,
        injection=_labelled(injection, scenario),
        pilot=pilot,
        watchdog=watchdog,
    )
    compile_shown([plan_of(resolved)])
    # Load everything now, so that errors precede the flight.
    goal = resolved.arena_of(scenario.seed).goal_point
    check_goal_height(policy, goal, "arena", scenario.arena)
    if policy.asked is None:
        resolved.fresh_policy(scenario.seed)
    resolved.compensator()
    return resolved


def _labelled(injection: Injection, scenario: Scenario) -> Injection:
    """Return the latency with the label that the level's report uses."""
    if scenario.cpu_quota is not None:
        label = (
            "native speed of the machine that flew, companion held to "
            f"{scenario.cpu_quota:g} % of a core; nothing injected"
        )
        return replace(injection, label=label)
    if scenario.level == "sitl":
        return injection
    return without_timing(injection, NATIVE_T2_US / 1e3, scenario.level)
