"""`airl/Navigation-v0`, one flight at a time, and the common base of both Gymnasium APIs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from airl_mav.core import constants, errors, frames
from airl_mav.envs.episode_arenas import CurriculumState
from airl_mav.envs.fleet import FlightArrays, FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.rendering import RENDER_MODES, PictureContent, Pictures
from airl_mav.envs.rewards import Step, costs, reward_of
from airl_mav.envs.spec import SHIPPED_REWARDS, Costs, EnvironmentSpec, gymnasium_spec
from airl_mav.envs.stopping import bounded
from airl_mav.envs.world import GOES_ON, TERMINATED, TRUNCATED
from airl_mav.policy import layouts, observation_spec
from airl_mav.policy.actions import ActionSpec, commands, continuous_numbers, discrete_actions

FIRST_TRAINING_SEED = 1_000_000
"""First seed that episodes draw automatically; lower seeds are reserved for evaluation."""

LAST_TRAINING_SEED = 2**31

MOST_SEED = 2**63 - 1
"""Maximum seed of an episode."""

FLYING = int(FlightStatus.FLYING)
"""`FlightStatus.FLYING` as an integer; numpy compares integers several times faster."""

_FREE = Costs()
"""Default: no action costs."""

UNBOUNDED = 1e6
"""Bound in place of infinity in unbounded spaces; Gymnasium's checker warns of infinity."""


class FleetDecisions:
    """Flights of n vehicles, decision by decision; a base of the environments."""

    def __init__(self, spec: EnvironmentSpec | None, knobs: Mapping[str, Any], n: int) -> None:
        """Store the specification, or build it from its fields.

        Raises:
            UsageError: As `gymnasium_spec` and `Navigation`.
        """
        self.environment = bounded(gymnasium_spec(spec, knobs))
        self._reward = reward_of(self.environment.reward)
        # Custom rewards run in Python, built-in ones in the kernels.
        self._own = self.environment.reward not in SHIPPED_REWARDS
        self._charged = self.environment.costs != _FREE
        self._action_spec = self.environment.action_spec
        self.navigation = Navigation(self.environment, n)
        self.curriculum: CurriculumState | None = None
        if self.environment.curriculum is not None:
            stages = len(self.navigation.stages)
            self.curriculum = CurriculumState(self.environment.curriculum, stages)
        self._zone: int | None = None
        """Curriculum zone requested by `reset`."""
        self._before: FlightArrays | None = None
        """Flights at the present decision; None before the first reset."""

    @property
    def _present_zone(self) -> int | None:
        if self._zone is None and self.curriculum is not None:
            return self.curriculum.zone
        return self._zone

    def _begin(self, slots: Sequence[int], seeds: Sequence[int]) -> FlightArrays:
        """Start episodes in the requested zone, else the curriculum's, else the whole arena."""
        self.navigation.begin(slots, seeds, self._present_zone)
        self._before = self.navigation.flights()
        return self._before

    def _decide(
        self, actions: Any, lead: tuple[int, ...]
    ) -> tuple[FlightArrays, NDArray[np.float64], NDArray[np.int64]]:
        """Fly one decision of every vehicle.

        Args:
            actions: One action, or n actions.
            lead: () for one action, (n,) for n.

        Raises:
            ResetNeeded: Before the first reset.
            InvalidAction: Wrong number of actions, or actions outside the space.
        """
        before, navigation, costs_of = self._before, self.navigation, self.environment.costs
        if before is None:
            raise gym.error.ResetNeeded("step() before reset()")
        asked = checked_actions(self._action_spec, actions, lead)
        chosen = commands(self._action_spec, asked if lead else asked[None])
        # The fleet's setpoint is overwritten by the decision.
        last = None
        if self._charged:
            last = navigation.fleet.setpoint[:, navigation.commands.setpoint]
        navigation.fly(chosen, encode=True)
        now = self._before = navigation.flights()
        reward, ending = navigation.paid, navigation.ending
        if self._own or last is not None:
            level = chosen[:, : navigation.commands.least]
            step = Step(before, now, level, self.environment.episode.hold_s)
            if self._own:
                reward = self._reward(step)
            if last is not None:
                reward = reward - costs(costs_of, last, step)
        if self.curriculum is not None:
            # An ended flight counts for the zone in which it began.
            for i in np.flatnonzero(ending):
                success = bool(now.verdict[i] == FlightStatus.SUCCESS)
                self.curriculum.record(int(navigation.zones[i]), success=success)
        return now, reward, ending

    def _quality(self, flights: FlightArrays) -> dict[str, NDArray[Any]]:
        """Return `info` of every flight: its seed, zone and quality so far."""
        return {
            "seed": self.navigation.seeds.copy(),
            "zone": self.navigation.zones.copy(),
            "flight_time_s": flights.time_s.copy(),
            "distance_m": flights.distance_m.copy(),
            "energy_j": flights.energy_j.copy(),
            "goal_distance_m": flights.goal_distance_m.copy(),
        }


def outcome(flights: FlightArrays, i: int) -> dict[str, Any]:
    """Return the additional entries of `info` for a flight that has ended."""
    verdict = FlightStatus(int(flights.verdict[i]))
    return {"success": verdict == FlightStatus.SUCCESS, "outcome": verdict.name.lower()}


def observation_space(spec: observation_spec.ObservationSpec) -> gym.spaces.Dict:
    """Return the Dict space of a layout."""
    arrays: dict[str, gym.Space[Any]] = {
        key: gym.spaces.Box(
            max(box.low, -UNBOUNDED), min(box.high, UNBOUNDED), box.shape, box.dtype
        )
        for key, box in layouts.boxes(spec).items()
    }
    return gym.spaces.Dict(arrays)


def action_space(spec: ActionSpec) -> gym.Space[Any]:
    """Return Discrete(25) or similar, or Box(-1, 1, (2,)) for a continuous set.

    With a vertical speed in the actions, the box is (3,).
    """
    number = discrete_actions(spec)
    if number is not None:
        return gym.spaces.Discrete(number)
    return gym.spaces.Box(-1.0, 1.0, (continuous_numbers(spec),), np.float32)


def checked_actions(spec: ActionSpec, actions: Any, lead: tuple[int, ...]) -> NDArray[Any]:
    """Return actions as an array after validation against an action set.

    Continuous values outside -1..1 are accepted; the action set clips them.

    Args:
        spec: The action set.
        actions: One action, or n actions.
        lead: () for one action, (n,) for n.

    Raises:
        InvalidAction: Wrong shape or type, NaN, or an integer outside the set.
    """
    number = discrete_actions(spec)
    asked = np.asarray(actions)
    shape = lead if number is not None else (*lead, continuous_numbers(spec))
    if asked.shape != shape:
        raise gym.error.InvalidAction(f"action of shape {asked.shape}: accepted: {shape}")
    if asked.dtype.kind not in ("iu" if number is not None else "iuf"):
        what = "whole numbers" if number is not None else "numbers"
        raise gym.error.InvalidAction(f"action of type {asked.dtype}: accepted: {what}")
    # Reject these: numpy would accept negative indices, and NaN would reach the vehicle.
    if number is not None:
        wrong, accepted = (asked < 0) | (asked >= number), f"0 <= value <= {number - 1}"
    else:
        wrong, accepted = np.isnan(asked), "numbers, -1 to 1"
    if wrong.any():
        raise gym.error.InvalidAction(f"action {asked[wrong][0]}: accepted: {accepted}")
    return asked


def zone_option(options: Mapping[str, Any] | None) -> int | None:
    """Return the zone option of `reset`. Raises UsageError for other options or types."""
    options = options or {}
    if unknown := [key for key in options if key != "zone"]:
        raise errors.UsageError(f"options: {', '.join(map(str, unknown))}; accepted: zone")
    zone = options.get("zone")
    if zone is not None and (isinstance(zone, bool) or not isinstance(zone, int | np.integer)):
        raise errors.UsageError(f"options: zone = {zone!r}: accepted: a whole number")
    return None if zone is None else int(zone)


def episode_seed(seed: Any) -> int:
    """Return the seed of an episode as a Python int. Raises UsageError."""
    if not isinstance(seed, int | np.integer) or not 0 <= seed <= MOST_SEED:
        raise errors.UsageError(f"seed = {seed!r}: accepted: a whole number, 0 to 2^63 - 1")
    return int(seed)


def draw_seeds(rng: np.random.Generator, n: int) -> list[int]:
    """Return the seeds of n training episodes."""
    drawn: list[int] = rng.integers(FIRST_TRAINING_SEED, LAST_TRAINING_SEED, n).tolist()
    return drawn


class NavigationEnv(FleetDecisions, gym.Env[layouts.Encoded, Any]):
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
            render_mode: None or `rgb_array`.
            knobs: the fields of an EnvironmentSpec.

        Raises:
            UsageError: A knob or a profile is invalid.
        """
        super().__init__(spec, knobs, 1)
        self.observation_space: gym.Space[Any] = observation_space(self.navigation.observation)
        self.action_space = action_space(self.environment.action_spec)
        self.render_mode = render_mode
        self._pictures = Pictures(self.environment, self.navigation.observation.kind, render_mode)
        self.metadata = self.metadata | self._pictures.metadata

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[layouts.Encoded, dict[str, Any]]:
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

    def step(self, action: Any) -> tuple[layouts.Encoded, float, bool, bool, dict[str, Any]]:
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

    def _observe(self) -> layouts.Encoded:
        seen = {key: value[0] for key, value in self.navigation.observe().items()}
        if self._pictures.wanted:
            self._pictures.see(self._moment(seen))
        return seen

    def _moment(self, seen: layouts.Encoded) -> PictureContent:
        navigation = self.navigation
        arena, flights, truth = navigation.arenas[0], navigation.flights(), navigation.truth()
        assert arena is not None  # noqa: S101 (an episode has begun)
        return PictureContent(
            # One flight: row 0.
            arena,
            flights,
            truth.position[0],
            float(frames.quat_yaw(truth.quaternion[0])),
            round(flights.time_s[0] * constants.US_PER_S),
            layouts.newest_frame(navigation.observation, seen),
        )

    def _info(self, now: FlightArrays) -> dict[str, Any]:
        return {key: value.item() for key, value in self._quality(now).items()}
