"""Train in the vectorized simulator, then fly the policy in lockstep, with PX4 if given.

    python examples/gymnasium_px4.py [PX4_SITL_BUILD]

Needs the extras `sim` and `train`.
"""

import sys

import gymnasium
from stable_baselines3 import PPO

from airl_mav.envs.sb3 import make_vec_env

KNOBS = {"arena": "no-obstacles", "actions": "velocity"}


def main() -> None:
    """Train, then fly three episodes in each simulator."""
    vectorized = make_vec_env(64, **KNOBS)
    learner = PPO("MultiInputPolicy", vectorized, n_steps=32, batch_size=512, seed=1, device="cpu")
    learner.learn(30_000)
    places = {
        "vectorized": gymnasium.make("airl_mav:airl/Navigation-v0", **KNOBS),
        "built-in": gymnasium.make("airl_mav:airl/Rehearsal-v0", **KNOBS),
    }
    if sys.argv[1:]:
        real = {"firmware": "px4", "real": {"px4_dir": sys.argv[1]}}
        places["PX4"] = gymnasium.make("airl_mav:airl/Rehearsal-v0", **KNOBS, **real)
    for name, env in places.items():
        for seed in range(1, 4):
            observation, info = env.reset(seed=seed)
            ended = False
            while not ended:
                action, _ = learner.predict(observation, deterministic=True)
                observation, _, terminated, truncated, info = env.step(action)
                ended = terminated or truncated
            print(
                f"{name}, seed {seed}: {info['outcome']} after {info['flight_time_s']:.2f} s "
                f"and {info['distance_m']:.2f} m"
            )
        env.close()


if __name__ == "__main__":
    main()
