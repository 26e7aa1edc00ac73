"""Resolution of a scenario, with all content loaded: reads profiles and policy exactly once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from airl_mav.arena.geometry import Arena
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import Level
from airl_mav.core.errors import FieldError
from airl_mav.core.first_start import CompileJob, CompilePlan, compile_shown
from airl_mav.core.frames import Goal
from airl_mav.flight import episode_record, judge
from airl_mav.latency.injection import (
    FixedSampler,
    Injection,
    LatencySampler,
    latency_generator,
    select_injection,
    without_timing,
)
from airl_mav.policy import actions, registry
from airl_mav.prediction import Compensator
from airl_mav.profiles import camera, loading, projections
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.computer import ComputerProfile
from airl_mav.profiles.vehicle import VehicleProfile, check_spread, equipped
from airl_mav.scenario import checks
from airl_mav.scenario.aircraft import FirmwareName, PlantName
from airl_mav.scenario.model import PilotSettings, Scenario, WatchdogSettings, anchored

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


def vectorized_plan(kind: projections.CameraKind) -> CompilePlan:
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


def resolve(scenario: Scenario, policy: registry.PolicyInfo | None = None) -> ResolvedScenario:
    """Validate a scenario before anything starts, and load all referenced profiles.

    `policy` replaces the scenario's. Raises UsageError if fields contradict each other, a profile
    or the policy cannot be used, or the first seed has no valid arena. `FieldError`s name the
    field.
    """
    checks.check_level(scenario)
    if scenario.level != "gym":
        checks.check_plant(scenario)
    checks.check_firmware(scenario, scenario.level, scenario.speed)
    checks.check_start(scenario)
    if scenario.level == "sitl":
        # The companion connects to the camera by its number: 0, any free port, is invalid here.
        checks.check_ports(scenario.open_ports, any_camera=False)
    policy = policy or registry.find_policy(scenario.policy, trust=scenario.trust)
    checks.check_commands(policy, scenario.policy, level=scenario.level, firmware=scenario.firmware)
    pilot, watchdog = checks.decide_piloting(scenario, policy, judge.GOAL_RADIUS_M)
    vehicle, computer = equipped(
        scenario.vehicle, scenario.computer, scenario.payload, scenario.px4_release
    )
    check_spread(vehicle, scenario.spread)
    further = vehicle.cameras.values()
    camera.check_noise(vehicle.camera, scenario.sensors, scenario.faults, further=further)
    checks.check_fitted(vehicle.sensors, scenario.faults)
    if reason := registry.camera_refused(policy, vehicle):
        raise FieldError(
            "policy", scenario.policy, problem=f"does not fit vehicle {scenario.vehicle}: {reason}"
        )
    checks.check_compensated(pilot, policy, vehicle)
    arena = loading.load_profile("arenas", scenario.arena, ArenaSpec)
    injection = select_injection(
        scenario.latency, computer, scenario.workload, policy_sha256=policy.sha256, macs=policy.macs
    )
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
    checks.check_goal_height(policy, goal, "arena", scenario.arena)
    if policy.asked is None:
        resolved.fresh_policy(scenario.seed)
    resolved.compensator()
    return resolved


def _labelled(injection: Injection, scenario: Scenario) -> Injection:
    """Return the latency with the label that the level's report uses."""
    if scenario.level == "sitl":
        return injection
    return without_timing(injection, checks.NATIVE_T2_US / 1e3, scenario.level)


HOVER_START_S = 0.3
"""Time from the start in a hover to navigation: connection and switch to offboard [s]."""

BEFORE_CLIMB_S = 9.2
"""Take-off time of the built-in autopilot without the climb [s]: booting, arming, spinning up,
slowing down. 150 take-offs to 2.5 m took 10.6 to 11.2 s, 10.88 s on average."""

ARRIVAL_SHARE = 0.8
"""Share of the goal radius to which the companion flies: it uses the estimated position, the
referee the true one."""

FIRMWARE_TITLES: dict[FirmwareName, str] = {
    "builtin": f"{episode_record.BUILT_IN}, as PX4 {{release}}",
    "px4": "PX4 SITL",
    "ardupilot": "ArduPilot SITL",
    "px4-hitl": "PX4 on a board",
    "attach": "vehicle elsewhere",
}


@dataclass(frozen=True)
class PlannedEpisode:
    """Episode to be flown."""

    index: int
    seed: int


@dataclass(frozen=True)
class ResolvedScenario:
    """Validated scenario, and the content of every referenced profile."""

    scenario: Scenario
    vehicle: VehicleProfile
    """Vehicle with its computer and payload."""
    arena: ArenaSpec
    computer: ComputerProfile
    policy: registry.PolicyInfo
    injection: Injection
    """Source of t2."""
    pilot: PilotSettings
    """Flight settings of the policy; the goal radius is the referee's."""
    watchdog: WatchdogSettings
    """Watchdog bounds, with the policy card's hover setting."""

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seed of each episode, by index."""
        return self.scenario.seeds

    def left(self, done: Iterable[episode_record.EpisodeRecord] = ()) -> list[PlannedEpisode]:
        """Return the episodes that are not in `done`."""
        there = {record.index for record in done}
        return [PlannedEpisode(i, seed) for i, seed in enumerate(self.seeds) if i not in there]

    @property
    def config(self) -> dict[str, Any]:
        """Recorded settings of a run, as plain values.

        The scenario with absolute paths and resolved defaults, so that a default equals the same
        explicit value; and the content of profiles and policy, because a name does not reveal
        changes.
        """
        pilot = asdict(self.pilot)
        if pilot["commands"] == "velocity":
            # Compatible with versions before other command kinds.
            del pilot["commands"]
        profiles: dict[str, BaseModel] = {
            "vehicle": self.vehicle,
            "arena": self.arena,
            "computer": self.computer,
        }
        if self.injection.latency is not None:
            profiles["latency"] = self.injection.latency
        return {
            **anchored(self.scenario).model_dump(mode="json", exclude=set(pilot)),
            "speed": self.speed,
            "px4_release": self.vehicle.px4_release,
            "pilot": pilot,
            "watchdog": self.watchdog.model_dump(mode="json"),
            # The body includes the load, which the profile lacks.
            "vehicle_body": self.vehicle.body.model_dump(),
            "policy_sha256": self.policy.sha256,
            "profiles_sha256": {
                kind: loading.profile_digest(profile) for kind, profile in profiles.items()
            },
        }

    @property
    def level(self) -> Level:
        """Fidelity level in reports."""
        real = self.scenario.firmware != "builtin"
        return "firmware" if real else self.scenario.level

    @property
    def speed(self) -> float | None:
        """Simulated seconds per wall second; None without pacing."""
        scenario = self.scenario
        if scenario.level == "sitl":
            return 1.0 if scenario.speed is None else scenario.speed
        return scenario.speed if scenario.level == "lockstep" else None

    @property
    def companion_pilot(self) -> PilotSettings:
        """Flight settings of the companion, with a smaller goal radius than the referee's.

        For a vehicle without GPS, they include the known origin.
        """
        origin = self.pilot.origin
        if origin is None and (told := self.vehicle.told_origin) is not None:
            origin = told.latitude_deg, told.longitude_deg, told.altitude_m
        return replace(
            self.pilot,
            goal_radius_m=ARRIVAL_SHARE * self.pilot.goal_radius_m,
            origin=origin,
        )

    @property
    def takeoff_s(self) -> float:
        """Approximate duration of a take-off [s]; 0 at level gym, which has none."""
        if self.scenario.level == "gym":
            return 0.0
        if self.scenario.start == "hover":
            return HOVER_START_S
        climb_m_s = self.vehicle.flown_parameters()["MPC_TKO_SPEED"]
        return BEFORE_CLIMB_S + self.pilot.altitude_m / climb_m_s

    def arena_of(self, seed: int) -> Arena:
        """Return the arena of the episode of a seed. Raises UsageError if generation fails.

        Moving obstacles start the seed's tours when navigation begins, to the precision known
        beforehand. The same seed gives the same scene at every level.
        """
        # Late import of scipy, which a companion does not need.
        from airl_mav.arena.generate import generate
        from airl_mav.arena.tours import set_out_later

        arena = generate(
            self.arena,
            self.scenario.arena_seed_of(seed),
            name=self.scenario.arena,
            vehicle_width_m=self.vehicle.body.width_m,
            zone=self.scenario.zone,
        )
        return set_out_later(arena, self.takeoff_s)

    def task(self, goal: Goal) -> judge.Task:
        """Return the referee's task for a flight to a goal."""
        return judge.Task(goal, self.pilot.goal_radius_m, self.scenario.time_limit_s)

    @property
    def rules(self) -> str:
        """Rules of an episode, as text for reports."""
        pilot = self.pilot
        return (
            f"goal radius {pilot.goal_radius_m:g} m, hold {pilot.hold_s:g} s, "
            f"height {pilot.altitude_m:g} m, time limit {self.scenario.time_limit_s:g} s"
        )

    @property
    def setup(self) -> episode_record.Setup:
        """Setup for the head of every report."""
        scenario, hover_s = self.scenario, self.watchdog.hover_after_s
        without = f" (its input {scenario.ablate!r} made zero)" if scenario.ablate else ""
        return episode_record.Setup(
            level=self.level,
            firmware=FIRMWARE_TITLES[scenario.firmware].format(release=self.vehicle.px4_release),
            vehicle=episode_record.Part(scenario.vehicle, self.vehicle.description),
            arena=episode_record.Part(scenario.arena, self.arena.description),
            policy=episode_record.Part(self.policy.name, f"{self.policy.description}{without}"),
            computer=episode_record.Part(scenario.computer, self.computer.description),
            computer_watts=self.computer.onboard_watts,
            computer_on_ground=self.computer.ground_equipment,
            injection=self.injection,
            speed=self.speed,
            between_commands=checks.between_commands(self.pilot, hover_s),
            conditions=", ".join(self._conditions()),
        )

    def _conditions(self) -> Iterator[str]:
        """Yield each non-default condition of the flights: field and value."""
        scenario = self.scenario
        for table in ("payload", "wind", "spread", "sensors"):
            for name, value in getattr(scenario, table).model_dump(exclude_defaults=True).items():
                yield f"{table}.{name} {value:g}"
        if scenario.battery_charge < 1.0:
            yield f"battery_charge {scenario.battery_charge:g}"
        yield from (f"fault: {fault}" for fault in scenario.faults)
        # Level gym has no plant.
        if self.level != "gym" and scenario.plant != "pybullet":
            yield f"plant {scenario.plant}"
        if (zone := scenario.zone) is not None:
            yield f"zone {zone} (goals within {self.arena.zones_m[zone]:g} m)"

    @property
    def pack_j(self) -> float:
        """Initial energy of the battery [J]."""
        return self.vehicle.battery.energy_j(self.scenario.battery_charge)

    @property
    def arena_name(self) -> str:
        """Name of the arena without its path."""
        return Path(self.scenario.arena).stem

    def latency_sampler(self, seed: int, *, native: bool) -> LatencySampler | None:
        """Return the source of t2 for a seed's episode.

        With native timing (`native`), None means no injection. Otherwise the default t2 is a
        desktop computer's.
        """
        sampler = self.injection.sampler(latency_generator(seed, self.scenario.latency_seed))
        return sampler if native else sampler or FixedSampler(checks.NATIVE_T2_US)

    def compensator(self) -> Compensator | None:
        """Return the compensator of a companion, or None. Raises FieldError."""
        if not self.pilot.compensate:
            return None
        return Compensator(1, self.vehicle, Intrinsics.of(self.vehicle.camera))

    def fresh_policy(self, seed: int) -> actions.Policy:
        """Return the policy at the start of a seed's flight. Raises UsageError."""
        loaded = self._loaded_policy
        if isinstance(loaded, registry.LearnedPolicy):
            return loaded.with_generator(checks.action_generator(seed))
        return self._load_policy()

    @cached_property
    def _loaded_policy(self) -> actions.Policy:
        """Policy, with its network loaded once."""
        return self._load_policy()

    def _load_policy(self) -> actions.Policy:
        scenario = self.scenario
        return checks.load_asked_policy(scenario, self.policy, self.pilot.hold_s, scenario.seed)

    def __getstate__(self) -> dict[str, Any]:
        """Exclude the loaded network: each process opens a new one."""
        return {key: value for key, value in self.__dict__.items() if key != "_loaded_policy"}
