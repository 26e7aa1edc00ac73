"""Fly a policy through seeded episodes: what evaluation and model selection rest on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.envs.fleet import Verdict
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy.action_sets import commands
from airl_mav.policy.layouts import Encoded

Decide = Callable[[Encoded], NDArray[Any]]
"""From the observations of n vehicles to their n actions; must treat each one for itself."""

SLOTS = 256
"""Flights at a time."""


@dataclass(frozen=True)
class Flown:
    """How one episode went."""

    seed: int
    verdict: Verdict
    flight_time_s: float
    distance_m: float
    energy_j: float
    decisions: int


def fly_episodes(
    spec: EnvironmentSpec,
    decide: Decide,
    seeds: Sequence[int],
    *,
    slots: int = SLOTS,
    zone: int | None = None,
) -> Iterator[Flown]:
    """Fly one episode a seed and yield each as it ends, in the order in which they end.

    An episode's result depends on its seed alone, not on what flies beside it.

    Args:
        spec: The environment.
        decide: The policy.
        seeds: Of the episodes.
        slots: Flights at a time.
        zone: Curriculum zone that bounds the goals; None is the largest.
    """
    waiting = list(seeds)
    n = min(slots, len(waiting))
    if n == 0:
        return
    navigation = Navigation(spec, n)
    navigation.begin(range(n), waiting[:n], zone)
    del waiting[:n]
    decisions = np.zeros(n, np.int64)
    busy = np.ones(n, np.bool_)
    while busy.any():
        actions = decide(navigation.observe())
        navigation.fly(commands(spec.action_spec, actions))
        decisions += 1
        now = navigation.flights()
        for i in np.flatnonzero(busy & (now.verdict != Verdict.FLYING)):
            yield Flown(
                seed=int(navigation.seeds[i]),
                verdict=Verdict(int(now.verdict[i])),
                flight_time_s=float(now.time_s[i]),
                distance_m=float(now.distance_m[i]),
                energy_j=float(now.energy_j[i]),
                decisions=int(decisions[i]),
            )
            busy[i] = bool(waiting)
            if waiting:
                navigation.begin([int(i)], [waiting.pop(0)], zone)
                decisions[i] = 0


def success_rate(flown: Sequence[Flown]) -> float:
    """Return the share of the episodes that reached the goal."""
    return sum(each.verdict == Verdict.SUCCESS for each in flown) / len(flown)
