"""`airl/Navigation-v0`, n at a time, in Gymnasium's vector API."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from airl_mav.envs.curriculum import CurriculumState
from airl_mav.envs.fleet import Verdict
from airl_mav.envs.navigation import Flights, Navigation
from airl_mav.envs.rewards import Happened, rewards
from airl_mav.envs.spaces import action_space, observation_space
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy.action_sets import commands
from airl_mav.policy.layouts import Encoded

FIRST_TRAINING_SEED = 1_000_000
"""Episodes that draw their own seed draw it from here on: those below are for evaluation."""

LAST_TRAINING_SEED = 2**31


class NavigationVectorEnv(VectorEnv[Encoded, NDArray[Any], NDArray[Any]]):
    """N flights that begin anew in the very step they end in (Gymnasium's SAME_STEP).

    `info` of a step carries, where `_episode` is set, the quality of flight of the episode that
    ended: `success`, `outcome`, `flight_time_s`, `distance_m`, `energy_j`, `seed`, `zone`, and
    `final_obs`, the observation that it ended with.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(self, num_envs: int, spec: EnvironmentSpec | None = None, **knobs: Any) -> None:
        """Make n environments.

        Args:
            num_envs: N.
            spec: What they are made of; or
            knobs: the fields of an EnvironmentSpec.

        Raises:
            UsageError: A profile cannot be used.
        """
        self.environment = EnvironmentSpec(**knobs) if spec is None else spec
        self.navigation = Navigation(self.environment, num_envs)
        self.num_envs = num_envs
        self.single_observation_space = observation_space(self.navigation.observation)
        self.single_action_space = action_space(self.environment.action_spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.curriculum: CurriculumState | None = None
        if self.environment.curriculum is not None:
            zones = len(self.navigation.arena_spec.zones_m)
            self.curriculum = CurriculumState(self.environment.curriculum, zones)
        self._before: Flights | None = None

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Encoded, dict[str, Any]]:
        """Begin n episodes.

        Args:
            seed: One number seeds the generator that all episodes' seeds are drawn from. A list
                gives the first episodes' own seeds, as in `Navigation-v0.reset(seed)`.
            options: `seeds`: (n,) the same as a list for `seed`; `zone`: curriculum zone.
        """
        options = options or {}
        seeds: Sequence[int] | None = options.get("seeds")
        if isinstance(seed, Sequence):
            seeds = seed
            self._np_random = np.random.default_rng(np.random.SeedSequence(list(seed)))
        else:
            super().reset(seed=seed)
        if seeds is None:
            seeds = self._draw_seeds(self.num_envs)
        self._zone = options.get("zone")
        self.navigation.begin(range(self.num_envs), seeds, self._open_zone())
        self._before = self.navigation.flights()
        return self.navigation.observe(), {"seed": self.navigation.seeds.copy()}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Encoded, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Fly one decision of every vehicle; see Gymnasium's VectorEnv.step."""
        if self._before is None:
            raise gym.error.ResetNeeded("step() before reset()")
        navigation = self.navigation
        navigation.fly(commands(self.environment.action_spec, actions))
        now = navigation.flights()
        reward = rewards(self.environment.reward, happened(self._before, now, self.environment))
        seen = navigation.observe()
        truncated = now.verdict == Verdict.TIMEOUT
        terminated = (now.verdict != Verdict.FLYING) & ~truncated
        ended = terminated | truncated
        info: dict[str, Any] = {}
        if ended.any():
            info = episode_info(navigation, now, ended)
            info["final_obs"] = _final(seen, ended)
            info["_final_obs"] = ended
            seen = self._begin_anew(np.flatnonzero(ended), now)
            now = navigation.flights()
        self._before = now
        return seen, reward, terminated, truncated, info

    def _begin_anew(self, slots: NDArray[np.int64], ended: Flights) -> Encoded:
        """Begin the next episodes of `slots`; return what all see now."""
        if self.curriculum is not None:
            for i in slots:
                success = bool(ended.verdict[i] == Verdict.SUCCESS)
                self.curriculum.record(int(self.navigation.zones[i]), success=success)
        self.navigation.begin(slots.tolist(), self._draw_seeds(len(slots)), self._open_zone())
        return self.navigation.observe()

    def _open_zone(self) -> int | None:
        if self.curriculum is not None:
            return self.curriculum.zone
        return self._zone

    def _draw_seeds(self, n: int) -> list[int]:
        drawn: list[int] = self.np_random.integers(
            FIRST_TRAINING_SEED, LAST_TRAINING_SEED, n
        ).tolist()
        return drawn


def happened(before: Flights, now: Flights, spec: EnvironmentSpec) -> Happened:
    """Return what the rewards look at."""
    return Happened(
        success=now.verdict == Verdict.SUCCESS,
        failure=(now.verdict == Verdict.COLLISION) | (now.verdict == Verdict.BATTERY),
        distance_before_m=before.goal_distance_m,
        distance_m=now.goal_distance_m,
        speed_m_s=now.speed_m_s,
        hold_s=spec.episode.hold_s,
    )


def episode_info(
    navigation: Navigation, flights: Flights, ended: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return the quality of flight of the episodes that ended, Gymnasium's way of vector infos."""
    names = np.array([v.name.lower() for v in Verdict])
    values = {
        "success": flights.verdict == Verdict.SUCCESS,
        "outcome": names[flights.verdict],
        "flight_time_s": flights.time_s,
        "distance_m": flights.distance_m,
        "energy_j": flights.energy_j,
        "goal_distance_m": flights.goal_distance_m,
        "seed": navigation.seeds.copy(),
        "zone": navigation.zones.copy(),
    }
    info: dict[str, Any] = {}
    for key, value in values.items():
        info[key] = value
        info[f"_{key}"] = ended
    return info


def _final(seen: Encoded, ended: NDArray[np.bool_]) -> NDArray[np.object_]:
    """Return the last observations of the episodes that ended, as an array of dicts."""
    final = np.full(len(ended), None, dtype=object)
    for i in np.flatnonzero(ended):
        final[i] = {key: value[i] for key, value in seen.items()}
    return final
