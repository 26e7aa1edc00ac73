"""A custom reward: train with it and fly the policy.

In a training file: `reward = "examples/own_reward.py:short_and_cheap"`. For a policy that reaches
the goal raise STEPS to 200,000. Needs the extra `train`.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from airl_mav import Scenario, rehearse
from airl_mav.envs.rewards import Step

STEPS = 400


def short_and_cheap(step: Step) -> NDArray[np.float64]:
    """10 for the goal, -10 for a failure, 0.1 per metre of progress, -1 per kilojoule."""
    energy_kj = (step.now.energy_j - step.before.energy_j) / 1000
    return 10.0 * step.success - 10.0 * step.failure + 0.1 * step.progress_m - energy_kj


if __name__ == "__main__":
    # Imported here: the reward alone needs no learner.
    from airl_mav.training.config import TrainingConfig
    from airl_mav.training.training_run import train

    config = TrainingConfig(
        description="short and cheap flights",
        steps=STEPS,
        environment={
            "arena": "no-obstacles",
            "reward": f"{__file__}:short_and_cheap",
            "episode": {"time_limit_s": 20.0},
        },
        algorithm={"learning_starts": 100},
        selection={"episodes": 10},
    )
    trained = train(config, Path("short-and-cheap"), name="short-and-cheap")
    policy = str(trained.folder.policy)
    run = rehearse(
        Scenario(
            policy=policy,
            arena="no-obstacles",
            level="gym",
            episodes=1,
            time_limit_s=20.0,
        )
    )
    print(f"{run.episodes[0].outcome.value}: {run.episodes[0].reason}")
