"""Action sets: from a network's output to a velocity command, in one place.

`arc-25`: five speeds with five yaw rates. `paper-25`: the 25 actions of the paper's text.
`velocity`: the paper's continuous pair, forward and right speed, the nose following.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.policy.actions import Action

ActionSetName = Literal["arc-25", "paper-25", "velocity"]

PAPER_SPEED_M_S = 5.0
"""Fastest action of the paper [m/s]."""

ARC_SPEEDS = (0.0, 0.2, 0.4, 0.7, 1.0)
"""`arc-25`: speeds as shares of the fastest."""

ARC_YAW_RATES_DEG_S = (-72.0, -27.0, 0.0, 27.0, 72.0)
"""`arc-25`: yaw rates [deg/s]."""

PAPER_RIGHT_DEG_S = (108.0, 54.0, 27.0, 13.5, 6.75)
PAPER_LEFT_DEG_S = (-216.0, -108.0, -54.0, -27.0, -13.5)
"""`paper-25`: yaw rates [deg/s] (Air Learning, appendix B)."""

FOLLOW_GAIN_1_S = 1.2
"""`velocity`: yaw rate per angle between nose and course [1/s]; the gain of the greedy policy."""

FOLLOW_MAX_RAD_S = math.radians(90.0)
"""`velocity`: greatest yaw rate [rad/s]."""


class ActionSpec(ProfileModel):
    """An action set and its fastest speed."""

    set: ActionSetName = "arc-25"
    max_speed_m_s: float = quantity(
        "fastest action; all speeds scale with it", "m/s", gt=0, le=30, default=PAPER_SPEED_M_S
    )


def discrete_actions(spec: ActionSpec) -> int | None:
    """Return the number of discrete actions; None for a continuous set."""
    return None if spec.set == "velocity" else 25


def commands(spec: ActionSpec, actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the velocity commands of n actions.

    Args:
        spec: The action set.
        actions: (n,) whole numbers 0..24 of a discrete set; (n, 2) forward and right speed of the
            continuous one, each -1..1 of the fastest; anything beyond is cut off.

    Returns:
        (n, 3) forward and right [m/s] in the heading frame, yaw rate [rad/s], clockwise positive.
    """
    if spec.set != "velocity":
        chosen: NDArray[np.float64] = _table(spec.set, spec.max_speed_m_s)[np.asarray(actions)]
        return chosen
    wanted = np.clip(np.asarray(actions, np.float64), -1.0, 1.0) * spec.max_speed_m_s
    # A vector, not a pair: the corner of the square is no faster than its edges.
    speed = np.hypot(wanted[:, 0], wanted[:, 1])
    wanted *= np.minimum(1.0, spec.max_speed_m_s / np.maximum(speed, 1e-9))[:, None]
    course = np.arctan2(wanted[:, 1], wanted[:, 0])
    # A vehicle that hovers has no course to turn to; the turn grows with the speed.
    turn = np.clip(FOLLOW_GAIN_1_S * course, -FOLLOW_MAX_RAD_S, FOLLOW_MAX_RAD_S)
    turn *= np.minimum(1.0, speed / (0.2 * spec.max_speed_m_s))
    return np.concatenate([wanted, turn[:, None]], axis=1)


def command(spec: ActionSpec, action: NDArray[Any]) -> Action:
    """Return the command of one action, () or (2,)."""
    forward, right, turn = commands(spec, np.asarray(action)[None])[0]
    return Action(float(forward), float(right), float(turn))


@cache
def _table(name: ActionSetName, max_speed: float) -> NDArray[np.float64]:
    """Return the commands (25, 3) of a discrete set."""
    if name == "arc-25":
        rows = [
            (share * max_speed, 0.0, math.radians(rate))
            for share in ARC_SPEEDS
            for rate in ARC_YAW_RATES_DEG_S
        ]
    else:
        slowest = max_speed / PAPER_SPEED_M_S
        rows = [(speed, 0.0, 0.0) for speed in np.linspace(max_speed, slowest, 10)]
        rows += [(-speed, 0.0, 0.0) for speed in np.linspace(max_speed, slowest, 5)]
        rows += [(0.0, 0.0, math.radians(rate)) for rate in PAPER_RIGHT_DEG_S]
        rows += [(0.0, 0.0, math.radians(rate)) for rate in PAPER_LEFT_DEG_S]
    return np.array(rows)
