"""Imitation learning: behaviour cloning and DAgger, as a learner of stable-baselines3.

Behaviour cloning flies the expert and learns its actions (Pomerleau, "ALVINN", NIPS 1988). DAgger
flies the learner for a growing share of decisions, and labels the visited states with the expert's
actions (Ross, Gordon, Bagnell, AISTATS 2011, arXiv 1011.0686). Behaviour cloning is DAgger with the
expert always in control.

Experts decide for the flights of a vectorized simulator, in its action set. `greedy` is the
classical baseline with the policy's observations. `planner` uses the true arena, `gates` the true
openings of its gates and computes its own actions (`GatePilot`). The others choose among commands
of the action set: all of a discrete set, or a fan of directions and speeds of the continuous set.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import (
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.type_aliases import MaybeCallback, Schedule
from torch.nn import functional

from airl_mav.addons.imitation.planner import Planner
from airl_mav.arena import geometry, walls
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.frames import ned_to_heading, quats_to_euler
from airl_mav.envs import saved_state, sb3
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.sb3 import NavigationVecEnv
from airl_mav.policy.actions import (
    VELOCITIES,
    VERTICAL,
    ActionSpec,
    commands,
    discrete_actions,
    fastest_climb,
)
from airl_mav.policy.layouts import Encoded
from airl_mav.training import config, dqn


class Demonstrations(dqn.Ring):
    """Observations and the expert's actions."""

    def __init__(
        self, steps: int, vehicles: int, shapes: dqn.Shapes, actions: spaces.Space[Any]
    ) -> None:
        shape = () if isinstance(actions, spaces.Discrete) else actions.shape or ()
        kind = np.int64 if isinstance(actions, spaces.Discrete) else np.float32
        rows = max(steps // vehicles, 1)
        super().__init__(shapes, np.zeros((rows, vehicles, *shape), kind))

    def __len__(self) -> int:
        """Return the number of stored decisions."""
        return self.filled * self.vehicles

    def add(self, observations: Mapping[str, NDArray[Any]], actions: NDArray[Any]) -> None:
        """Store the observations of all vehicles, and the expert's actions."""
        self._store(observations, actions)

    def sample(self, batch: int, generator: np.random.Generator) -> tuple[Encoded, NDArray[Any]]:
        """Draw observations and their actions uniformly, with replacement."""
        rows = generator.integers(self.filled, size=batch)
        vehicles = generator.integers(self.vehicles, size=batch)
        seen = {key: array[rows, vehicles] for key, array in self._observations.items()}
        return seen, self._actions[rows, vehicles]


class Imitation(BaseAlgorithm):
    """Imitation of an expert with the networks of PPO, without learning the value.

    Intervals count steps of single vehicles. One generator draws the pilot of each decision and the
    samples, so that a run can be resumed exactly. `env` is a `NavigationVecEnv`, whose state the
    expert reads. The other arguments are as in `config.AlgorithmSpec`, its options and
    stable-baselines3's base class.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": MultiInputActorCriticPolicy
    }
    policy: ActorCriticPolicy

    def __init__(
        self,
        policy: str,
        env: NavigationVecEnv,
        *,
        expert: config.ExpertName = "planner",
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        buffer_size: int = 100_000,
        learning_starts: int = 2000,
        env_steps_per_update: int = 32,
        expert_share_initial: float = 1.0,
        expert_share_final: float = 0.0,
        expert_share_fraction: float = 0.3,
        max_grad_norm: float = 1.0,
        precision: config.Precision = "float32",
        _init_setup_model: bool = True,
        **arguments: Any,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate,
            supported_action_spaces=(spaces.Discrete, spaces.Box),
            support_multi_env=True,
            **arguments,
        )
        self.expert_name: config.ExpertName = expert
        self.batch_size = batch_size
        self.buffer_size = buffer_size
        self.learning_starts = learning_starts
        self.env_steps_per_update = env_steps_per_update
        self.expert_shares = expert_share_initial, expert_share_final, expert_share_fraction
        self.max_grad_norm = max_grad_norm
        self.precision = precision
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        policy = self.policy_class(
            self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs
        )
        self.policy = cast("ActorCriticPolicy", policy.to(self.device))
        if not isinstance(self.env, NavigationVecEnv):
            raise UsageError(f"algorithm.expert: none for a {type(self.env).__name__}")
        self._expert = StatefulExpert(self.expert_name, self.env.env.navigation)
        self.env.teach(self._expert)
        shapes = dqn.shapes_of(self.observation_space)
        self.replay = Demonstrations(self.buffer_size, self.n_envs, shapes, self.action_space)
        self.generator = np.random.default_rng(self.seed)

    @property
    def expert_share(self) -> float:
        """Present share of the decisions made by the expert."""
        first, last, fraction = self.expert_shares
        gone = 1.0 - self._current_progress_remaining
        return first + (last - first) * min(1.0, gone / fraction)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 100,
        tb_log_name: str = "imitation",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Imitation:
        """Fly and learn for a number of steps; see stable-baselines3's `BaseAlgorithm.learn`."""
        total, hooks = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        hooks.on_training_start(locals(), globals())
        logged = self._episode_num
        while self.num_timesteps < total:
            hooks.on_rollout_start()
            infos = self._fly()
            hooks.update_locals(locals())
            if not hooks.on_step():
                break
            hooks.on_rollout_end()
            self._update_current_progress_remaining(self.num_timesteps, total)
            self._train()
            if self._episode_num // log_interval > logged // log_interval:
                logged = self._episode_num
                self.logger.record("rollout/expert_share", self.expert_share)
                self.logger.dump(self.num_timesteps)
            del infos
        hooks.on_training_end()
        return self

    def _fly(self) -> list[dict[str, Any]]:
        """Fly one step of all vehicles and store the expert's actions; return the infos."""
        assert self.env is not None and self._last_obs is not None  # noqa: S101 (_setup_learn)
        seen = cast("Encoded", self._last_obs)
        shown = self._expert.decide()
        theirs = self.generator.random(self.n_envs) < self.expert_share
        flown = shown
        if not theirs.all():
            own, _ = self.policy.predict(seen, deterministic=True)
            flown = np.where(theirs.reshape(-1, *[1] * (shown.ndim - 1)), shown, own)
        self.replay.add(seen, shown)
        following, _, dones, infos = self.env.step(flown)
        self._last_obs = cast("dict[str, NDArray[Any]]", following)
        self._last_episode_starts = dones
        self.num_timesteps += self.n_envs
        self._episode_num += int(dones.sum())
        self._update_info_buffer(infos, dones)
        return infos

    def _train(self) -> None:
        """Run the updates due after the last step of all vehicles."""
        interval = self.env_steps_per_update
        due = self.num_timesteps // interval - (self.num_timesteps - self.n_envs) // interval
        if not due or self.num_timesteps < self.learning_starts:
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        losses = [self._update() for _ in range(due)]
        self._n_updates += due
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", float(np.mean(losses)))

    def _update(self) -> float:
        """Run one update and return its loss."""
        observations, actions = self.replay.sample(self.batch_size, self.generator)
        wanted = torch.from_numpy(actions).to(self.device)
        seen = {key: torch.from_numpy(a).to(self.device) for key, a in observations.items()}
        policy = self.policy
        with dqn.autocast(self.device, self.precision):
            features = policy.extract_features(seen, policy.pi_features_extractor)
            latent = policy.mlp_extractor.forward_actor(cast("torch.Tensor", features))
        distribution = policy._get_action_dist_from_latent(latent.float())
        if isinstance(self.action_space, spaces.Discrete):
            loss = -distribution.log_prob(wanted).mean()
        else:
            loss = functional.mse_loss(distribution.mode(), wanted)
        self.policy.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
        self.policy.optimizer.step()
        return loss.item()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "replay", "generator", "_expert"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []


AHEAD_S = 0.4
"""Prediction time of the position [s]: about the dead time plus half the response time."""

GAIN_1_S = 1.0
"""Gain from lateral and vertical offset to an opening's middle to speed [1/s]."""

STANDOFF_M = 2.0
"""Waiting distance in front of a wall until the vehicle is lined up [m]."""

BEHIND_M = 0.4
"""Distance behind a wall, plus the vehicle's radius, at which to turn to the next gate [m]."""

MARGIN_M = 0.35
"""Gap to the frame at which full speed is reached [m]."""

NOWHERE = 1e6
"""North coordinate of a missing gate [m]."""


class GatePilot:
    """Pilot through gates for the flights of a vectorized simulator."""

    def __init__(self, navigation: Navigation) -> None:
        """Store the flights.

        Raises:
            FieldError: The action set has no vertical speed, or is discrete.
        """
        actions = navigation.spec.action_spec
        if actions.set not in VELOCITIES or actions.set not in VERTICAL:
            accepted = ", ".join(name for name in VELOCITIES if name in VERTICAL)
            raise FieldError("environment.actions", actions.set, f"{accepted} with expert gates")
        self._navigation = navigation
        self._speed, self._climb = actions.max_speed_m_s, fastest_climb(actions.max_speed_m_s)
        self._middle = np.full((navigation.n, 1, 3), NOWHERE)
        self._half = np.ones((navigation.n, 1, 3))
        self._goal = np.zeros((navigation.n, 3))

    def begin(self, slots: Sequence[int]) -> None:
        """Read the arenas of episodes that start or resume in slots."""
        for i in slots:
            arena = self._navigation.arenas[i]
            assert arena is not None  # noqa: S101 (an episode has begun in it)
            self._put(i, walls.openings_of(arena), arena)

    def _put(self, i: int, openings: walls.Openings, arena: geometry.Arena) -> None:
        room = self._middle.shape[1]
        if (more := len(openings) + 1 - room) > 0:
            pad = ((0, 0), (0, more), (0, 0))
            self._middle = np.pad(self._middle, pad, constant_values=NOWHERE)
            self._half = np.pad(self._half, pad, constant_values=1.0)
        self._middle[i], self._half[i] = NOWHERE, 1.0
        self._middle[i, : len(openings)] = openings.center
        self._half[i, : len(openings)] = openings.half_size
        height_m = arena.goal_height_m
        if height_m is None:
            height_m = self._navigation.spec.episode.altitude_m
        self._goal[i] = (*arena.goal, -height_m)

    def decide(self) -> NDArray[np.float32]:
        """Return the actions (n, 3) for the present states."""
        fleet, _, vehicle = self._navigation.whole_truth()
        # Predicted position at which the new command acts.
        here = fleet.position + AHEAD_S * fleet.velocity
        _, _, yaw = quats_to_euler(fleet.quaternion)
        each = np.arange(len(here))
        reach = vehicle.radius + BEHIND_M
        # A gate counts as passed once the whole vehicle is behind it; gates are sorted northwards.
        passed = self._middle[:, :, 0] + self._half[:, :, 0] + reach < fleet.position[:, 0, None]
        gate = passed.sum(axis=1)
        middle, half = self._middle[each, gate], self._half[each, gate]
        off = middle[:, 1:] - here[:, 1:]
        room = half[:, 1:] - np.array([vehicle.radius, vehicle.half_height]) - MARGIN_M
        # 1 = lined up, 0 = outside the opening.
        share = np.abs(off) / np.maximum(room, 0.1)
        # Full speed while the offset uses up to two thirds of the room, none from four thirds on.
        lined_up = np.clip(2.0 - 1.5 * share.max(axis=1), 0.0, 1.0)
        before = middle[:, 0] - half[:, 0] - here[:, 0]
        waiting = np.clip(GAIN_1_S * (before - STANDOFF_M), -1.0, self._speed)
        wanted = np.empty_like(here)
        wanted[:, 0] = lined_up * self._speed + (1.0 - lined_up) * waiting
        wanted[:, 1:] = GAIN_1_S * off
        to_goal = GAIN_1_S * (self._goal - here)
        # Behind the last gate the goal is the target.
        wanted = np.where((middle[:, 0] >= NOWHERE)[:, None], to_goal, wanted)
        body = ned_to_heading(wanted, yaw)
        level = np.hypot(body[:, 0], body[:, 1])
        # Limit the horizontal speed, keep its direction.
        body[:, :2] *= np.minimum(1.0, self._speed / np.maximum(level, 1e-9))[:, None]
        body[:, :2] /= self._speed
        body[:, 2] = np.clip(body[:, 2] / self._climb, -1.0, 1.0)
        return body.astype(np.float32)


DIRECTIONS = 48
"""Number of directions in the fan."""

SPEEDS = (0.2, 0.5, 0.75, 1.0)
"""Speeds in the fan, relative to the maximum."""


class Choices(NamedTuple):
    """Candidate actions of an expert."""

    actions: NDArray[Any]
    """(c,) for a discrete set, (c, 2) for the continuous set."""
    commands: NDArray[np.float64]
    """(c, 3) corresponding commands: forward, right [m/s], yaw rate [rad/s]."""


def choices(spec: ActionSpec) -> Choices:
    """Return the candidate actions of an expert."""
    count = discrete_actions(spec)
    if spec.set in VERTICAL:
        accepted = "one without a vertical speed; with one, expert gates"
        raise FieldError("environment.actions", spec.set, accepted)
    if count is None and spec.set not in VELOCITIES:
        accepted = f"a discrete action set, or {' or '.join(map(repr, VELOCITIES))}"
        raise FieldError("environment.actions", spec.set, accepted)
    if count is not None:
        actions: NDArray[Any] = np.arange(count)
    else:
        course = np.arange(DIRECTIONS) * 2.0 * math.pi / DIRECTIONS
        fan = np.stack([np.cos(course), np.sin(course)], axis=1)
        still = np.zeros((1, 2))
        actions = np.concatenate([still, *(share * fan for share in SPEEDS)]).astype(np.float32)
    return Choices(actions, commands(spec, actions))


class Chooser(Protocol):
    """Interface of experts: decide for the flights of a vectorized simulator."""

    def begin(self, slots: Sequence[int]) -> None:
        """Start episodes in slots."""

    def decide(self) -> NDArray[np.int64]:
        """Return the indices (n,) of the commands for the present states."""


class StatefulExpert(sb3.Expert):
    """Expert and its memory, with checkpoint support."""

    def __init__(self, name: config.ExpertName, navigation: Navigation) -> None:
        """Create an expert by name, for the flights of a vectorized simulator."""
        self._navigation = navigation
        self._chooser: Planner | GatePilot
        self._choices: Choices | None = None
        if name == "gates":
            self._chooser = GatePilot(navigation)
        else:
            self._choices = choices(navigation.spec.action_spec)
            self._chooser = Planner(navigation, self._choices.commands)
        self._begun = np.zeros(navigation.n, np.bool_)

    def begin(self, slots: Sequence[int]) -> None:
        """Start episodes in slots."""
        self._begun[list(slots)] = True
        self._chooser.begin(slots)

    def decide(self) -> NDArray[Any]:
        """Return the actions of n vehicles for their present states, in a policy's format."""
        decided = self._chooser.decide()
        return decided if self._choices is None else self._choices.actions[decided]

    def _held(self) -> Mapping[str, Any]:
        return {"begun": self._begun}

    def set_state(self, state: saved_state.State) -> None:
        """Restore a saved state; restore the flights first."""
        super().set_state(state)
        # The planner's maps and the gates' openings follow from the arenas, so they are not saved.
        self._chooser.begin(np.flatnonzero(self._begun).tolist())
