"""A policy of your own in Python: turn to the goal, stop before what is close.

    airl-sitl --policy examples/own_policy.py:Follow

or run this file, which flies it in lockstep.
"""

from airl_mav.policy.actions import Action
from airl_mav.policy.observation import Observation


class Follow:
    """Flies straight to the goal while the middle of the image is free, else sidesteps."""

    def act(self, observation: Observation) -> Action:
        """Return the velocity for an observation."""
        height, width = observation.depth_m.shape
        middle = observation.depth_m[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3]
        seen = middle[middle > 0.0]  # 0: no return
        nearest_m = float(seen.min()) if seen.size else 20.0
        turn = max(-1.0, min(1.0, observation.goal_bearing))
        if nearest_m < 4.0:
            return Action(forward_m_s=0.5, right_m_s=1.5, yaw_rate_rad_s=0.0)
        speed = min(3.0, 0.5 * nearest_m, max(0.5, 0.5 * observation.goal_distance))
        return Action(forward_m_s=speed, right_m_s=0.0, yaw_rate_rad_s=turn)


if __name__ == "__main__":
    # Here, because the companion that flies this class needs no simulator.
    from airl_mav import Scenario, rehearse

    run = rehearse(Scenario(policy=f"{__file__}:Follow", level="lockstep", episodes=2))
    for episode in run.episodes:
        print(f"seed {episode.seed}: {episode.outcome.value}, {episode.reason}")
