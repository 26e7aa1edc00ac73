"""A policy of your own that commands accelerations, as those learned by differentiable physics do.

    airl-sitl --policy examples/own_acceleration.py:ToGoal --arena no-obstacles

or run this file, which flies it in lockstep.
"""

from typing import Final

import numpy as np

from airl_mav.policy.actions import Attitude, CommandKind
from airl_mav.policy.observation import Observation

HOVER_THRUST = 0.5
"""MPC_THR_HOVER of the vehicle: the thrust that carries it."""

HEIGHT_M = 2.5
FASTEST_M_S = 5.0
GREATEST_M_S2 = 4.0


class ToGoal:
    """Flies straight to the goal, its nose to the north."""

    commands: Final[CommandKind] = "attitude"

    def act(self, observation: Observation) -> Attitude:
        """Return an attitude and a thrust for an observation."""
        state = observation.states[0]
        away = observation.goal_distance
        speed = min(FASTEST_M_S, 0.8 * away)
        # Forward, right and down of the heading, as a network would give them.
        level = speed / max(away, 1e-6) * np.asarray(observation.goal)
        wanted = np.array([*level, 1.0 * (-HEIGHT_M - state.position[2])])
        acceleration = 2.0 * (wanted - observation.velocity)
        forward, right, down = np.clip(acceleration, -GREATEST_M_S2, GREATEST_M_S2)
        return Attitude.accelerating(forward, right, down, yaw_rad=0.0, hover_thrust=HOVER_THRUST)


if __name__ == "__main__":
    # Here, because the companion that flies this class needs no simulator.
    from airl_mav import Scenario, rehearse

    asked = Scenario(
        policy=f"{__file__}:ToGoal", arena="no-obstacles", level="lockstep", episodes=3
    )  # fmt: skip
    for each in rehearse(asked).episodes:
        assert each.quality is not None
        print(f"seed {each.seed}: {each.outcome.value} after {each.quality.flight_time_s:.2f} s")
