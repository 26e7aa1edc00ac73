"""stable-baselines3 VecEnv adapter of the vectorized environment."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvStepReturn

from airl_mav.core.errors import UsageError
from airl_mav.envs import saved_state, vector
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy.layouts import Encoded

QUALITY = ("success", "outcome", "flight_time_s", "distance_m", "energy_j", "seed", "zone")
"""Keys of `info` in SB3's `episode` info, in addition to return, length and time."""


class Expert(saved_state.Stateful):
    """Expert that labels the flown states, for imitation learning."""

    @abstractmethod
    def begin(self, slots: Sequence[int]) -> None:
        """Start episodes in slots."""


class NavigationVecEnv(saved_state.Stateful, VecEnv):
    """Adapter of `NavigationVectorEnv`: SB3's auto-reset, `terminal_observation`, `episode`.

    The info of a step is empty except for episodes that end in the step. `episode` has the format
    of SB3's Monitor, so no Monitor is needed; its time `t` is the flight time [s].
    """

    def __init__(self, env: vector.NavigationVectorEnv) -> None:
        """Wrap a vectorized environment.

        Raises:
            UsageError: The environment's autoreset mode does not match stable-baselines3.
        """
        if env.autoreset_mode != AutoresetMode.SAME_STEP:
            raise UsageError(
                f"autoreset_mode = {env.autoreset_mode.value!r}: accepted for stable-baselines3: "
                f"{AutoresetMode.SAME_STEP.value}"
            )
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions: NDArray[Any] = np.zeros(0)
        self._expert: Expert | None = None
        self._return = np.zeros(env.num_envs)
        self._length = np.zeros(env.num_envs, np.int64)

    def teach(self, expert: Expert) -> None:
        """Attach an expert that labels the flown states; its state is saved too."""
        self._expert = expert

    def reset(self) -> Encoded:
        """Start n episodes with the settings of `seed()` and `set_options()`."""
        # SB3's `seed(n)` stores n, n + 1, ...; the first one seeds all episodes.
        seed = next((s for s in self._seeds if s is not None), None)
        observation, _ = self.env.reset(seed=seed, options=self._options[0])
        self._reset_seeds()
        self._reset_options()
        self._return[:] = 0.0
        self._length[:] = 0
        if self._expert is not None:
            self._expert.begin(range(self.num_envs))
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Fly one decision."""
        seen, reward, terminated, truncated, info = self.env.step(self._actions)
        self._return += reward
        self._length += 1
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            final = info["final_info"]
            episode = {key: final[key].item(i) for key in QUALITY}
            episode |= {"r": float(self._return[i]), "l": int(self._length[i])}
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                # SB3 bootstraps the value of truncated episodes.
                "TimeLimit.truncated": bool(truncated[i]),
                "is_success": episode["success"],
                "episode": episode | {"t": episode["flight_time_s"]},
            }
        self._return[done] = 0.0
        self._length[done] = 0
        if self._expert is not None and done.any():
            self._expert.begin(np.flatnonzero(done).tolist())
        return seen, reward.astype(np.float32), done, infos

    def observe(self) -> Encoded:
        """Return the present observations, to continue after `set_state`."""
        return self.env.navigation.observe()

    def _held(self) -> Mapping[str, Any]:
        adapter = {"return": self._return, "length": self._length}
        held: dict[str, Any] = {"vector": self.env, "adapter": adapter}
        return held if self._expert is None else held | {"expert": self._expert}

    def close(self) -> None:
        """Do nothing; there are no resources to release."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the wrapped environment, once per requested index."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the shared environment. Raises ValueError for a subset of indices."""
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError("indices: accepted: all environments, which are one object")
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *arguments: Any, indices: VecEnvIndices = None, **keywords: Any
    ) -> list[Any]:
        """Call a method of the wrapped environment once; return its result for every index."""
        result = getattr(self.env, method_name)(*arguments, **keywords)
        return [result] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Return True for Monitor, whose function is built in; False for other wrappers."""
        return [wrapper_class is Monitor] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return None for each environment; render a single environment instead."""
        return [None] * self.num_envs


def make_vec_env(n: int, spec: EnvironmentSpec | None = None, **knobs: Any) -> NavigationVecEnv:
    """Create n flights for stable-baselines3; arguments and errors as of `NavigationVectorEnv`."""
    return NavigationVecEnv(vector.NavigationVectorEnv(n, spec, **knobs))
