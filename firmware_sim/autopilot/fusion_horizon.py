"""Delayed reference for fixes with a known latency (EKF2_GPS_DELAY, EKF2_EV_DELAY).

A delayed fix measures a past position. PX4 runs the whole filter at that past time and predicts the
present from it. Here the filter runs in the present, and the fix is compared with the past
position: the current estimate minus the motion since then. The correction is the same, as errors of
position and velocity hardly change in such a short time (Larsen et al., Incorporation of time
delayed measurements in a discrete-time Kalman filter, CDC 1998: the delayed state's
cross-covariance is taken as the present one's).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from airl_mav.core.constants import TICK_US, US_PER_MS
from airl_mav.core.frames import Vector
from firmware_sim.autopilot.error_state import P, Q

SIMULATED_MS = 10.0
"""EKF2_GPS_DELAY by default: latency of a fix in PX4's simulators. Here a fix has no latency, so
only the assumed delay beyond this value counts [ms]."""


class FusionHorizon:
    """Predicted change of position and velocity since the fusion horizon."""

    def __init__(self, simulated_ms: float = SIMULATED_MS) -> None:
        """Start without a delay.

        Args:
            simulated_ms: Share of the assumed delay that fixes do not have here [ms].
        """
        self._simulated_ms = simulated_ms
        self.is_past = False
        """True if the horizon is in the past; if not, `moved` need not be called."""
        self._travelled = np.zeros(Q - P)
        self._log: deque[Vector] = deque([self._travelled], maxlen=1)

    def assume(self, delay_ms: float) -> None:
        """Set the horizon back by the assumed delay of fixes [ms]."""
        late_us = (delay_ms - self._simulated_ms) * US_PER_MS
        length = 1 + max(0, round(late_us / TICK_US))
        if length != self._log.maxlen:
            self._log = deque([self._travelled], maxlen=length)
            self.is_past = length > 1

    def moved(self, before: Vector, after: Vector) -> None:
        """Record a tick's prediction: position and velocity (6,) NED before and after it."""
        self._travelled = self._travelled + (after - before)
        self._log.append(self._travelled)

    def seen_from(self, state: Vector) -> Vector:
        """Return position and velocity (6,) NED at the horizon, based on the current state."""
        return state[P:Q] - (self._travelled - self._log[0])
