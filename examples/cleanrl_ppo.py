"""PPO in one file, in the style of CleanRL, with 16 parallel flights.

    python examples/cleanrl_ppo.py
    airl export examples/cleanrl_ppo.py:Agent --weights agent.pt --out policies/agent
    airl evaluate policies/agent --arena no-obstacles

With STEPS = 60,000 (a minute) almost every flight reaches the goal of this empty arena. Needs the
extra `train`.
"""

import gymnasium
import torch
from torch import nn
from torch.distributions import Categorical

STEPS, FLIGHTS, ROLLOUT = 3072, 16, 64
EPOCHS, BATCH = 4, 256
LEARNING_RATE, GAMMA, LAMBDA, CLIP, ENTROPY = 5e-4, 0.98, 0.95, 0.2, 0.005
ACTIONS = 25


class Agent(nn.Module):
    """Convolutions over the 32x24 image, joined with velocity and goal; two heads."""

    def __init__(self):
        super().__init__()
        self.eye = nn.Sequential(
            *(nn.Conv2d(1, 16, 3, 2), nn.ReLU(), nn.Conv2d(16, 32, 3, 2), nn.ReLU(), nn.Flatten())
        )
        self.body = nn.Sequential(nn.Linear(32 * 5 * 7 + 6, 128), nn.Tanh())
        self.actor, self.critic = nn.Linear(128, ACTIONS), nn.Linear(128, 1)

    def features(self, depth, velocity, goal):
        return self.body(torch.cat([self.eye(depth / 255.0), velocity, goal], dim=1))

    def forward(self, depth, velocity, goal):
        """Return a score for each action: the exported network."""
        return self.actor(self.features(depth, velocity, goal))

    def judge(self, seen):
        """Return the distribution of actions and the value, for training."""
        features = self.features(seen["depth"], seen["velocity"], seen["goal"])
        return Categorical(logits=self.actor(features)), self.critic(features).squeeze(1)


def tensors(observation):
    return {key: torch.from_numpy(array) for key, array in observation.items()}


def train():
    torch.manual_seed(1)
    torch.set_num_threads(1)
    env = gymnasium.make_vec(
        "airl_mav:airl/Navigation-v0",
        num_envs=FLIGHTS,
        arena="no-obstacles",
        image_width_px=32,
        image_height_px=24,
    )
    agent = Agent()
    optimiser = torch.optim.Adam(agent.parameters(), LEARNING_RATE)
    seen, _ = env.reset(seed=1)
    seen = tensors(seen)
    for flown in range(0, STEPS, FLIGHTS * ROLLOUT):
        steps, goals, ends = [], 0, 0
        with torch.no_grad():
            for _ in range(ROLLOUT):
                choice, value = agent.judge(seen)
                action = choice.sample()
                following, reward, terminated, truncated, info = env.step(action.numpy())
                # SAME_STEP autoreset: a finished flight restarts in this step.
                done = torch.from_numpy(terminated | truncated)
                paid = torch.from_numpy(reward).float()
                steps.append((seen, action, choice.log_prob(action), value, paid, done))
                if done.any():
                    ends += int(done.sum())
                    goals += int(info["final_info"]["success"].sum())
                seen = tensors(following)
            ahead, advantage, advantages = agent.judge(seen)[1], 0.0, []
            for _, _, _, value, paid, done in reversed(steps):
                error = paid + GAMMA * ahead * ~done - value
                advantage = error + GAMMA * LAMBDA * advantage * ~done
                advantages.insert(0, advantage)
                ahead = value
        advantages = torch.cat(advantages)
        observations = {key: torch.cat([step[0][key] for step in steps]) for key in seen}
        actions, before, values = (torch.cat([step[k] for step in steps]) for k in (1, 2, 3))
        returns = advantages + values
        for _ in range(EPOCHS):
            for rows in torch.randperm(len(actions)).split(BATCH):
                choice, value = agent.judge({k: v[rows] for k, v in observations.items()})
                ratio = (choice.log_prob(actions[rows]) - before[rows]).exp()
                gain = advantages[rows]
                gain = (gain - gain.mean()) / (gain.std() + 1e-8)
                clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
                loss = -torch.min(ratio * gain, clipped * gain).mean()
                loss += 0.5 * (value - returns[rows]).square().mean()
                loss -= ENTROPY * choice.entropy().mean()
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimiser.step()
        print(f"{flown + len(actions):6d} steps: {goals} of {ends} flights reached the goal")
    torch.save(agent.state_dict(), "agent.pt")


if __name__ == "__main__":
    train()
