"""What fixes are compared with, where they are known to come late (EKF2_GPS_DELAY, EKF2_EV_DELAY).

A fix that was measured some time ago says where the vehicle was then. PX4 runs its whole filter in
that past and predicts the present from it. Here the filter runs in the present, and the fix is
compared with where the vehicle was by the present estimate: less what it has moved since. What the
fix corrects is the same, as position and velocity errors hardly change in so short a time (Larsen
et al., Incorporation of time delayed measurements in a discrete-time Kalman filter, CDC 1998: the
delayed state's cross-covariance is taken as the present one's).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from airl_mav.core.constants import TICK_US, US_PER_MS
from airl_mav.core.frames import Vector
from firmware_sim.autopilot.error_state import P, Q

SIMULATED_MS = 10.0
"""EKF2_GPS_DELAY by default: what a fix takes on its way through PX4's simulators. Here it takes
nothing, so that only what is assumed beyond it counts [ms]."""


class FusionHorizon:
    """How position and velocity have changed by prediction since the horizon."""

    def __init__(self, simulated_ms: float = SIMULATED_MS) -> None:
        """Begin in the present: fixes are not late.

        Args:
            simulated_ms: What of the assumed delay fixes do not have here [ms].
        """
        self._simulated_ms = simulated_ms
        self.is_past = False
        """Whether it lies in the past; if not, `moved` need not be called."""
        self._travelled = np.zeros(Q - P)
        self._log: deque[Vector] = deque([self._travelled], maxlen=1)

    def assume(self, delay_ms: float) -> None:
        """Put it so far back as fixes are assumed to be late [ms]."""
        late_us = (delay_ms - self._simulated_ms) * US_PER_MS
        length = 1 + max(0, round(late_us / TICK_US))
        if length != self._log.maxlen:
            self._log = deque([self._travelled], maxlen=length)
            self.is_past = length > 1

    def moved(self, before: Vector, after: Vector) -> None:
        """Note a tick's prediction: position and velocity (6,) NED before and after it."""
        self._travelled = self._travelled + (after - before)
        self._log.append(self._travelled)

    def seen_from(self, state: Vector) -> Vector:
        """Return position and velocity (6,) NED at the horizon, by the present nominal state."""
        return state[P:Q] - (self._travelled - self._log[0])
