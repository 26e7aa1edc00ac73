"""Training runs: learning, and between rollouts evaluations, checkpoints and exports."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.save_util import load_from_zip_file

from airl_mav.core.clock import WallClock, utc_now
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.files import replace_file, scratch_folder
from airl_mav.core.machine import package_versions
from airl_mav.envs.evaluation import EpisodeResult, fly_episodes, mean_of_successes, success_rate
from airl_mav.envs.fleet import FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.navigation_env import FIRST_TRAINING_SEED, LAST_TRAINING_SEED
from airl_mav.envs.sb3 import NavigationVecEnv, make_vec_env
from airl_mav.envs.spec import EnvironmentSpec, Randomisation
from airl_mav.envs.stopping import bounded
from airl_mav.policy.card import PolicyCard, PolicyFacts, Training
from airl_mav.policy.layouts import SHIPPED
from airl_mav.rehearsal.run_folder import locked
from airl_mav.training import algorithms, checkpoint, export, onnx_export, training_folder
from airl_mav.training.config import (
    SELECTION_SEED,
    TrainingConfig,
    check_actions,
    check_fields,
    kind_of,
)


def begin_with(model: BaseAlgorithm, run: Path, log_std: float | None = None) -> None:
    """Load the best weights of a training run, value and exploration too; reset the optimiser.

    The run must have an evaluation, and the same algorithm, inputs, network and actions. `log_std`
    is the initial log standard deviation of continuous actions; None = the run's. Raises UsageError
    for another run, or if the weights do not fit.
    """
    folder = training_folder.TrainingFolder(run)
    learned = folder.about()["config"]["algorithm"]["name"]
    if folder.best() is None:
        raise UsageError(f"initial = '{run}': no weights yet; accepted: a run that was evaluated")
    # Only tensors are read: nothing is unpickled.
    _, states, _ = load_from_zip_file(folder.best_model, device=model.device, load_data=False)
    try:
        # stable-baselines3 annotates a network's state as a tensor.
        model.policy.load_state_dict(cast("dict[str, Any]", states["policy"]))
    except RuntimeError:
        raise UsageError(
            f"initial = '{run}': weights of {learned!r} that do not fit; accepted: a run with the"
            " same algorithm, network, observation and actions"
        ) from None
    if log_std is not None:
        cast("ActorCriticPolicy", model.policy).log_std.data.fill_(log_std)


RECENT = 200
"""Number of training episodes in the displayed success rate."""

LOG_EVERY = 100
"""Episodes between points of the TensorBoard curves; learners with rollouts log each rollout."""


class TrainingResult(NamedTuple):
    """Result of a training run."""

    folder: training_folder.TrainingFolder
    best: training_folder.Evaluation
    card: PolicyCard


def nominal(spec: EnvironmentSpec) -> EnvironmentSpec:
    """Return the evaluation environment: the complete arena, without randomization."""
    return spec.model_copy(update={"curriculum": None, "randomisation": Randomisation()})


def train(
    config: TrainingConfig,
    out: Path,
    *,
    name: str,
    resume: bool = False,
    mixed_code: bool = False,
    progress: training_folder.TrainingProgress | None = None,
    device: str = "cpu",
    command: str = "airl_mav.training.training_run.train",
) -> TrainingResult:
    """Train a policy to the end and export its best weights.

    `resume` continues the run in `out` from its newest checkpoint, if any; `mixed_code` also if
    another version of the code began it. Returns the run's folder, the best evaluation and the
    policy's card.

    Raises:
        UsageError: Unusable profile or algorithm, `out` is in use or contains another run, or the
            export fails.
        KeyboardInterrupt: Ctrl-C; `resume` continues from the newest checkpoint.
    """
    check_fields(config.algorithm)
    config = config.model_copy(update={"environment": bounded(config.environment)})
    progress = progress or training_folder.TrainingProgress()
    with locked(out, progress.waiting):
        if not training_folder.TrainingFolder(out).begun:
            check_trainable(config, name, device)  # before there is a run in the folder
        folder = training_folder.TrainingFolder.begin(
            out, config, command, resume=resume, mixed=mixed_code, say=progress.waiting
        )
        best = fit(config, folder, progress, device)
        return TrainingResult(folder, best, export_best(folder, config, name))


def check_trainable(config: TrainingConfig, name: str, device: str = "cpu") -> None:
    """Raise UsageError if a training cannot start, or custom code cannot be exported."""
    env = environment_of(config)
    check_actions(config.algorithm.name, kind_of(config.environment.actions))
    model = learner_of(config, env, device)
    if config.initial is not None:
        begin_with(model, Path(config.initial), None)
    if config.network.own or config.environment.layout not in SHIPPED:
        with scratch_folder("airl-train-") as scratch:
            export.export_sb3(model, facts_of(config, name, "", 0), scratch)


def environment_of(config: TrainingConfig) -> NavigationVecEnv:
    """Create a training's environment. Raises UsageError, or FieldError with the file's fields."""
    try:
        return make_vec_env(config.vehicles, config.environment)
    except FieldError as error:
        field = f"environment.{error.field}"
        raise FieldError(field, error.value, error.accepted, error.problem) from None


def learner_of(config: TrainingConfig, env: NavigationVecEnv, device: str) -> BaseAlgorithm:
    """Create the learner of a training, with fresh weights. Raises UsageError."""
    return algorithms.make_model(config.algorithm, config.network, env, config.seed, device=device)


def fit(
    config: TrainingConfig,
    folder: training_folder.TrainingFolder,
    progress: training_folder.TrainingProgress,
    device: str,
) -> training_folder.Evaluation:
    """Train in a locked folder from the newest checkpoint; return the best weights' evaluation.

    Raises UsageError if the algorithm does not fit the environment, an arena cannot be generated,
    or initial weights are missing.
    """
    check_actions(config.algorithm.name, kind_of(config.environment.actions))
    env = environment_of(config)
    env.seed(config.seed)
    model = learner_of(config, env, device)
    model.set_logger(configure(str(folder.tensorboard), ["tensorboard"]))
    callback = _BetweenRollouts(config, folder, progress, env)
    meta = checkpoint.load_latest(folder.checkpoints, model)
    if meta is not None:
        callback.restore(meta)
        folder.forget_after(model.num_timesteps)
    elif config.initial is not None:
        log_std = config.algorithm.options.get("log_std_init")
        assert log_std is None or isinstance(log_std, int | float)  # noqa: S101 (validated)
        begin_with(model, Path(config.initial), log_std)
    left = config.steps - model.num_timesteps
    if left > 0 and not callback.done:
        # stable-baselines3 counts episodes, or rollouts.
        every = 1 if isinstance(model, OnPolicyAlgorithm) else LOG_EVERY
        model.learn(left, callback=callback, log_interval=every, reset_num_timesteps=meta is None)
    callback.finish(model)
    best = folder.best()
    assert best is not None  # noqa: S101 - finish() has evaluated
    return best


class _BetweenRollouts(BaseCallback):
    """Evaluation and saving between two rollouts."""

    def __init__(
        self,
        config: TrainingConfig,
        folder: training_folder.TrainingFolder,
        progress: training_folder.TrainingProgress,
        env: NavigationVecEnv,
    ) -> None:
        super().__init__()
        self.done = False
        self._config = config
        self._folder = folder
        self._progress = progress
        self._env = env
        self._recent: deque[bool] = deque(maxlen=RECENT)
        self._evaluated = -1
        self._saved = 0
        self._zone = 0
        """Current curriculum zone; earlier zones are complete, and saved if requested."""
        self._before_s = 0.0
        self._clock = WallClock()
        self._paused_us = 0

    # --- checkpoints

    def restore(self, meta: dict[str, Any]) -> None:
        """Resume from a checkpoint."""
        self._recent.extend(meta["recent"])
        self._evaluated = meta["evaluated"]
        self._saved = meta["steps"]
        self._zone = meta.get("zone", 0)
        self._before_s = meta["seconds"]
        self.done = meta["done"]

    def _meta(self) -> dict[str, Any]:
        return {
            "steps": self.model.num_timesteps,
            "seconds": self._seconds(),
            "recent": list(self._recent),
            "evaluated": self._evaluated,
            "zone": self._zone,
            "done": self.done,
        }

    def _save(self) -> None:
        self._saved = self.model.num_timesteps
        checkpoint.save_checkpoint(self._folder.checkpoints, self.model, self._meta())

    def _keep_zones(self) -> None:
        """Save the learner at the end of each curriculum zone, if requested."""
        curriculum = self._env.env.curriculum
        if not self._config.keep_zones or curriculum is None:
            return
        while self._zone < curriculum.zone:
            kept = self._folder.zone(self._zone)
            self._zone += 1
            checkpoint.save_checkpoint(kept, self.model, self._meta())
            replace_file(kept / training_folder.BEST_MODEL, model_bytes(self.model))

    # --- SB3's hooks

    def _on_rollout_start(self) -> None:
        self._keep_zones()
        steps, selection = self.model.num_timesteps, self._config.selection
        if steps // selection.every > max(self._evaluated, 0) // selection.every:
            self._evaluate(self.model)
        if steps - self._saved >= self._config.checkpoint_every:
            self._save()

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self._recent.append(bool(info["is_success"]))
        curriculum = self._env.env.curriculum
        zone = None if curriculum is None else curriculum.zone
        if zone is not None:
            self.logger.record("rollout/zone", zone)
        self._progress.trained(self.model.num_timesteps, self._success(), zone)
        return not self.done

    def finish(self, model: BaseAlgorithm) -> None:
        """Evaluate and save the last weights, unless already done."""
        self.model = model
        if self._evaluated < model.num_timesteps:
            self._evaluate(model)
        self.done = True
        if self._saved < model.num_timesteps:
            self._save()

    # --- evaluation

    def _evaluate(self, model: BaseAlgorithm) -> None:
        seconds, began_us = self._seconds(), self._clock.time_us()
        selection = self._config.selection
        seeds = range(SELECTION_SEED, SELECTION_SEED + selection.episodes)
        decide, spec = onnx_export.GreedyDecisions(model), nominal(self._config.environment)
        flown = list(fly_episodes(spec, decide, seeds, began=decide.began))
        curriculum = self._env.env.curriculum
        evaluation = summary(
            flown,
            steps=model.num_timesteps,
            seconds=seconds,
            training_success=self._success(),
            zone=None if curriculum is None else curriculum.zone,
        )
        self._evaluated = model.num_timesteps
        best = self._folder.best()
        better = best is None or evaluation.rank > best.rank
        if better:
            self._folder.save_best(model_bytes(model), evaluation)
        self._folder.add_evaluation(evaluation)
        model.logger.record("eval/success_rate", evaluation.success_rate)
        if evaluation.flight_time_s is not None:
            model.logger.record("eval/flight_time_s", evaluation.flight_time_s)
        model.logger.dump(model.num_timesteps)
        if selection.stop_at is not None and evaluation.success_rate >= selection.stop_at:
            self.done = True
        self._paused_us += self._clock.time_us() - began_us
        self._progress.evaluated(evaluation, best=better)

    def _success(self) -> float | None:
        return sum(self._recent) / len(self._recent) if self._recent else None

    def _seconds(self) -> float:
        return self._before_s + (self._clock.time_us() - self._paused_us) / US_PER_S


def summary(
    flown: Sequence[EpisodeResult],
    *,
    steps: int,
    seconds: float,
    training_success: float | None,
    zone: int | None,
) -> training_folder.Evaluation:
    """Return the summary of evaluation flights."""
    crashed = sum(each.verdict == FlightStatus.COLLISION for each in flown)
    return training_folder.Evaluation(
        steps=steps,
        seconds=seconds,
        episodes=len(flown),
        success_rate=success_rate(flown),
        collision_rate=crashed / len(flown),
        flight_time_s=mean_of_successes(flown, "flight_time_s"),
        distance_m=mean_of_successes(flown, "distance_m"),
        training_success=training_success,
        zone=zone,
        reward=sum(each.reward for each in flown) / len(flown),
    )


def model_bytes(model: BaseAlgorithm) -> bytes:
    """Return the bytes of a learner saved by stable-baselines3, without replay."""
    buffer = io.BytesIO()
    model.save(buffer, exclude=["replay", "replay_buffer", "generator"])
    return buffer.getvalue()


def export_best(
    folder: training_folder.TrainingFolder, config: TrainingConfig, name: str
) -> PolicyCard:
    """Export the best weights of a run to its `policy` folder. Raises UsageError if it cannot."""
    best, about = folder.best(), folder.about()
    assert best is not None  # noqa: S101 - a finished run has one
    facts = facts_of(config, name, about["command"], best.steps)
    # The trained number of vehicles: with fewer, a rollout would not fill its batches.
    model = learner_of(config, environment_of(config), "cpu")
    model.set_parameters(str(folder.best_model), device="cpu")
    return export.export_sb3(model, facts, folder.policy)


def facts_of(config: TrainingConfig, name: str, command: str, steps: int) -> PolicyFacts:
    """Return the card data of a training's policy after `steps` decisions."""
    environment = config.environment
    return PolicyFacts(
        name=name,
        description=config.description,
        observation=Navigation(environment, 1).observation,
        actions=environment.action_spec,
        hold_s=environment.episode.hold_s,
        goal_radius_m=environment.episode.goal_radius_m,
        altitude_m=environment.episode.altitude_m,
        hover_after_s=environment.episode.hover_after_s,
        decision_timeout_s=environment.episode.decision_timeout_s,
        decisions=environment.decisions,
        compensate=environment.compensate,
        algorithm=config.algorithm.name,
        training=Training(
            arena=environment.arena,
            first_arena_seed=FIRST_TRAINING_SEED,
            last_arena_seed=LAST_TRAINING_SEED - 1,
            seed=config.seed,
            env_steps=steps,
            config_file=name,
            config=config.model_dump(mode="json", exclude_none=True),
            command=command,
            versions=package_versions(),
            date_utc=utc_now().isoformat(timespec="seconds"),
        ),
    )
