"""From what was asked for to what is flown: every profile and the policy are read exactly once."""

from __future__ import annotations

from dataclasses import replace

from airl_mav.arena.generate import generate
from airl_mav.core.errors import FieldError
from airl_mav.latency.injection import Injection, without_timing
from airl_mav.latency.source import select_injection
from airl_mav.policy.card import vehicle_mismatch
from airl_mav.policy.registry import find_policy
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.model import Ports, Scenario
from airl_mav.scenario.piloting import check_quota, check_trust, decide_piloting
from airl_mav.scenario.resolved import NATIVE_T2_US, ResolvedScenario

SITL_SPEEDS = 0.5, 10.0
"""Speeds at which MAVSDK, which lives by the wall clock, still works: slower, it misses heartbeats
(1 Hz of simulated time, 3 s allowed); faster, its 20 Hz of setpoints come near offboard loss."""

REAL_FIRMWARE_NEEDS = {
    "px4": ("px4_dir", "px4_connect"),
    "ardupilot": ("ardupilot_dir", "ardupilot_connect"),
    "px4-hitl": ("serial",),
}
"""Exactly one of these fields comes with each kind of real firmware."""


def resolve(scenario: Scenario) -> ResolvedScenario:
    """Check all that can be wrong before anything starts, and load all that the scenario names.

    Raises:
        UsageError: A field contradicts another, a profile or the policy cannot be used, or no
            arena can be made of the first seed. `FieldError`s name the field.
    """
    check_level(scenario)
    check_firmware(scenario)
    if scenario.level == "sitl":
        # The companion connects to the camera by its number: it cannot be "any free one" here.
        check_ports(scenario.ports, any_camera=False)
    policy = find_policy(scenario.policy)
    check_trust(scenario, policy)
    pilot, watchdog = decide_piloting(scenario, policy)
    vehicle = load_vehicle(scenario.vehicle)
    if policy.card is not None and (reason := vehicle_mismatch(policy.card, vehicle.camera)):
        raise FieldError("policy", scenario.policy, f"one that fits {scenario.vehicle}; {reason}")
    arena = load_profile("arenas", scenario.arena, ArenaSpec)
    first = scenario.arena_seed_of(scenario.seed)
    generate(arena, first, name=scenario.arena, vehicle_width_m=vehicle.body.width_m)
    computer = load_computer(scenario.computer)
    injection = select_injection(
        scenario.latency, computer, scenario.workload, policy_sha256=policy.sha256, macs=policy.macs
    )
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
    # What cannot be run is better found here than by a process that is already flying.
    resolved.fresh_policy(scenario.seed)
    return resolved


def check_level(scenario: Scenario) -> None:
    """Raise FieldError for a field that the level does not have."""
    level = scenario.level
    if level == "sitl":
        if scenario.ablate is not None:
            raise FieldError("ablate", scenario.ablate, "at level gym or lockstep")
        low, high = SITL_SPEEDS
        if scenario.speed is not None and not low <= scenario.speed <= high:
            raise FieldError(
                "speed", f"{scenario.speed:g}", f"{low:g} <= value <= {high:g} at level sitl"
            )
    if level != "lockstep":
        for field, value in (("tlogs", scenario.tlogs), ("workers", scenario.workers)):
            if value:
                raise FieldError(field, value, "at level lockstep")


def check_ports(ports: Ports, *, any_camera: bool) -> None:
    """Raise FieldError for a port that no client could be told, or two links on one port.

    Args:
        ports: What was asked for.
        any_camera: Whether the camera's port may be 0, any free one.
    """
    for field in ("api_port", "gcs_port", *(() if any_camera else ("camera_port",))):
        if getattr(ports, field) == 0:
            raise FieldError(f"ports.{field}", 0, "1 <= value <= 65535")
    if ports.api_port == ports.gcs_port:
        raise FieldError("ports.gcs_port", ports.gcs_port, "another than that of the onboard API")


def check_firmware(asked: Scenario) -> None:
    """Raise FieldError for real firmware that is asked for in a way that cannot be."""
    firmware, real = asked.firmware, asked.real
    given = {name for name, value in real if value not in (None, False)}
    for kind, names in REAL_FIRMWARE_NEEDS.items():
        mine = [name for name in names if name in given]
        if kind != firmware and mine:
            raise FieldError(f"real.{mine[0]}", getattr(real, mine[0]), f"with firmware {kind}")
        if kind == firmware and len(mine) != 1:
            raise FieldError("firmware", firmware, f"with {' or '.join(names)}")
    if firmware == "builtin":
        return
    if asked.level != "sitl":
        raise FieldError(
            "firmware",
            firmware,
            f"at level sitl, not {asked.level}: only the built-in autopilot shares its clock",
        )
    if firmware == "px4-hitl" and asked.speed not in (None, 1.0):
        raise FieldError("speed", asked.speed, "1 with firmware px4-hitl, a board's own pace")
    if firmware == "px4":
        usual = Ports()
        for name, value in asked.ports:
            if name != "camera_port" and value != getattr(usual, name):
                raise FieldError(
                    f"ports.{name}", value, "its default: PX4 SITL's ports move with instance"
                )


def _labelled(injection: Injection, scenario: Scenario) -> Injection:
    """Return the latency as a report of the level calls it."""
    if scenario.cpu_quota is not None:
        label = (
            f"native speed of the machine that flew, companion held to {scenario.cpu_quota:g} %"
            f" of a "
            "core; nothing injected"
        )
        return replace(injection, label=label)
    if scenario.level == "sitl":
        return injection
    return without_timing(injection, NATIVE_T2_US / 1e3, scenario.level)
