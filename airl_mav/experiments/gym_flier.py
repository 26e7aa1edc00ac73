"""Flier of level gym: many episodes in parallel in the vectorized simulator."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from airl_mav import faults, prediction
from airl_mav.arena.geometry import Arena
from airl_mav.core import constants, machine
from airl_mav.envs.arena_batch import CEILING, FLOOR, WALL
from airl_mav.envs.evaluation import (
    OUTCOMES,
    EpisodeResult,
    LearnedPilots,
    Pilots,
    SinglePilots,
    Trace,
    fly_seeds,
)
from airl_mav.envs.faults import acted
from airl_mav.envs.fleet import FlightArrays
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from airl_mav.experiments.executors import FlyEpisodes, Stop
from airl_mav.flight.episode_record import EpisodeRecord, FaultActed
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import measure_quality
from airl_mav.policy.observation_spec import ObservationSpec, SeenCamera
from airl_mav.policy.registry import LearnedPolicy
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
from airl_mav.scenario import checks, resolve

BLOCK_SLOTS = 4
"""Episodes per job and slot: in shorter jobs most slots would wait for the longest flights."""


def environment_of(scenario: resolve.ResolvedScenario) -> EnvironmentSpec:
    """Return the vectorized simulator's environment for a scenario."""
    asked, card = scenario.scenario, scenario.policy.card
    shape: dict[str, Any]
    if card is None:
        # Policies without a card use the camera's native resolution.
        camera = scenario.vehicle.camera
        shape = {"image_width_px": camera.width_px, "image_height_px": camera.height_px}
        if scenario.policy.program is not None:
            shape["cameras"] = {name: {} for name in scenario.vehicle.cameras}
    else:
        seen, actions = card.observation, card.actions
        shape = {
            **_image_of(seen),
            **{name: getattr(seen, name) for name in ("layout", "in_flight", "goal_height")},
            "actions": actions.set,
            "max_speed_m_s": actions.max_speed_m_s,
            "max_rate_deg_s": actions.max_rate_deg_s,
            "cameras": {name: _image_of(each) for name, each in seen.cameras.items()},
        }
    pilot = scenario.pilot
    episode = {
        "goal_radius_m": pilot.goal_radius_m,
        "time_limit_s": asked.time_limit_s,
        "hold_s": pilot.hold_s,
        "hover_after_s": scenario.watchdog.hover_after_s,
        "altitude_m": pilot.altitude_m,
    }
    # The vectorized simulator repeats velocity commands without a timeout.
    if pilot.commands == "body_rates":
        episode["decision_timeout_s"] = scenario.watchdog.decision_timeout_s
    return spec_of(
        None,
        {
            "vehicle": asked.vehicle,
            "arena": asked.arena,
            **shape,
            "episode": episode,
            "delay": {
                "computer": asked.computer,
                "workload": asked.workload,
                "latency": () if asked.latency is None else (asked.latency,),
            },
            "decisions": pilot.decisions,
            "compensate": pilot.compensate,
            "wind": asked.wind,
            "randomisation": asked.spread.model_dump() | asked.sensors.model_dump(),
        },
    )


def _image_of(seen: ObservationSpec | SeenCamera) -> dict[str, int]:
    """Return size and number of images of a camera, as fields of an environment."""
    width_px, height_px = seen.width_px, seen.height_px
    return {"image_width_px": width_px, "image_height_px": height_px, "frames": seen.frames}


def navigation_of(
    scenario: resolve.ResolvedScenario,
    slots: int,
    *,
    trace: Trace | None = None,
    compensator: prediction.Compensator | None = None,
) -> Navigation:
    """Return the vectorized simulator of a scenario, `slots` flights in parallel, or UsageError."""
    asked = scenario.scenario
    return Navigation(
        environment_of(scenario),
        slots,
        vehicle=scenario.vehicle,
        arena=scenario.arena,
        injection=scenario.injection,
        latency_draw=asked.latency_seed,
        arena_seed=asked.arena_seed,
        trace=trace,
        computer_w=scenario.computer.onboard_watts,
        battery_charge=asked.battery_charge,
        compensator=compensator,
        faults=asked.faults,
        commands=scenario.pilot.commands,
    )


@dataclass(frozen=True)
class GymFlier:
    """Flier in the vectorized simulator; results do not depend on the slots. Implements `Flier`."""

    scenario: resolve.ResolvedScenario

    def __post_init__(self) -> None:
        """Raise UsageError for settings that the vectorized simulator does not support."""
        environment = environment_of(self.scenario)
        pipelined = environment.decisions == "pipelined"
        faults.check_gym(self.scenario.scenario.faults, pipelined=pipelined)

    def episodes_per_job(self, episodes: int, workers: int) -> int:
        """Return the episodes per job; see `executors.Flier`."""
        return max(
            1, min(BLOCK_SLOTS * self.scenario.scenario.slots, math.ceil(episodes / workers))
        )

    def start(self, folder: RunFolder, stop: Stop) -> FlyEpisodes:  # noqa: ARG002 (no logs here)
        """Load the policy; see `executors.Flier`."""
        scenario = self.scenario
        pilots = pilots_of(scenario)

        def fly(episodes: Sequence[resolve.PlannedEpisode]) -> Iterator[FlownEpisode]:
            index_of = {episode.seed: episode.index for episode in episodes}
            slots = min(scenario.scenario.slots, len(index_of))
            trace = Trace(slots, scenario.pilot.commands)
            navigation = navigation_of(scenario, slots, trace=trace)
            zone = scenario.scenario.zone
            for slot, flown in fly_seeds(navigation, pilots, list(index_of), zone=zone, stop=stop):
                yield self._episode(navigation, trace, slot, flown, index_of[flown.seed])

        return fly

    def _episode(
        self, navigation: Navigation, trace: Trace, slot: int, flown: EpisodeResult, index: int
    ) -> FlownEpisode:
        """Return the finished flight in a slot."""
        arena, rules = navigation.arenas[slot], navigation.spec.episode
        assert arena is not None  # noqa: S101 (it has just been flown in)
        outcome = OUTCOMES[flown.verdict]
        flights, trajectory = navigation.flights(), trace.trajectory(slot)
        latency = trace.latency(slot)
        ended_us = round(flown.flight_time_s * constants.US_PER_S)
        record = EpisodeRecord(
            index=index,
            seed=flown.seed,
            arena=self.scenario.scenario.arena,
            arena_seed=self.scenario.scenario.arena_seed_of(flown.seed),
            zone=self.scenario.scenario.zone,
            outcome=outcome,
            reason=flown.failure or _reason(outcome, flights, slot, arena, rules.time_limit_s),
            goal=arena.goal_point,
            goal_radius_m=rules.goal_radius_m,
            time_limit_s=rules.time_limit_s,
            # The vectorized simulator starts in a hover above the start, without a take-off.
            started_us=0,
            navigation_us=0,
            ended_us=ended_us,
            wall_s=None,
            slipped_us=0,
            battery_remaining=float(flights.battery[slot]),
            quality=measure_quality(
                trajectory,
                0,
                ended_us,
                self.scenario.computer.onboard_watts,
                self.scenario.pack_j,
                decisions=latency,
                hold_s=rules.hold_s,
            ),
            faults=tuple(
                FaultActed(*each) for each in acted(self.scenario.scenario.faults, ended_us)
            ),
            code=machine.code_now(),
        )
        return FlownEpisode(record, trajectory, latency)


def pilots_of(scenario: resolve.ResolvedScenario) -> Pilots:
    """Return the pilots of all vehicles."""
    loaded = scenario.fresh_policy(scenario.scenario.seed)
    if isinstance(loaded, LearnedPolicy):
        # With the companion's random generator.
        return LearnedPilots(loaded, checks.action_generator)
    seed = scenario.scenario.seed
    pilot = scenario.pilot
    return SinglePilots(lambda: scenario.fresh_policy(seed), pilot.max_speed_m_s, pilot.commands)


def _reason(
    outcome: Outcome, flights: FlightArrays, slot: int, arena: Arena, limit_s: float
) -> str:
    """Return the reason for a flight's end, in the referee's words."""
    if outcome is Outcome.COLLISION:
        return f"hit {_name(arena, int(flights.touched[slot]))}"
    if outcome is Outcome.BATTERY:
        return "battery empty"
    away = f"{flights.goal_distance_m[slot]:.2f} m from the goal"
    return away if outcome is Outcome.SUCCESS else f"{away} after {limit_s:g} s"


def _name(arena: Arena, touched: int) -> str:
    """Return the name of the object that was hit, as in the plant."""
    room = {FLOOR: "floor", WALL: "wall", CEILING: "ceiling"}
    return room[touched] if touched in room else arena.name_of(touched)
