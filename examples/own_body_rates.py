"""A policy of your own that commands body rates and a thrust, as learned racing policies do (CTBR).

    airl-sitl --policy examples/own_body_rates.py:ToGoal --arena no-obstacles

or run this file, which flies it in lockstep, as late as a companion computer may be.
"""

import math
from typing import Final

import numpy as np

from airl_mav.policy.actions import BodyRates, CommandKind
from airl_mav.policy.observation import Observation

GRAVITY_M_S2 = 9.81
HOVER_THRUST = 0.5
"""MPC_THR_HOVER of the vehicle: the thrust that carries it."""

HEIGHT_M = 2.5
FASTEST_M_S = 4.0
STEEPEST = math.tan(math.radians(30.0))


class ToGoal:
    """Flies straight to the goal: position, velocity and attitude are its own business."""

    commands: Final[CommandKind] = "body_rates"

    def act(self, observation: Observation) -> BodyRates:
        """Return body rates and thrust for an observation."""
        state = observation.states[0]
        away = observation.goal_distance
        speed = min(FASTEST_M_S, 0.8 * away)
        # All in the heading frame: forward, right, down.
        level = speed / max(away, 1e-6) * np.asarray(observation.goal)
        sinks = 1.5 * (-HEIGHT_M - state.position[2])
        wanted = np.array([*level, np.clip(sinks, -1.5, 1.5)])
        push = np.clip(1.8 * (wanted - observation.velocity) / GRAVITY_M_S2, -1.0, 1.0)
        push[:2] = np.clip(push[:2], -STEEPEST, STEEPEST)
        # The thrust points up and where it is to accelerate to: that takes a tilt.
        up = 1.0 - push[2]
        roll, pitch = math.atan2(push[1], up), -math.atan2(push[0], up)
        thrust = HOVER_THRUST * up / (math.cos(observation.roll) * math.cos(observation.pitch))
        return BodyRates(
            roll_rate_rad_s=6.0 * (roll - float(observation.roll)),
            pitch_rate_rad_s=6.0 * (pitch - float(observation.pitch)),
            yaw_rate_rad_s=1.0 * observation.goal_bearing,
            thrust=thrust,
        )


if __name__ == "__main__":
    # Here, because the companion that flies this class needs no simulator.
    from airl_mav import Scenario, rehearse

    for late_ms in (10, 100, 200):
        asked = Scenario(
            policy=f"{__file__}:ToGoal", arena="no-obstacles", level="lockstep", episodes=2,
            latency=f"{late_ms}ms",
        )  # fmt: skip
        run = rehearse(asked)
        told = ", ".join(each.outcome.value for each in run.episodes)
        print(f"decisions {late_ms} ms late: {told}")
