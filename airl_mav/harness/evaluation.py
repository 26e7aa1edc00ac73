"""An evaluation at level gym: seeded episodes in the batch twin, one run folder."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from airl_mav.arena.geometry import Arena, Shape
from airl_mav.constants import US_PER_S
from airl_mav.envs.contact import FLOOR, WALL
from airl_mav.envs.evaluation import OUTCOMES, Flown, Pilots, fly_seeds
from airl_mav.envs.navigation import Flights, Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.envs.trace import Trace
from airl_mav.errors import UsageError
from airl_mav.flight.judge import Outcome
from airl_mav.flight.quality import measure_quality
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.setup import Setup
from airl_mav.harness.chunks import Episode, save_episodes
from airl_mav.harness.run_folder import RUN_FILE, RunFolder, load
from airl_mav.latency.injection import Injection

CHUNK = 100
"""Episodes that are saved at a time: a kill loses no more, and saving costs next to nothing."""

LEAVES_RESULTS_ALONE = ("slots", "policy_path")
"""Settings that may change when a run is taken up again."""


@dataclass(frozen=True)
class GymPlan:
    """Everything an evaluation at level gym needs to know."""

    environment: EnvironmentSpec
    injection: Injection
    """Where t2 is drawn from."""
    setup: Setup
    seeds: tuple[int, ...]
    """Seed of each episode, by index; no two the same."""
    config: Mapping[str, Any]
    """Every setting, as plain values."""
    slots: int
    """Flights at a time; decides nothing."""


def open_folder(
    out: Path | None, name: str, plan: GymPlan
) -> tuple[RunFolder, tuple[EpisodeRecord, ...]]:
    """Open the folder of a plan: a new one, or one that holds the same run, finished or not.

    Returns:
        The folder, and the episodes that it holds.

    Raises:
        UsageError: It holds another run.
    """
    if out is None or not (out / RUN_FILE).exists():
        folder = RunFolder.create(out, name, plan.config, setup=plan.setup, seeds=plan.seeds)
        return folder, ()
    if (difference := another_config(load(out).info.config, plan.config)) is not None:
        raise UsageError(
            f"--out {out}: holds a run with {difference}; accepted: a new folder, or the same "
            "settings to go on"
        )
    folder, run = RunFolder.resume(out)
    folder.sweep()
    return folder, run.episodes


def another_config(held: Mapping[str, Any], asked: Mapping[str, Any]) -> str | None:
    """Return the first setting in which two configurations differ, or None when they do not."""
    old, new = _flat(held), _flat(json.loads(json.dumps(asked)))
    for key in sorted(old.keys() | new.keys()):
        if key not in LEAVES_RESULTS_ALONE and old.get(key) != new.get(key):
            return f"{key} = {old.get(key)!r}, not {new.get(key)!r}"
    return None


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the settings by their dotted names."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def fly_plan(
    plan: GymPlan,
    folder: RunFolder,
    pilots: Pilots,
    done: Sequence[EpisodeRecord],
    finished: Callable[[EpisodeRecord], None],
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Fly what is left of a plan, and save it.

    Args:
        plan: The plan.
        folder: Where everything goes.
        pilots: Who decides.
        done: Episodes that lie there already.
        finished: Is told of each episode as it ends.
        stop: Asked before each decision; True ends it all, with what has ended kept.

    Raises:
        UsageError: No arena can be made of a seed; what was flown before is kept.
    """
    index_of = {seed: index for index, seed in enumerate(plan.seeds)}
    for record in done:
        index_of.pop(record.seed, None)
    if not index_of:
        return
    slots = min(plan.slots, len(index_of))
    trace = Trace(slots)
    navigation = Navigation(plan.environment, slots, injection=plan.injection, trace=trace)
    ended: list[Episode] = []
    try:
        for slot, flown in fly_seeds(navigation, pilots, list(index_of), stop=stop):
            episode = _episode(plan, navigation, trace, slot, flown, index_of[flown.seed])
            ended.append(episode)
            finished(episode.record)
            if len(ended) >= CHUNK:
                save_episodes(folder, ended)
                ended = []
    finally:
        if ended:
            save_episodes(folder, ended)


def _episode(
    plan: GymPlan, navigation: Navigation, trace: Trace, slot: int, flown: Flown, index: int
) -> Episode:
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
        arena_seed=flown.seed,
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
        quality=measure_quality(trajectory, 0, ended_us, plan.setup.computer_watts),
    )
    return Episode(record, trajectory, trace.latency(slot))


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
