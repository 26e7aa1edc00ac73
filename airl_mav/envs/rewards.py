"""Rewards of a decision, for n vehicles at a time.

`shaped` is the default. `paper` is the paper's equation 2 to the letter: it does not train, its
terms being a thousand times too large for any learner with a usual scale. `paper-scaled` is the
same divided by 1000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from airl_mav.policy.action_sets import PAPER_SPEED_M_S

RewardName = Literal["shaped", "paper-scaled", "paper"]

PROGRESS_1_M = 0.02
"""`shaped`: per metre of progress towards the goal; 50 m of it are worth as much as the goal."""

DECISION_COST = 0.005
"""`shaped`: cost of every decision, so that faster is better."""

PAPER_BONUS = 1000.0


@dataclass(frozen=True)
class DecisionOutcome:
    """Outcome of a decision of n vehicles."""

    success: NDArray[np.bool_]
    failure: NDArray[np.bool_]
    """Collision or empty battery; a timeout is no failure."""
    distance_before_m: NDArray[np.float64]
    """Horizontal distance to the goal at the decision."""
    distance_m: NDArray[np.float64]
    """Horizontal distance to the goal at its end."""
    speed_m_s: NDArray[np.float64]
    """Three-dimensional speed at its end."""
    hold_s: float
    """How long an action is held."""


def rewards(name: RewardName, decision: DecisionOutcome) -> NDArray[np.float64]:
    """Return the rewards (n,)."""
    if name == "shaped":
        return _shaped(decision)
    paper = _paper(decision)
    return paper / PAPER_BONUS if name == "paper-scaled" else paper


def _shaped(h: DecisionOutcome) -> NDArray[np.float64]:
    ended = h.success.astype(np.float64) - h.failure
    return ended + PROGRESS_1_M * (h.distance_before_m - h.distance_m) - DECISION_COST


def _paper(h: DecisionOutcome) -> NDArray[np.float64]:
    """Return r = 1000 a - 1000 b - D_g + g D_c (Krishnan et al. 2021, appendix B, eqs. 2, 3).

    a: goal reached, b: collision, D_g: distance to the goal, D_c = (V_max - V_now) t_max with
    t_max the time an action is held, g: 1 when closer to the goal than before.

    As printed, D_c is added, and only on the way to the goal: it pays slowness there, although
    the text calls it a penalty on speeding away. V_max is 5 m/s whatever the action set; who is
    faster pays. Running out of time costs nothing, and every decision costs its distance.
    """
    ended = PAPER_BONUS * (h.success.astype(np.float64) - h.failure)
    closer = h.distance_m < h.distance_before_m
    correction = (PAPER_SPEED_M_S - h.speed_m_s) * h.hold_s
    return ended - h.distance_m + closer * correction
