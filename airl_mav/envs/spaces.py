"""Gymnasium spaces of observation layouts and action sets."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from airl_mav.policy.action_sets import ActionSpec, discrete_actions
from airl_mav.policy.layouts import ObservationSpec, boxes

BEYOND = 1e6
"""Bound of what a layout leaves unbounded, in its units: nothing that flies here gets there, and
Gymnasium's checker takes infinity for a mistake."""


def observation_space(spec: ObservationSpec) -> gym.spaces.Dict:
    """Return the Dict space of a layout."""
    arrays: dict[str, gym.Space[Any]] = {
        key: gym.spaces.Box(max(box.low, -BEYOND), min(box.high, BEYOND), box.shape, box.dtype)
        for key, box in boxes(spec).items()
    }
    return gym.spaces.Dict(arrays)


def action_space(spec: ActionSpec) -> gym.Space[Any]:
    """Return Discrete(25), or Box(-1, 1, (2,)) of the continuous set."""
    number = discrete_actions(spec)
    if number is not None:
        return gym.spaces.Discrete(number)
    return gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
