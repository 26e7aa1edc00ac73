"""`airl/Navigation-v0`, n at a time, in Gymnasium's vector API."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from airl_mav.core.errors import UsageError
from airl_mav.envs import fleet, navigation_env, saved_state, world
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from airl_mav.policy.layouts import Encoded

AHEAD = 32
"""Number of arenas generated ahead at a time."""


class NavigationVectorEnv(
    navigation_env.FleetDecisions,
    saved_state.Stateful,
    VectorEnv[Encoded, NDArray[Any], NDArray[Any]],
):
    """N flights; by default they reset in the step in which they end (Gymnasium's SAME_STEP).

    `info` has the format of Gymnasium's SyncVectorEnv with n `NavigationEnv`: `seed`, `zone`,
    `flight_time_s`, `distance_m`, `energy_j` and `goal_distance_m` of the present episodes.
    `final_info` contains these keys for episodes that ended, with `success` and `outcome`, and
    `final_obs` their last observations. Every key has a mask `_key`. In the other autoreset modes
    the final values are in `info` itself.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012
    autoreset_mode: AutoresetMode

    def __init__(
        self,
        num_envs: int,
        spec: EnvironmentSpec | None = None,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        **knobs: Any,
    ) -> None:
        """Create n environments.

        Args:
            num_envs: N.
            spec: The specification; or
            render_mode: None; only a single environment supports rendering.
            autoreset_mode: Reset after the end of an episode: in the same step (SAME_STEP), in the
                next step, which ignores its action (NEXT_STEP), or by a reset with a mask
                `options["reset_mask"]` (DISABLED).
            knobs: the fields of an EnvironmentSpec.

        Raises:
            UsageError: A knob or a profile is invalid.
        """
        if num_envs < 1:
            raise UsageError(f"num_envs = {num_envs}: accepted: value >= 1")
        if render_mode is not None:
            raise UsageError(
                f"render_mode = {render_mode!r}: n at a time draw no picture; accepted: None, or "
                "make a single environment"
            )
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            accepted = ", ".join(mode.value for mode in AutoresetMode)
            raise UsageError(f"autoreset_mode = {autoreset_mode!r}: accepted: {accepted}") from None
        super().__init__(spec, knobs, num_envs)
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset_mode}
        self.num_envs = num_envs
        self.single_observation_space = navigation_env.observation_space(
            self.navigation.observation
        )
        self.single_action_space = navigation_env.action_space(self.environment.action_spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | NDArray[np.int64] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Encoded, dict[str, Any]]:
        """Start n episodes.

        Args:
            seed: A number seeds the generator of all episodes' seeds. A list contains the seeds of
                the first episodes, as in `NavigationEnv.reset(seed)`; None in the list = drawn.
            options: `zone`, as in `NavigationEnv.reset`; `reset_mask`, (n,) booleans: only these
                flights restart, and `info` covers only these.

        Raises:
            UsageError: Invalid option or seed, or wrong number of seeds.
            ResetNeeded: A mask omits a flight that has not started.
            gymnasium.error.Error: The seed is a negative number.
        """
        options = dict(options or {})
        chosen = self._chosen(options.pop("reset_mask", None))
        if seed is not None or options:
            self._zone = navigation_env.zone_option(options)
        own: list[int | None] = [None] * self.num_envs
        if seed is None or isinstance(seed, int | np.integer):
            super().reset(seed=None if seed is None else int(seed))
        else:
            if isinstance(seed, str) or not isinstance(seed, Iterable):
                raise UsageError(
                    f"seed = {seed!r}: accepted: a whole number, or one for each environment"
                )
            own = [None if each is None else navigation_env.episode_seed(each) for each in seed]
            if len(own) != self.num_envs:
                raise UsageError(f"seed: {len(own)} numbers; accepted: {self.num_envs}")
            # Given seeds also seed the generator, so that later episodes are reproducible.
            if given := [each for each in own if each is not None]:
                self.np_random = np.random.default_rng(np.random.SeedSequence(given))
        slots = np.flatnonzero(chosen).tolist()
        own = [own[i] for i in slots]
        drawn = iter(navigation_env.draw_seeds(self.np_random, own.count(None)))
        seeds = [next(drawn) if each is None else each for each in own]
        flights = self._begin(slots, seeds)
        return self.navigation.observe(), _masked(self._quality(flights), chosen)

    def _chosen(self, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
        """Return the mask (n,) of flights to reset. Raises UsageError and ResetNeeded."""
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        mask = np.asarray(mask)
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise UsageError(
                f"options: reset_mask of {mask.dtype} {mask.shape}, {np.count_nonzero(mask)} of "
                f"them true: accepted: bool ({self.num_envs},), one true at least"
            )
        if self._before is None and not mask.all():
            raise gym.error.ResetNeeded("reset() with a mask before all flights have begun")
        return mask

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Encoded, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Fly one decision of every vehicle; see Gymnasium's VectorEnv.step.

        Raises:
            ResetNeeded: No episodes have started; or an episode has ended in mode DISABLED.
            InvalidAction: Wrong number of actions, or outside the set; values beyond -1..1 are
                clipped.
        """
        # Flights that ended in an earlier step: NEXT_STEP restarts them, DISABLED rejects them.
        over = self._over()
        if over.any() and self.autoreset_mode == AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded("step() after the end of an episode")
        now, reward, ending = self._decide(actions, (self.num_envs,))
        seen = self.navigation.observe()
        ended = ending != world.GOES_ON
        final: dict[str, Any] = {}
        begun = over
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            begun = ended
            if ended.any():
                final = self._final(seen, now, ended)
        elif ended.any():
            final = _masked(_outcomes(now, ended), ended)
        if begun.any():
            # A step that only restarts a flight has no reward.
            reward = np.where(over, 0.0, reward)
            slots = np.flatnonzero(begun).tolist()
            now = self._begin(slots, self._next_seeds(len(slots)))
            for key, first in self.navigation.observe(slots).items():
                seen[key][slots] = first
        info = _masked(self._quality(now)) | final
        return seen, reward, ending == world.TERMINATED, ending == world.TRUNCATED, info

    def _over(self) -> NDArray[np.bool_]:
        """Return the mask (n,) of flights that ended in an earlier step and have not restarted."""
        if self._before is None:
            return np.zeros(self.num_envs, np.bool_)
        over: NDArray[np.bool_] = self._before.verdict != navigation_env.FLYING
        return over

    def _next_seeds(self, n: int) -> list[int]:
        """Draw the seeds of n episodes; if their arenas are missing, generate more ahead."""
        zone, seeds = self._present_zone, navigation_env.draw_seeds(self.np_random, n)
        if not self.navigation.places.prepared(seeds, zone):
            # From a copy of the generator, so the same seeds will be drawn later.
            following = navigation_env.draw_seeds(deepcopy(self.np_random), AHEAD)
            self.navigation.places.prepare([*seeds, *following], zone)
        return seeds

    def _final(
        self, seen: Encoded, flights: fleet.FlightArrays, ended: NDArray[np.bool_]
    ) -> dict[str, Any]:
        """Return `final_obs` and `final_info` of the episodes that ended, and their masks."""
        info = self._quality(flights) | _outcomes(flights, ended)
        observation = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended).tolist():
            observation[i] = {key: value[i].copy() for key, value in seen.items()}
        return {
            "final_obs": observation,
            "_final_obs": ended.copy(),
            "final_info": _masked(info, ended),
            "_final_info": ended.copy(),
        }

    def _held(self) -> Mapping[str, Any]:
        return {"flights": self.navigation}

    def get_state(self) -> saved_state.State:
        """Return the whole state, as copies."""
        curriculum = None if self.curriculum is None else self.curriculum.state()
        own = {
            "spec": saved_state.pack(self.environment.model_dump(mode="json")),
            "started": np.array(self._before is not None),
            "zone": saved_state.pack(self._zone),
            "curriculum": saved_state.pack(curriculum),
            "generator": saved_state.pack_generators([self._np_random]),
        }
        return super().get_state() | {f"env/{key}": array for key, array in own.items()}

    def set_state(self, state: saved_state.State) -> None:
        """Restore a saved state; the next step continues as without interruption.

        Raises:
            UsageError: The state is from another environment.
        """
        own = saved_state.state_of_part(state, "env")
        # The state contains its environment, so that another one can reject it.
        self._check_same(saved_state.unpack(saved_state.saved_array(own, "spec")))
        super().set_state(state)
        self._zone = saved_state.unpack(saved_state.saved_array(own, "zone"))
        (self._np_random,) = saved_state.unpack_generators(
            saved_state.saved_array(own, "generator")
        )
        curriculum = saved_state.unpack(saved_state.saved_array(own, "curriculum"))
        if self.curriculum is not None:
            self.curriculum.restore(curriculum[0], tuple(curriculum[1]))
        self._before = (
            self.navigation.flights() if saved_state.saved_array(own, "started") else None
        )

    def _check_same(self, theirs: dict[str, Any]) -> None:
        ours = self.environment.model_dump(mode="json")
        # Fields missing in an earlier version's state get their defaults.
        theirs = spec_of(None, theirs).model_dump(mode="json")
        changed = [key for key in ours if theirs.get(key) != ours[key]]
        if changed:
            raise UsageError(f"state: of an environment with another {', '.join(changed)}")


def _outcomes(flights: fleet.FlightArrays, ended: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    """Return the additional entries of `info` for flights that have ended."""
    outcomes = np.full(len(ended), None, dtype=object)
    for i in np.flatnonzero(ended).tolist():
        outcomes[i] = navigation_env.outcome(flights, i)["outcome"]
    return {"success": flights.verdict == fleet.FlightStatus.SUCCESS, "outcome": outcomes}


def _masked(
    values: dict[str, NDArray[Any]], told: NDArray[np.bool_] | None = None
) -> dict[str, Any]:
    """Add masks of the valid rows, by default all; other rows become 0 or None."""
    if told is None:
        every = np.ones(len(values["seed"]), np.bool_)
        return values | dict.fromkeys([f"_{key}" for key in values], every)
    rows = {
        key: value if value.dtype == object else np.where(told, value, np.zeros_like(value))
        for key, value in values.items()
    }
    return rows | {f"_{key}": told.copy() for key in rows}
