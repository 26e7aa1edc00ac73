"""A reward of your own: train with stable-baselines3, export the policy, fly it.

The training is far too short to learn anything; raise STEPS to 200,000. Needs the extra `train`.
"""

from pathlib import Path
from typing import Any

import gymnasium
from stable_baselines3 import PPO

import airl_mav.envs.registration  # noqa: F401 (registers the id)
from airl_mav import Scenario, rehearse
from airl_mav.policy.action_sets import ActionSpec
from airl_mav.policy.card import PolicyFacts
from airl_mav.policy.layouts import ObservationSpec
from airl_mav.training.config import NetworkSpec
from airl_mav.training.export import export_sb3
from airl_mav.training.networks import policy_arguments

STEPS = 64


class ShortAndCheap(gymnasium.Wrapper):
    """10 for the goal, -10 for a collision, 0.1 per metre of progress, -1 per kilojoule."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        seen, info = self.env.reset(**options)
        self.before = info
        return seen, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        seen, _, terminated, truncated, info = self.env.step(action)
        progress_m = self.before["goal_distance_m"] - info["goal_distance_m"]
        energy_kj = (info["energy_j"] - self.before["energy_j"]) / 1000
        reward = 0.1 * progress_m - energy_kj
        if terminated:
            reward += 10.0 if info["success"] else -10.0
        self.before = info
        return seen, reward, terminated, truncated, info


env = ShortAndCheap(gymnasium.make("airl/Navigation-v0", arena="no-obstacles", actions="velocity"))
model = PPO(
    "MultiInputPolicy",
    env,
    n_steps=32,
    seed=1,
    policy_kwargs=policy_arguments(NetworkSpec(kind="small")),
)
model.learn(STEPS)

folder = Path("short-and-cheap")
facts = PolicyFacts(
    name=folder.name,
    observation=ObservationSpec(width_px=32, height_px=24, horizontal_fov_deg=90.0, range_m=20.0),
    actions=ActionSpec(set="velocity"),
    hold_s=0.5,
    goal_radius_m=3.0,
    altitude_m=2.5,
)
export_sb3(model, facts, folder)

run = rehearse(Scenario(policy=str(folder), arena="no-obstacles", level="lockstep", episodes=1))
print(f"{run.episodes[0].outcome.value}: {run.episodes[0].reason}")
