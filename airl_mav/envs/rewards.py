"""Rewards of a decision, for n vehicles at a time.

`shaped` is the default. `paper` is the paper's equation 2 to the letter: it does not train, its
terms being a thousand times too large for any learner with a usual scale. `paper-scaled` is the
same divided by 1000.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.envs.fleet import Verdict
from airl_mav.envs.navigation import Flights
from airl_mav.envs.spec import RewardName
from airl_mav.policy.action_sets import PAPER_SPEED_M_S

PROGRESS_1_M = 0.02
"""`shaped`: per metre of progress towards the goal; 50 m of it are worth as much as the goal."""

DECISION_COST = 0.005
"""`shaped`: cost of every decision, so that faster is better."""

PAPER_BONUS = 1000.0


def rewards(name: RewardName, before: Flights, now: Flights, hold_s: float) -> NDArray[np.float64]:
    """Return the rewards (n,) of a decision.

    `paper` is r = 1000 a - 1000 b - D_g + g D_c (Krishnan et al. 2021, appendix B, eqs. 2, 3).
    a: goal reached, b: collision, D_g: distance to the goal, D_c = (V_max - V_now) t_max with
    t_max the time an action is held, g: 1 when closer to the goal than before.

    As printed, D_c is added, and only on the way to the goal: it pays slowness there, although
    the text calls it a penalty on speeding away. V_max is 5 m/s whatever the action set; who is
    faster pays. Running out of time costs nothing, and every decision costs its distance.

    Args:
        name: Which reward.
        before: The flights at the decision.
        now: The flights at its end.
        hold_s: How long an action is held [s].
    """
    success = now.verdict == Verdict.SUCCESS
    # A timeout is no failure.
    failure = (now.verdict == Verdict.COLLISION) | (now.verdict == Verdict.BATTERY)
    ended: NDArray[np.float64] = success.astype(np.float64) - failure
    before_m, now_m = before.goal_distance_m, now.goal_distance_m
    if name == "shaped":
        return ended + PROGRESS_1_M * (before_m - now_m) - DECISION_COST
    correction = (PAPER_SPEED_M_S - now.speed_m_s) * hold_s
    paper = PAPER_BONUS * ended - now_m + (now_m < before_m) * correction
    return paper / PAPER_BONUS if name == "paper-scaled" else paper
