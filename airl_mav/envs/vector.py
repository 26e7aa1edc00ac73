"""`airl/Navigation-v0`, n at a time, in Gymnasium's vector API."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from airl_mav.core.errors import UsageError
from airl_mav.envs.curriculum import CurriculumState
from airl_mav.envs.delay import bounded
from airl_mav.envs.fleet import Verdict
from airl_mav.envs.navigation import Flights, Navigation
from airl_mav.envs.rewards import DecisionOutcome, rewards
from airl_mav.envs.saved_state import (
    State,
    Stateful,
    pack,
    pack_generators,
    saved_array,
    state_of_part,
    unpack,
    unpack_generators,
)
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from airl_mav.policy.action_sets import ActionSpec, commands, discrete_actions
from airl_mav.policy.layouts import Encoded, ObservationSpec, boxes

FIRST_TRAINING_SEED = 1_000_000
"""Episodes that draw their own seed draw it from here on: those below are for evaluation."""

LAST_TRAINING_SEED = 2**31

UNBOUNDED = 1e6
"""Bound of what a layout leaves unbounded, in its units: Gymnasium's checker warns of infinity."""


class NavigationVectorEnv(Stateful, VectorEnv[Encoded, NDArray[Any], NDArray[Any]]):
    """N flights that reset in the step in which they end (Gymnasium's SAME_STEP).

    `info` is what Gymnasium's SyncVectorEnv makes of n `NavigationEnv`: `seed`, `zone`,
    `flight_time_s`, `distance_m`, `energy_j` and `goal_distance_m` of the episodes that go on; in
    `final_info` those of the ones that ended, with `success` and `outcome`, and in `final_obs` the
    observation each ended with; a mask `_key` beside every key.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int,
        spec: EnvironmentSpec | None = None,
        *,
        render_mode: str | None = None,
        **knobs: Any,
    ) -> None:
        """Make n environments.

        Args:
            num_envs: N.
            spec: What they are made of; or
            render_mode: None. A single environment is what can be looked at.
            knobs: the fields of an EnvironmentSpec.

        Raises:
            UsageError: A knob or a profile cannot be used.
        """
        if num_envs < 1:
            raise UsageError(f"num_envs = {num_envs}: accepted: value >= 1")
        if render_mode is not None:
            raise UsageError(
                f"render_mode = {render_mode!r}: n at a time draw no picture; accepted: None, or "
                "make a single environment"
            )
        self.environment = bounded(spec_of(spec, knobs))
        self.navigation = Navigation(self.environment, num_envs)
        self.num_envs = num_envs
        self.single_observation_space = observation_space(self.navigation.observation)
        self.single_action_space = action_space(self.environment.action_spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.curriculum = curriculum_of(self.navigation)
        self._zone: int | None = None
        self._before: Flights | None = None

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | NDArray[np.int64] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Encoded, dict[str, Any]]:
        """Begin n episodes.

        Args:
            seed: One number seeds the generator that all episodes' seeds are drawn from. A list
                gives the first episodes' own seeds, as in `NavigationEnv.reset(seed)`; None in it
                draws one.
            options: `zone`: curriculum zone that bounds the goals, of the episodes that follow too,
                until a reset with a seed or options; left out: that of the curriculum, or the
                whole arena.

        Raises:
            UsageError: A wrong option, or not n seeds.
        """
        if seed is not None or options:
            self._zone = zone_option(options)
        own: list[int | None] = [None] * self.num_envs
        if seed is None or isinstance(seed, int | np.integer):
            super().reset(seed=None if seed is None else int(seed))
        else:
            own = [None if each is None else int(each) for each in seed]
            if len(own) != self.num_envs:
                raise UsageError(f"seed: {len(own)} numbers; accepted: {self.num_envs}")
            if given := [each for each in own if each is not None]:
                self.np_random = np.random.default_rng(np.random.SeedSequence(given))
        drawn = iter(draw_seeds(self.np_random, own.count(None)))
        seeds = [next(drawn) if each is None else each for each in own]
        self.navigation.begin(range(self.num_envs), seeds, self._open_zone())
        self._before = self.navigation.flights()
        return self.navigation.observe(), _masked(quality(self.navigation, self._before))

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Encoded, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Fly one decision of every vehicle; see Gymnasium's VectorEnv.step."""
        if self._before is None:
            raise gym.error.ResetNeeded("step() before reset()")
        navigation = self.navigation
        navigation.fly(commands(self.environment.action_spec, actions))
        now = navigation.flights()
        reward = rewards(
            self.environment.reward, decision_outcome(self._before, now, self.environment)
        )
        seen = navigation.observe()
        terminated, truncated = endings(now)
        ended = terminated | truncated
        final: dict[str, Any] = {}
        if ended.any():
            final = _final(seen, navigation, now, ended)
            seen = self._begin_anew(np.flatnonzero(ended), now)
            now = navigation.flights()
        self._before = now
        return seen, reward, terminated, truncated, _masked(quality(navigation, now)) | final

    def _begin_anew(self, slots: NDArray[np.int64], ended: Flights) -> Encoded:
        """Begin the next episodes of `slots`; return all present observations."""
        if self.curriculum is not None:
            for i in slots:
                success = bool(ended.verdict[i] == Verdict.SUCCESS)
                self.curriculum.record(int(self.navigation.zones[i]), success=success)
        seeds = draw_seeds(self.np_random, len(slots))
        self.navigation.begin(slots.tolist(), seeds, self._open_zone())
        return self.navigation.observe()

    def _open_zone(self) -> int | None:
        return open_zone(self._zone, self.curriculum)

    def _held(self) -> Mapping[str, Any]:
        return {"flights": self.navigation}

    def get_state(self) -> State:
        """Return the whole state, as copies."""
        curriculum = None if self.curriculum is None else self.curriculum.state()
        own = {
            "spec": pack(self.environment.model_dump(mode="json")),
            "started": np.array(self._before is not None),
            "zone": pack(self._zone),
            "curriculum": pack(curriculum),
            "generator": pack_generators([self._np_random]),
        }
        return super().get_state() | {f"env/{key}": array for key, array in own.items()}

    def set_state(self, state: State) -> None:
        """Restore a saved state: the next step is as it would have been.

        Raises:
            UsageError: It is of another environment.
        """
        own = state_of_part(state, "env")
        self._check_same(unpack(saved_array(own, "spec")))
        super().set_state(state)
        self._zone = unpack(saved_array(own, "zone"))
        (self._np_random,) = unpack_generators(saved_array(own, "generator"))
        curriculum = unpack(saved_array(own, "curriculum"))
        if self.curriculum is not None:
            self.curriculum.restore(curriculum[0], tuple(curriculum[1]))
        self._before = self.navigation.flights() if saved_array(own, "started") else None

    def _check_same(self, theirs: dict[str, Any]) -> None:
        ours = self.environment.model_dump(mode="json")
        changed = [key for key in ours if theirs.get(key) != ours[key]]
        if changed:
            raise UsageError(f"state: of an environment with another {', '.join(changed)}")


def observation_space(spec: ObservationSpec) -> gym.spaces.Dict:
    """Return the Dict space of a layout."""
    arrays: dict[str, gym.Space[Any]] = {
        key: gym.spaces.Box(
            max(box.low, -UNBOUNDED), min(box.high, UNBOUNDED), box.shape, box.dtype
        )
        for key, box in boxes(spec).items()
    }
    return gym.spaces.Dict(arrays)


def action_space(spec: ActionSpec) -> gym.Space[Any]:
    """Return Discrete(25), or Box(-1, 1, (2,)) of the continuous set."""
    number = discrete_actions(spec)
    if number is not None:
        return gym.spaces.Discrete(number)
    return gym.spaces.Box(-1.0, 1.0, (2,), np.float32)


def curriculum_of(navigation: Navigation) -> CurriculumState | None:
    """Return the curriculum at its start; None when there is none."""
    settings = navigation.spec.curriculum
    if settings is None:
        return None
    return CurriculumState(settings, len(navigation.arena_spec.zones_m))


def open_zone(asked: int | None, curriculum: CurriculumState | None) -> int | None:
    """Return the zone of the next episode: the one asked for, that of the curriculum, the whole."""
    return curriculum.zone if asked is None and curriculum is not None else asked


def zone_option(options: Mapping[str, Any] | None) -> int | None:
    """Return the zone that `reset` is asked for. Raises UsageError for anything else."""
    options = options or {}
    if unknown := [key for key in options if key != "zone"]:
        raise UsageError(f"options: {', '.join(map(str, unknown))}; accepted: zone")
    zone = options.get("zone")
    if zone is not None and (isinstance(zone, bool) or not isinstance(zone, int | np.integer)):
        raise UsageError(f"options: zone = {zone!r}: accepted: a whole number")
    return None if zone is None else int(zone)


def draw_seeds(rng: np.random.Generator, n: int) -> list[int]:
    """Return the seeds of n episodes of training."""
    drawn: list[int] = rng.integers(FIRST_TRAINING_SEED, LAST_TRAINING_SEED, n).tolist()
    return drawn


def endings(now: Flights) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which flights are terminated and which truncated: those that ran out of time."""
    truncated: NDArray[np.bool_] = now.verdict == Verdict.TIMEOUT
    return (now.verdict != Verdict.FLYING) & ~truncated, truncated


def decision_outcome(before: Flights, now: Flights, spec: EnvironmentSpec) -> DecisionOutcome:
    """Return what the rewards depend on."""
    return DecisionOutcome(
        success=now.verdict == Verdict.SUCCESS,
        failure=(now.verdict == Verdict.COLLISION) | (now.verdict == Verdict.BATTERY),
        distance_before_m=before.goal_distance_m,
        distance_m=now.goal_distance_m,
        speed_m_s=now.speed_m_s,
        hold_s=spec.episode.hold_s,
    )


def quality(navigation: Navigation, flights: Flights) -> dict[str, NDArray[Any]]:
    """Return `info` of every flight: its seed, zone and quality so far."""
    return {
        "seed": navigation.seeds.copy(),
        "zone": navigation.zones.copy(),
        "flight_time_s": flights.time_s.copy(),
        "distance_m": flights.distance_m.copy(),
        "energy_j": flights.energy_j.copy(),
        "goal_distance_m": flights.goal_distance_m.copy(),
    }


def outcome(flights: Flights, i: int) -> dict[str, Any]:
    """Return what `info` has in addition for a flight that has ended."""
    verdict = Verdict(int(flights.verdict[i]))
    return {"success": verdict == Verdict.SUCCESS, "outcome": verdict.name.lower()}


def _masked(values: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Add masks that are all true."""
    masks = {f"_{key}": np.ones(len(value), np.bool_) for key, value in values.items()}
    return values | masks


def _final(
    seen: Encoded, navigation: Navigation, flights: Flights, ended: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return `final_obs` and `final_info` of the episodes that ended, and their masks."""
    n, who = len(ended), np.flatnonzero(ended)
    info: dict[str, NDArray[Any]] = {
        key: np.where(ended, value, np.zeros_like(value))
        for key, value in quality(navigation, flights).items()
    }
    info["success"] = flights.verdict == Verdict.SUCCESS
    info["outcome"] = np.full(n, None, dtype=object)
    observation = np.full(n, None, dtype=object)
    for i in who:
        info["outcome"][i] = outcome(flights, int(i))["outcome"]
        observation[i] = {key: value[i] for key, value in seen.items()}
    return {
        "final_obs": observation,
        "_final_obs": ended.copy(),
        "final_info": info | {f"_{key}": ended.copy() for key in info},
        "_final_info": ended.copy(),
    }
