"""Evaluation of a policy in seeded episodes, also for model selection."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import CommandKind
from airl_mav.core.errors import UsageError
from airl_mav.envs.fleet import FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.flight.judge import Outcome
from airl_mav.policy.actions import Action, Policy, command_numbers, commands, flyable
from airl_mav.policy.layouts import encode_layout
from airl_mav.policy.learned import LearnedPolicy
from airl_mav.policy.observation import Observation
from airl_mav.policy.observation_spec import Encoded

Decide = Callable[[Encoded], NDArray[Any]]
"""Function from observations of n vehicles to n actions; must treat each row independently."""

SLOTS = 256
"""Default number of parallel flights."""

OUTCOMES = {
    FlightStatus.SUCCESS: Outcome.SUCCESS,
    FlightStatus.COLLISION: Outcome.COLLISION,
    FlightStatus.BATTERY: Outcome.BATTERY,
    FlightStatus.TIMEOUT: Outcome.TIMEOUT,
}
"""Recorded outcome of each verdict of the batch twin."""


@dataclass(frozen=True)
class EpisodeResult:
    """Result of one episode."""

    seed: int
    verdict: FlightStatus
    flight_time_s: float
    distance_m: float
    energy_j: float
    decisions: int


class Pilots(Protocol):
    """Interface of pilots: decide for n vehicles, independently of each other."""

    def begin(self, slot: int, seed: int) -> None:
        """Start an episode in a slot."""

    def decide(self, seen: Observation, flying: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the velocity commands (n, 3) or (n, 4) for `Navigation.fly`.

        Args:
            seen: The observations of n vehicles.
            flying: (n,) vehicles that execute their command.
        """


class LearnedPilots:
    """Pilot with a network, for all vehicles in one batch or one by one as required."""

    def __init__(self, policy: LearnedPolicy, chance: Callable[[int], np.random.Generator]) -> None:
        """Store the policy; `chance` returns the generator of random actions for a seed."""
        self._policy = policy
        self._chance = chance
        # Random actions must be independent of other rows, and memory must be bit-identical to the
        # companion's, which a batch of n rows does not guarantee.
        self._alone = bool(policy.card.epsilon or policy.card.state)
        self._own: dict[int, LearnedPolicy] = {}

    def begin(self, slot: int, seed: int) -> None:
        """Start an episode with a new random generator and empty memory."""
        if self._alone:
            self._own[slot] = self._policy.with_generator(self._chance(seed))

    def decide(self, seen: Observation, flying: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the commands; see `Pilots`.

        Raises:
            UsageError: The network's output contains NaN.
        """
        card = self._policy.card
        encoded = encode_layout(card.observation, seen)
        try:
            if not self._alone:
                return commands(card.actions, self._policy.act_batch(encoded))
            chosen = np.zeros((len(flying), command_numbers(card.actions)))
            for i in np.flatnonzero(flying):
                # One row at a time, so that a row's result does not depend on the others.
                row = {key: array[i : i + 1] for key, array in encoded.items()}
                chosen[i] = commands(card.actions, self._own[int(i)].act_batch(row))[0]
        except ValueError as error:
            raise UsageError(f"policy {card.name}: {error}") from None
        return chosen


class SinglePilots:
    """Pilot with one policy object per vehicle and episode, for policies with memory."""

    def __init__(
        self,
        make: Callable[[], Policy],
        max_speed_m_s: float,
        commands: CommandKind = "velocity",
    ) -> None:
        """Store the policy factory, the speed limit of its actions [m/s], and the command kind."""
        self._make = make
        self._max_speed_m_s = max_speed_m_s
        self._commands: CommandKind = commands
        self._policies: dict[int, Policy] = {}

    def begin(self, slot: int, seed: int) -> None:  # noqa: ARG002
        """Create the episode's policy."""
        self._policies[slot] = self._make()

    def decide(self, seen: Observation, flying: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the commands; see `Pilots`."""
        # NaN in the last column is altitude hold.
        chosen = np.tile((0.0, 0.0, 0.0, math.nan), (len(flying), 1))
        for i in np.flatnonzero(flying):
            asked = self._policies[int(i)].act(seen.rows(int(i)))
            action = flyable(asked, self._commands, self._max_speed_m_s)
            if not isinstance(action, Action):
                chosen[i] = action
                continue
            chosen[i, :3] = action.forward_m_s, action.right_m_s, action.yaw_rate_rad_s
            if action.down_m_s is not None:
                chosen[i, 3] = action.down_m_s
        # Without any vertical speed the commands have three columns.
        return chosen[:, :3] if np.isnan(chosen[:, 3]).all() else chosen


class _EncodedPilots:
    """Pilot that calls a plain function with the environment's encoding."""

    def __init__(
        self, navigation: Navigation, decide: Decide, began: Callable[[int], None] | None
    ) -> None:
        self._navigation = navigation
        self._decide = decide
        self._began = began

    def begin(self, slot: int, seed: int) -> None:  # noqa: ARG002
        """Call the `began` callback, if any."""
        if self._began is not None:
            self._began(slot)

    def decide(self, seen: Observation, flying: NDArray[np.bool_]) -> NDArray[np.float64]:  # noqa: ARG002
        """Return the commands; see `Pilots`."""
        encoded = encode_layout(self._navigation.observation, seen)
        return commands(self._navigation.spec.action_spec, self._decide(encoded))


def fly_episodes(
    spec: EnvironmentSpec,
    decide: Decide,
    seeds: Sequence[int],
    *,
    slots: int = SLOTS,
    zone: int | None = None,
    began: Callable[[int], None] | None = None,
) -> Iterator[EpisodeResult]:
    """Fly one episode per seed and yield each result as it ends, in order of completion.

    An episode's result depends on its seed only, not on parallel flights.

    Args:
        spec: The environment.
        decide: The policy.
        seeds: Seeds of the episodes.
        slots: Number of parallel flights.
        zone: Curriculum zone that bounds the goals; None = the largest.
        began: Callback with the slot of each starting episode, for policies with memory.
    """
    if not seeds:
        return
    navigation = Navigation(spec, min(slots, len(seeds)))
    pilots = _EncodedPilots(navigation, decide, began)
    for _, flown in fly_seeds(navigation, pilots, seeds, zone=zone):
        yield flown


def fly_seeds(
    navigation: Navigation,
    pilots: Pilots,
    seeds: Sequence[int],
    *,
    zone: int | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[int, EpisodeResult]]:
    """Fly one episode per seed and yield slot and result of each as it ends.

    The slot keeps the flight's final state until the next item is requested.

    Args:
        navigation: Must not have more slots than seeds.
        pilots: Pilots of all vehicles.
        seeds: Seeds of the episodes.
        zone: Curriculum zone that bounds the goals; None = the largest.
        stop: Called before each decision; if True, iteration ends without the unfinished flights.
    """
    n = navigation.n
    waiting = list(reversed(seeds))
    decisions = np.zeros(n, np.int64)
    busy = np.zeros(n, np.bool_)

    def begin(slots: Sequence[int]) -> None:
        # The list is reversed, so `pop` returns the seeds in order.
        taken = [waiting.pop() for _ in slots]
        navigation.begin(slots, taken, zone)
        for slot, seed in zip(slots, taken, strict=True):
            pilots.begin(slot, seed)
        decisions[slots] = 0
        busy[slots] = True

    begin(range(n))
    while busy.any() and not stop():
        navigation.fly(pilots.decide(navigation.see(), busy))
        decisions += 1
        now = navigation.flights()
        ended = np.flatnonzero(busy & (now.verdict != FlightStatus.FLYING)).tolist()
        for i in ended:
            busy[i] = False
            yield (
                i,
                EpisodeResult(
                    seed=int(navigation.seeds[i]),
                    verdict=FlightStatus(int(now.verdict[i])),
                    flight_time_s=float(now.time_s[i]),
                    distance_m=float(now.distance_m[i]),
                    energy_j=float(now.energy_j[i]),
                    decisions=int(decisions[i]),
                ),
            )
        # Slots restart only after all results of this decision have been consumed.
        if ended and waiting:
            begin(ended[: len(waiting)])


def success_rate(flown: Sequence[EpisodeResult]) -> float:
    """Return the share of episodes that reached the goal."""
    return sum(each.verdict == FlightStatus.SUCCESS for each in flown) / len(flown)


def mean_of_successes(flown: Iterable[EpisodeResult], quality: str) -> float | None:
    """Return the mean of a field over the episodes that reached the goal; None without one."""
    good = [getattr(each, quality) for each in flown if each.verdict == FlightStatus.SUCCESS]
    return float(np.mean(good)) if good else None
