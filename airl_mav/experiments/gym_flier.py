"""Level gym: the batch twin flies many episodes at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from airl_mav.arena.geometry import Arena, Shape
from airl_mav.core.constants import US_PER_S
from airl_mav.envs.contact import FLOOR, WALL
from airl_mav.envs.evaluation import OUTCOMES, Flown, Pilots, fly_seeds
from airl_mav.envs.navigation import Flights, Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.envs.trace import Trace
from airl_mav.experiments.campaign import FlyEpisodes
from airl_mav.experiments.executors import Stop
from airl_mav.flight.judge import Outcome
from airl_mav.flight.quality import measure_quality
from airl_mav.flight.record import EpisodeRecord
from airl_mav.latency.injection import Injection
from airl_mav.rehearsal.evaluation import PlannedEpisode
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder

BLOCK_SLOTS = 4
"""Episodes a job and slot: in a shorter job most slots would wait for the longest flights."""


@dataclass(frozen=True)
class GymFlier:
    """Flies the episodes of a cell in the batch twin. Implements `campaign.Flier`.

    A flight depends on its seed alone, not on the slots or on what flies beside it.
    """

    environment: EnvironmentSpec
    injection: Injection
    """Where t2 is drawn from."""
    computer_watts: float
    """Power of the onboard computer [W]."""
    pilots: Callable[[], Pilots]
    """Loads whoever decides. Goes to workers by pickle."""
    slots: int
    """Flights at a time."""
    latency_draw: int = 0
    """See `samplers.latency_generator`."""
    arena_seed: int | None = None
    """Of the arena of all episodes; None: each one's own seed."""

    def episodes_per_job(self, episodes: int, workers: int) -> int:
        """Return how many episodes make a job; see `campaign.Flier`."""
        return max(1, min(BLOCK_SLOTS * self.slots, math.ceil(episodes / workers)))

    def start(self, folder: RunFolder, stop: Stop) -> FlyEpisodes:  # noqa: ARG002 (no logs here)
        """Load the policy; see `campaign.Flier`."""
        pilots = self.pilots()

        def fly(episodes: Sequence[PlannedEpisode]) -> Iterator[FlownEpisode]:
            index_of = {episode.seed: episode.index for episode in episodes}
            slots = min(self.slots, len(index_of))
            trace = Trace(slots)
            navigation = Navigation(
                self.environment,
                slots,
                injection=self.injection,
                latency_draw=self.latency_draw,
                arena_seed=self.arena_seed,
                trace=trace,
            )
            for slot, flown in fly_seeds(navigation, pilots, list(index_of), stop=stop):
                yield self._episode(navigation, trace, slot, flown, index_of[flown.seed])

        return fly

    def _episode(
        self, navigation: Navigation, trace: Trace, slot: int, flown: Flown, index: int
    ) -> FlownEpisode:
        """Return the flight whose end its slot still shows."""
        arena, rules = navigation.arenas[slot], self.environment.episode
        assert arena is not None  # noqa: S101 (it has just been flown in)
        outcome = OUTCOMES[flown.verdict]
        flights, trajectory = navigation.flights(), trace.trajectory(slot)
        ended_us = round(flown.flight_time_s * US_PER_S)
        record = EpisodeRecord(
            index=index,
            seed=flown.seed,
            arena=self.environment.arena,
            arena_seed=flown.seed if self.arena_seed is None else self.arena_seed,
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
            quality=measure_quality(trajectory, 0, ended_us, self.computer_watts),
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
