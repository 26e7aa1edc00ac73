"""A fleet of toys on a line, with the observations of a real one; it can be put back anywhere."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

HEIGHT, WIDTH = 12, 16
GOAL_AT = 6
TIME_LIMIT = 15


def observation_space(height: int = HEIGHT, width: int = WIDTH) -> spaces.Dict:
    return spaces.Dict(
        {
            "depth": spaces.Box(0, 255, (1, height, width), np.uint8),
            "velocity": spaces.Box(-np.inf, np.inf, (3,), np.float32),
            "goal": spaces.Box(-np.inf, np.inf, (3,), np.float32),
        }
    )


class ToyFleet(VecEnv):
    """Action 0 steps back, 1 stays, 2 steps on (or the sign of the first number of a pair).

    The episode terminates at +-GOAL_AT, is truncated after TIME_LIMIT steps; the next one begins at
    a random place.
    """

    def __init__(self, vehicles: int, *, continuous: bool = False) -> None:
        action_space = spaces.Box(-1.0, 1.0, (2,), np.float32) if continuous else spaces.Discrete(3)
        self.render_mode = None
        super().__init__(vehicles, observation_space(), action_space)
        self.continuous = continuous
        self.place = np.zeros(vehicles, np.int64)
        self.time = np.zeros(vehicles, np.int64)
        self.draws = 0

    def get_state(self) -> dict[str, NDArray[Any]]:
        return {
            "place": self.place.copy(),
            "time": self.time.copy(),
            "draws": np.array(self.draws),
        }

    def set_state(self, state: dict[str, NDArray[Any]]) -> None:
        self.place, self.time = state["place"].copy(), state["time"].copy()
        self.draws = int(state["draws"])

    def _begin(self, who: NDArray[np.bool_]) -> None:
        self.draws += 1
        places = np.random.default_rng(self.draws).integers(-3, 4, self.num_envs)
        self.place[who], self.time[who] = places[who], 0

    def _seen(self) -> dict[str, NDArray[Any]]:
        pixels = np.arange(HEIGHT * WIDTH).reshape(1, 1, HEIGHT, WIDTH)
        depth = (pixels + 11 * self.place[:, None, None, None]) % 256
        velocity = np.zeros((self.num_envs, 3), np.float32)
        velocity[:, 0] = self.time / TIME_LIMIT
        goal = np.zeros((self.num_envs, 3), np.float32)
        goal[:, 0] = self.place / GOAL_AT
        return {"depth": depth.astype(np.uint8), "velocity": velocity, "goal": goal}

    def reset(self) -> dict[str, NDArray[Any]]:
        self._begin(np.ones(self.num_envs, np.bool_))
        return self._seen()

    def step_async(self, actions: NDArray[Any]) -> None:
        self.move = np.sign(actions[:, 0]).astype(np.int64) if self.continuous else actions - 1

    def step_wait(self) -> Any:
        self.place = self.place + self.move
        self.time = self.time + 1
        terminated = np.abs(self.place) >= GOAL_AT
        truncated = (self.time >= TIME_LIMIT) & ~terminated
        rewards = np.where(terminated, np.sign(self.place), -0.01).astype(np.float32)
        done = terminated | truncated
        last = self._seen()
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            infos[i] = {
                "terminal_observation": {key: array[i] for key, array in last.items()},
                "TimeLimit.truncated": bool(truncated[i]),
                "is_success": bool(self.place[i] > 0),
                "episode": {"r": float(rewards[i]), "l": int(self.time[i]), "t": 0.0},
            }
        if done.any():
            self._begin(done)
        return self._seen(), rewards, done, infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        return [getattr(self, method_name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs
