"""An evaluation at level gym: the batch twin flies many episodes at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from airl_mav.arena.geometry import Arena, Shape
from airl_mav.core.constants import US_PER_S
from airl_mav.envs.contact import FLOOR, WALL
from airl_mav.envs.evaluation import OUTCOMES, Flown, Pilots, fly_seeds
from airl_mav.envs.navigation import Flights, Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.envs.trace import Trace
from airl_mav.flight.judge import Outcome
from airl_mav.flight.quality import measure_quality
from airl_mav.flight.record import EpisodeRecord
from airl_mav.latency.injection import Injection
from airl_mav.rehearsal.episode_saver import EpisodeSaver
from airl_mav.rehearsal.evaluation import Evaluation, Watch
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder


@dataclass(frozen=True)
class GymPlan:
    """Everything an evaluation at level gym needs to know."""

    evaluation: Evaluation
    environment: EnvironmentSpec
    injection: Injection
    """Where t2 is drawn from."""
    slots: int
    """Flights at a time; decides nothing."""
    latency_draw: int = 0
    """See `samplers.latency_generator`."""
    arena_seed: int | None = None
    """Of the arena of all episodes; None: each one's own seed."""


def fly_gym(
    plan: GymPlan, pilots: Pilots, folder: RunFolder, done: Sequence[EpisodeRecord], watch: Watch
) -> None:
    """Fly what is left of a plan, and save it.

    Args:
        plan: The plan.
        pilots: Who decides.
        folder: Where everything goes.
        done: Episodes that lie there already.
        watch: Who looks on; may stop it before each decision.

    Raises:
        UsageError: No arena can be made of a seed; what was flown before is kept.
    """
    index_of = {job.seed: job.index for job in plan.evaluation.jobs(done)}
    if not index_of:
        return
    slots = min(plan.slots, len(index_of))
    trace = Trace(slots)
    navigation = Navigation(
        plan.environment,
        slots,
        injection=plan.injection,
        latency_draw=plan.latency_draw,
        arena_seed=plan.arena_seed,
        trace=trace,
    )
    with EpisodeSaver(folder) as saver:
        for slot, flown in fly_seeds(navigation, pilots, list(index_of), stop=watch.stop):
            episode = _episode(plan, navigation, trace, slot, flown, index_of[flown.seed])
            saver.add(episode)
            watch.finished(episode.record)


def _episode(
    plan: GymPlan, navigation: Navigation, trace: Trace, slot: int, flown: Flown, index: int
) -> FlownEpisode:
    """Return the flight whose end its slot still shows."""
    arena, rules = navigation.arenas[slot], plan.environment.episode
    assert arena is not None  # noqa: S101 (it has just been flown in)
    outcome = OUTCOMES[flown.verdict]
    flights, trajectory = navigation.flights(), trace.trajectory(slot)
    ended_us = round(flown.flight_time_s * US_PER_S)
    record = EpisodeRecord(
        index=index,
        seed=flown.seed,
        arena=plan.environment.arena,
        arena_seed=flown.seed if plan.arena_seed is None else plan.arena_seed,
        outcome=outcome,
        reason=_reason(outcome, flights, slot, arena, rules.time_limit_s),
        goal=(float(arena.goal[0]), float(arena.goal[1])),
        goal_radius_m=rules.goal_radius_m,
        time_limit_s=rules.time_limit_s,
        # The twin begins in a hover above the start: there is no take-off.
        started_us=0,
        navigation_us=0,
        ended_us=ended_us,
        wall_s=None,
        slipped_us=0,
        battery_remaining=float(flights.battery[slot]),
        quality=measure_quality(trajectory, 0, ended_us, plan.evaluation.setup.computer_watts),
    )
    return FlownEpisode(record, trajectory, trace.latency(slot))


def _reason(outcome: Outcome, flights: Flights, slot: int, arena: Arena, limit_s: float) -> str:
    """Return why a flight ended, in the referee's words."""
    if outcome is Outcome.COLLISION:
        return f"hit {_name(arena, int(flights.touched[slot]))}"
    if outcome is Outcome.BATTERY:
        return "battery empty"
    away = f"{flights.goal_distance_m[slot]:.2f} m from the goal"
    return away if outcome is Outcome.SUCCESS else f"{away} after {limit_s:g} s"


def _name(arena: Arena, touched: int) -> str:
    """Return what was hit, as the plant calls it."""
    if touched in (FLOOR, WALL):
        return "floor" if touched == FLOOR else "wall"
    moving = "moving" if touched >= arena.n_static else "static"
    return f"{moving}-{Shape(int(arena.obstacles.shape[touched])).name.lower()}-{touched}"
