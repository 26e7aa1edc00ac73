"""`airl/Navigation-v0`: one flight at a time, in Gymnasium's API."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import quat_yaw
from airl_mav.envs.decisions import (
    FLYING,
    FleetDecisions,
    action_space,
    draw_seeds,
    episode_seed,
    observation_space,
    outcome,
    zone_option,
)
from airl_mav.envs.fleet import FlightArrays
from airl_mav.envs.rendering import RENDER_MODES, PictureContent, Pictures
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.envs.world import GOES_ON, TERMINATED, TRUNCATED
from airl_mav.policy.layouts import newest_frame
from airl_mav.policy.observation_spec import Encoded


class NavigationEnv(FleetDecisions, gym.Env[Encoded, Any]):
    """Environment of one vehicle that flies to its goal; a step is a decision and its hold.

    Observation: a Dict of `velocity`, `goal` and the image under the key `depth`, `rgb` or `grey`,
    depending on the camera (`airl_mav.policy.layouts`). `info` contains `seed`, `zone` (-1: the
    whole arena), `flight_time_s`, `distance_m`, `energy_j` and `goal_distance_m`; at the end also
    `success` and `outcome` (success, collision, battery, timeout). Only a timeout is a truncation.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 2}  # noqa: RUF012

    def __init__(
        self, spec: EnvironmentSpec | None = None, *, render_mode: str | None = None, **knobs: Any
    ) -> None:
        """Create the environment.

        Args:
            spec: The specification; or
            render_mode: None, `rgb_array` or `human` (a window, which needs a display; without one
                `metadata` does not list it).
            knobs: the fields of an EnvironmentSpec.

        Raises:
            UsageError: A knob or a profile is invalid, or no display is available.
        """
        super().__init__(spec, knobs, 1)
        self.observation_space: gym.Space[Any] = observation_space(self.navigation.observation)
        self.action_space = action_space(self.environment.action_spec)
        self.render_mode = render_mode
        self._pictures = Pictures(self.environment, self.navigation.observation.kind, render_mode)
        self.metadata = self.metadata | self._pictures.metadata

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Encoded, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the episode: arena, goal and all random draws. Default: drawn as in
                `NavigationVectorEnv`.
            options: `zone`: curriculum zone that bounds the goal, in this and all following
                episodes until a reset with a seed or options. Default: the curriculum's zone, or
                the whole arena.

        Raises:
            UsageError: Invalid option or seed, or arena generation failed for the seed.
            gymnasium.error.Error: The seed is negative, or not a Python int.
        """
        # A reset without arguments continues with the present zone.
        if seed is not None or options:
            self._zone = zone_option(options)
        super().reset(seed=seed)
        episode = draw_seeds(self.np_random, 1)[0] if seed is None else episode_seed(seed)
        flights = self._begin([0], [episode])
        self._pictures.begin()
        return self._observe(), self._info(flights)

    def step(self, action: Any) -> tuple[Encoded, float, bool, bool, dict[str, Any]]:
        """Fly one decision; see Gymnasium's Env.step.

        Raises:
            ResetNeeded: No episode has started, or the episode has ended.
            InvalidAction: The action is outside the set; values beyond -1..1 are clipped.
        """
        if self._before is not None and self._before.verdict[0] != FLYING:
            raise gym.error.ResetNeeded("step() after the end of the episode")
        now, reward, ending = self._decide(action, ())
        how = ending.item()
        info = self._info(now)
        if how != GOES_ON:
            info |= outcome(now, 0)
        return self._observe(), reward.item(), how == TERMINATED, how == TRUNCATED, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the present picture (540, 960, 3) in mode `rgb_array`, otherwise None."""
        return self._pictures.render()

    def close(self) -> None:
        """Close the window."""
        self._pictures.close()

    def _observe(self) -> Encoded:
        seen = {key: value[0] for key, value in self.navigation.observe().items()}
        if self._pictures.wanted:
            self._pictures.see(self._moment(seen))
        return seen

    def _moment(self, seen: Encoded) -> PictureContent:
        navigation = self.navigation
        arena, flights, truth = navigation.arenas[0], navigation.flights(), navigation.truth()
        assert arena is not None  # noqa: S101 (an episode has begun)
        return PictureContent(
            # One flight: row 0.
            arena,
            flights,
            truth.position[0],
            float(quat_yaw(truth.quaternion[0])),
            round(flights.time_s[0] * US_PER_S),
            newest_frame(navigation.observation, seen),
        )

    def _info(self, now: FlightArrays) -> dict[str, Any]:
        return {key: value.item() for key, value in self._quality(now).items()}
