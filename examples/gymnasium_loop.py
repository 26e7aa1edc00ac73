"""The training environment as a Gymnasium environment: three episodes with random actions.

Needs the extra `train`.
"""

import gymnasium

env = gymnasium.make("airl_mav:airl/Navigation-v0", arena="dynamic-obstacles", actions="velocity")
env.action_space.seed(1)

for seed in range(1, 4):
    observation, info = env.reset(seed=seed)  # the episode that airl evaluate flies for this seed
    total, ended = 0.0, False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        total += float(reward)
        ended = terminated or truncated
    print(
        f"seed {seed}: {info['outcome']} after {info['flight_time_s']:.1f} s "
        f"and {info['distance_m']:.1f} m, return {total:.2f}"
    )
