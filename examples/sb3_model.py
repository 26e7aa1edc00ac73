"""Export a stable-baselines3 model as a policy and fly it. Needs the extra `train`.

For a policy that reaches the goal raise STEPS to 100,000.
"""

from pathlib import Path

import gymnasium
from stable_baselines3 import PPO

from airl_mav import Scenario, rehearse
from airl_mav.training.export import export
from airl_mav.training.export_request import ExportRequest

STEPS = 128

env = gymnasium.make("airl_mav:airl/Navigation-v0", arena="no-obstacles", actions="velocity")
model = PPO("MultiInputPolicy", env, n_steps=64, seed=1)
model.learn(STEPS)
model.save("model.zip")

request = ExportRequest(model="model.zip", trust=True, algorithm="PPO", out=Path("my-policy"))
card = export(request, command="python examples/sb3_model.py")
print(f"my-policy: {card.parameters:,} parameters, {card.actions.set}")

run = rehearse(Scenario(policy="my-policy", arena="no-obstacles", level="gym", episodes=2))
for episode in run.episodes:
    print(f"seed {episode.seed}: {episode.outcome.value}, {episode.reason}")
