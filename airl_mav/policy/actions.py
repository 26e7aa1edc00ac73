"""What a policy does: a velocity and a yaw rate in the heading frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from airl_mav.policy.observation import Observation


@dataclass(frozen=True)
class Action:
    """A horizontal velocity command. The pilot adds the vertical speed that holds altitude."""

    forward_m_s: float
    right_m_s: float
    yaw_rate_rad_s: float
    """Positive clockwise seen from above."""


class Policy(Protocol):
    """Anything that decides."""

    def act(self, observation: Observation) -> Action:
        """Return the action for an observation."""
        ...


def limited(action: Action, speed_m_s: float) -> Action:
    """Return the action with its speed limited and anything that is not finite made zero."""
    numbers = (action.forward_m_s, action.right_m_s, action.yaw_rate_rad_s)
    forward, right, turn = (n if math.isfinite(n) else 0.0 for n in numbers)
    speed = math.hypot(forward, right)
    scale = min(1.0, speed_m_s / speed) if speed > 0.0 else 1.0
    return Action(forward * scale, right * scale, turn)
