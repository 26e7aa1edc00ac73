"""Goals: a position on the floor, or a point above it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Goal = tuple[float, float] | tuple[float, float, float]
"""North and east of the start [m], and down for goals with a height: negative above the start."""


def goal_distance_m(goal: Goal, position: Sequence[float] | NDArray[np.float64]) -> float:
    """Return the distance of a position NED (3,) from a goal [m]; horizontal for a 2D goal."""
    away = math.hypot(position[0] - goal[0], position[1] - goal[1])
    return away if len(goal) == 2 else math.hypot(away, position[2] - goal[2])


def goal_height_m(goal: Goal) -> float | None:
    """Return the height of a goal above the start [m]; None for a 2D goal."""
    return None if len(goal) == 2 else -goal[2]
