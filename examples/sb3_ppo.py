"""PPO of stable-baselines3 learns to fly in the arena static-obstacles. Needs the extra `train`."""

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.utils import LinearSchedule

from airl_mav.envs.evaluation import fly_episodes, success_rate
from airl_mav.envs.sb3 import make_vec_env
from airl_mav.training.algorithms import policy_arguments
from airl_mav.training.onnx_export import GreedyDecisions

torch.set_num_threads(1)  # threads that wait for each other cost more than they gain
KNOBS = {"arena": "static-obstacles", "actions": "velocity", "reward": "timed"}
env = make_vec_env(32, **KNOBS, episode={"hold_s": 0.25}, image_width_px=32, image_height_px=24)
learner = {"policy_kwargs": policy_arguments(), "n_steps": 128, "batch_size": 256, "n_epochs": 4}
model = PPO("MultiInputPolicy", env, LinearSchedule(5e-4, 2e-5, 1.0), **learner, seed=1)
model.learn(150_000).save("static-obstacles.zip")
flown = list(fly_episodes(env.env.environment, GreedyDecisions(model), range(1, 301)))
print(f"{100 * success_rate(flown):.1f} % of {len(flown)} flights reached the goal")
