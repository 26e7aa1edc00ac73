"""`airl/Navigation-v0`: one flight at a time, in Gymnasium's API."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from airl_mav.core.errors import UsageError
from airl_mav.envs.decisions import (
    Decisions,
    action_space,
    draw_seeds,
    episode_seed,
    observation_space,
    outcome,
    zone_option,
)
from airl_mav.envs.fleet import Verdict
from airl_mav.envs.navigation import Flights
from airl_mav.envs.rendering import EpisodeRenderer, Window, display_found
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy.layouts import newest_frame
from airl_mav.policy.observation_spec import Encoded


class NavigationEnv(Decisions, gym.Env[Encoded, Any]):
    """One vehicle that flies to its goal; a step is a decision and its hold.

    Observation: a Dict of `velocity`, `goal` and the image, whose key is what the camera gives:
    `depth`, `rgb` or `grey` (`airl_mav.policy.layouts`). `info`
    carries `seed`, `zone` (-1: the whole arena), `flight_time_s`, `distance_m`, `energy_j` and
    `goal_distance_m`; at the end also `success` and `outcome` (success, collision, battery,
    timeout). Only a timeout is a truncation.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 2}  # noqa: RUF012

    def __init__(
        self, spec: EnvironmentSpec | None = None, *, render_mode: str | None = None, **knobs: Any
    ) -> None:
        """Make the environment.

        Args:
            spec: What it is made of; or
            render_mode: None, `rgb_array` or `human` (a window, which needs a display; without one
                `metadata` does not offer it).
            knobs: the fields of an EnvironmentSpec.

        Raises:
            UsageError: A knob or a profile cannot be used, or there is no display.
        """
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise UsageError(f"render_mode = {render_mode!r}: accepted: None, {', '.join(modes)}")
        super().__init__(spec, knobs, 1)
        self.observation_space: gym.Space[Any] = observation_space(self.navigation.observation)
        self.action_space = action_space(self.environment.action_spec)
        self.render_mode = render_mode
        # A picture a decision: shown so often, a video of them runs in the time of the flight.
        fps = 1.0 / self.environment.episode.hold_s
        self.metadata = self.metadata | {"render_fps": fps}
        if not display_found():
            # Gymnasium's checker opens every mode that is offered.
            self.metadata["render_modes"] = [mode for mode in modes if mode != "human"]
        self._image = np.zeros((0, 0), np.uint8)
        self._trail: list[NDArray[np.float64]] = []
        self._renderer: EpisodeRenderer | None = None
        self._window = Window(fps) if render_mode == "human" else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Encoded, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: That of the episode itself: the arena, the goal and all that chance decides in
                it. Left out: drawn, as `NavigationVectorEnv` draws it.
            options: `zone`: curriculum zone that bounds the goal, of the episodes that follow too,
                until a reset with a seed or options; left out: that of the curriculum, or the
                whole arena.

        Raises:
            UsageError: A wrong option or seed, or no arena can be made of the seed.
            gymnasium.error.Error: The seed is negative, or no whole number of Python.
        """
        if seed is not None or options:
            self._zone = zone_option(options)
        super().reset(seed=seed)
        episode = draw_seeds(self.np_random, 1)[0] if seed is None else episode_seed(seed)
        flights = self._begin([0], [episode])
        self._trail = []
        return self._observe(), self._info(flights)

    def step(self, action: Any) -> tuple[Encoded, float, bool, bool, dict[str, Any]]:
        """Fly one decision; see Gymnasium's Env.step.

        Raises:
            ResetNeeded: No episode has begun, or it has ended.
            InvalidAction: The action is none of the set; numbers beyond -1..1 are cut off.
        """
        if self._before is not None and self._before.verdict[0] != Verdict.FLYING:
            raise gym.error.ResetNeeded("step() after the end of the episode")
        now, reward, terminated, truncated = self._decide(action, ())
        info = self._info(now)
        if terminated[0] or truncated[0]:
            info |= outcome(now, 0)
        return self._observe(), float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the picture (540, 960, 3) of now with `rgb_array`; a window is shown by itself."""
        if self.render_mode != "rgb_array":
            return None
        return self._frame()

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()

    def _observe(self) -> Encoded:
        seen = {key: value[0] for key, value in self.navigation.observe().items()}
        if self.render_mode is not None:
            self._image = newest_frame(self.navigation.observation, seen)
            self._trail.append(self.navigation.truth().position[0, :2])
        if self._window is not None:
            self._window.show(self._frame())
        return seen

    def _info(self, now: Flights) -> dict[str, Any]:
        return {key: value[0].item() for key, value in self._quality(now).items()}

    def _frame(self) -> NDArray[np.uint8]:
        if self._renderer is None:
            self._renderer = EpisodeRenderer(self.navigation)
        return self._renderer.draw(self._trail, self._image)
