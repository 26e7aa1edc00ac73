"""From a finished training run to a policy folder: the best weights, and a card that tells all."""

from __future__ import annotations

from airl_mav.core.clock import utc_now
from airl_mav.core.provenance import package_versions
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.vector import FIRST_TRAINING_SEED, LAST_TRAINING_SEED
from airl_mav.policy.card import PolicyCard, PolicyFacts, Training
from airl_mav.training.config import TrainingConfig
from airl_mav.training.run import load_best
from airl_mav.training.sb3_export import export_sb3
from airl_mav.training.store import TrainingFolder


def export_best(folder: TrainingFolder, config: TrainingConfig, name: str) -> PolicyCard:
    """Export the best weights of a run into its `policy` folder.

    Args:
        folder: The run.
        config: Its configuration.
        name: Of the policy.

    Raises:
        UsageError: The network cannot be exported.
    """
    best, about = folder.best(), folder.about()
    assert best is not None  # noqa: S101 - a finished run has one
    environment = config.environment
    facts = PolicyFacts(
        name=name,
        description=config.description,
        observation=Navigation(environment, 1).observation,
        actions=environment.action_spec,
        hold_s=environment.episode.hold_s,
        goal_radius_m=environment.episode.goal_radius_m,
        altitude_m=environment.episode.altitude_m,
        hover_after_s=environment.episode.hover_after_s,
        algorithm=config.algorithm.name,
        training=Training(
            arena=environment.arena,
            first_arena_seed=FIRST_TRAINING_SEED,
            last_arena_seed=LAST_TRAINING_SEED - 1,
            seed=config.seed,
            env_steps=best.steps,
            config_file=name,
            config=config.model_dump(mode="json", exclude_none=True),
            command=about["command"],
            versions=package_versions(),
            date_utc=utc_now().isoformat(timespec="seconds"),
        ),
    )
    return export_sb3(load_best(folder, config), facts, folder.policy)
