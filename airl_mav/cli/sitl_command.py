"""What `airl-sitl` can be asked for, and what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import tyro

from airl_mav.arena.generate import generate
from airl_mav.cli.common import (
    GREATEST_SEED,
    check_draws,
    check_ports,
    check_range,
    check_wind,
)
from airl_mav.cli.companion_command import (
    GREATEST_THREADS,
    PilotOptions,
    check_holding,
    check_quota,
    hover_after_s,
    pilot_settings,
)
from airl_mav.cli.firmware_options import (
    TITLES,
    FirmwareName,
    RealFirmwareOptions,
    check_firmware,
    check_program,
)
from airl_mav.core.errors import UsageError
from airl_mav.envs.spec import Delay
from airl_mav.flight.judge import GOAL_RADIUS_M, TIME_LIMIT_S
from airl_mav.flight.setup import Level, Part, Setup
from airl_mav.latency.injection import without_timing
from airl_mav.latency.source import select_injection
from airl_mav.policy.card import vehicle_mismatch
from airl_mav.policy.registry import DEFAULT_POLICY, PolicyInfo, find_policy, load_policy
from airl_mav.policy.runtime import RuntimeName
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.model import PilotSettings, Ports, WatchdogSettings, WindSettings
from firmware_sim.autopilot.filters import FilterName

ARRIVAL_SHARE = 0.8
"""The companion flies to this share of the goal radius: it knows its place only by estimate, while
the referee measures the true one."""


SLOWEST, FASTEST = 0.5, 10.0
"""Speeds at which MAVSDK, which lives by the wall clock, still works: slower, it misses heartbeats
(1 Hz of simulated time, 3 s allowed); faster, its 20 Hz of setpoints come near offboard loss."""

LOCKSTEP_SPEEDS = 0.01, 1000.0
"""Limits of the pace in lockstep, where nothing goes by the wall clock."""


@dataclass(frozen=True)
class SitlCommand:
    """Rehearse a policy: firmware and companion as two processes, seeded episodes, a report."""

    vehicle: str = "quad"
    """Vehicle profile: a shipped name, or a path to a .toml."""

    arena: str = "static-obstacles"
    """Arena profile: a shipped name, or a path to a .toml."""

    policy: str = DEFAULT_POLICY
    """Policy that decides: a name, or a path to a folder with policy.onnx and card.json."""

    runtime: RuntimeName = "onnx"
    """What runs a learned policy; torch needs its policy.pt2."""

    threads: int = 1
    """Threads of one inference."""

    cpu_quota: float | None = None
    """Hold the companion to so many percent of one core, for real, by a Linux control group; 1 to
    6400. What it then takes is measured, nothing is injected. None: no limit."""

    computer: str = "workstation"
    """Computer profile to fly as: a shipped name, or a path to a .toml."""

    workload: str | None = None
    """Workload of the computer profile whose latency t2 is injected; estimate: scaled to this
    policy. None: what was measured for this very policy, or else what this machine takes."""

    latency: str | None = None
    """Latency t2 to inject, in place of --workload: 150ms, lognormal:396ms,20ms (mean, standard
    deviation), normal:396ms,20ms, COMPUTER/WORKLOAD, or a file of measured latencies, one a line in
    ms, which are replayed in their order. None: as --computer and --workload say."""

    latency_seed: int = 0
    """Other draws of the same latency on the same episodes; 0: those of the episodes' own seeds."""

    episodes: int = 3
    """Number of episodes, >= 1."""

    seed: int = 1
    """Seed; episode i uses seed + i for arena, sensors, wind and latency."""

    arena_seed: int | None = None
    """Every episode in the arena, and with the goal, of this one seed. None: of its own."""

    lockstep: bool = False
    """Everything in one process on one simulated clock, MAVSDK included: the same flight every
    time, bit by bit, as fast as it goes. Latencies are then those of the computer profile alone."""

    speed: float | None = None
    """Simulated seconds per wall second, 0.5 to 10; in lockstep 0.01 to 1000. Latencies count in
    simulated time. None: 1, or in lockstep as fast as it goes."""

    goal_radius: float | None = None
    """The goal is reached closer than this, seen from above, m. None: that of the policy's card,
    or 3."""

    time_limit: float = TIME_LIMIT_S
    """Longest flight from the start of navigation, s."""

    hold: float | None = None
    """t3: how long an action is held before the next observation, s. None: that of the policy's
    card, or 0.5."""

    altitude: float | None = None
    """Height above the start that is flown, m. None: that of the policy's card, or 2.5."""

    watchdog: tyro.conf.OmitArgPrefixes[WatchdogSettings] = field(default_factory=WatchdogSettings)
    """Bounds on silence."""

    wind: WindSettings = field(default_factory=WindSettings)
    """Wind; calm by default."""

    estimator: FilterName = "kernel"
    """Filter of the estimator: compiled, or filterpy's, the reference, some twenty times slower."""

    firmware: FirmwareName = "builtin"
    """What flies: the built-in autopilot, or real firmware on this vehicle and its sensors; see
    docs/real-firmware.md."""

    real: tyro.conf.OmitArgPrefixes[RealFirmwareOptions] = field(
        default_factory=RealFirmwareOptions
    )
    """Real firmware."""

    ports: tyro.conf.OmitArgPrefixes[Ports] = field(default_factory=Ports)
    """Ports."""

    out: Path | None = None
    """Run folder; one that holds some episodes of the same run gets the others. None: runs/<UTC
    time>-sitl-<policy>."""


def check(command: SitlCommand) -> tuple[Setup, PilotSettings]:
    """Check everything that can be wrong before anything starts.

    Returns:
        What is flown on what, and how; the goal radius is the referee's.

    Raises:
        UsageError: Names the option, its value and what is accepted.
    """
    check_range("--episodes", command.episodes, 1, 100_000)
    check_range("--seed", command.seed, 0, GREATEST_SEED)
    check_draws(command.latency_seed, command.arena_seed)
    if command.speed is not None:
        slowest, fastest = LOCKSTEP_SPEEDS if command.lockstep else (SLOWEST, FASTEST)
        check_range("--speed", command.speed, slowest, fastest)
    check_range("--threads", command.threads, 1, GREATEST_THREADS)
    check_range("--time-limit", command.time_limit, 1.0, 3600.0)
    policy = find_policy(command.policy)
    pilot = _flown(command, policy)
    check_range("--goal-radius", pilot.goal_radius_m, 0.2, 50.0)
    check_range("--altitude", pilot.altitude_m, 0.5, 100.0)
    check_holding("--hold", pilot.hold_s, command.watchdog)
    check_wind(command.wind)
    check_firmware(command)
    check_program(command.real)
    if not command.lockstep:
        # The companion connects to the camera by its number: it cannot be "any free one" here.
        check_ports(command.ports, free=False)
    vehicle = load_vehicle(command.vehicle)
    if policy.card is not None and (reason := vehicle_mismatch(policy.card, vehicle.camera)):
        raise UsageError(f"--policy {command.policy}: vehicle {command.vehicle}: {reason}")
    # The companion loads it again: what cannot be run is better found here.
    load_policy(command.policy, pilot.hold_s, runtime=command.runtime, threads=command.threads)
    arena = load_profile("arenas", command.arena, ArenaSpec)
    first = command.seed if command.arena_seed is None else command.arena_seed
    generate(arena, first, name=command.arena, vehicle_width_m=vehicle.body.width_m)
    computer = load_computer(command.computer)
    injection = select_injection(
        command.latency,
        command.computer,
        command.workload,
        policy_sha256=policy.sha256,
        macs=policy.macs,
    )
    hover_s = hover_after_s(command.watchdog, policy)
    check_quota(
        command.cpu_quota, lockstep=command.lockstep, injected=injection.latency is not None
    )
    if command.cpu_quota is not None:
        injection = replace(injection, label=held_label(command.cpu_quota))
    if command.lockstep:
        injection = without_timing(injection, Delay().native_ms, "lockstep")
    setup = Setup(
        level=_level(command),
        firmware=TITLES[command.firmware],
        vehicle=Part(command.vehicle, vehicle.description),
        arena=Part(command.arena, arena.description),
        policy=Part(policy.name, policy.description),
        computer=Part(command.computer, computer.description),
        computer_watts=computer.watts,
        injection=injection,
        speed=command.speed if command.lockstep else wall_speed(command),
        between_commands="persist" if hover_s is None else f"hover-after {1e3 * hover_s:g} ms",
    )
    return setup, pilot


def _level(command: SitlCommand) -> Level:
    if command.firmware != "builtin":
        return "firmware"
    return "lockstep" if command.lockstep else "sitl"


def held_label(percent: float) -> str:
    """Return what is flown when the companion is held to a share of a core, in words."""
    return (
        f"native speed of the machine that flew, companion held to {percent:g} % of a core; "
        "nothing injected"
    )


def _flown(command: SitlCommand, policy: PolicyInfo) -> PilotSettings:
    """Return how the policy is flown: as asked, else as its card says, else by default."""
    radius = command.goal_radius
    if radius is None and policy.card is None:
        radius = GOAL_RADIUS_M
    options = PilotOptions(hold_s=command.hold, altitude_m=command.altitude, goal_radius_m=radius)
    return pilot_settings(options, policy)


def wall_speed(command: SitlCommand) -> float:
    """Return the pace of two processes that live by the wall clock."""
    return 1.0 if command.speed is None else command.speed
