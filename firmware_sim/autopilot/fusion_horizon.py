"""Measurements of the estimator, and the delayed reference for late ones (EKF2_GPS_DELAY).

A delayed fix measures a past position. PX4 runs the whole filter at that past time and predicts the
present from it. Here the filter runs in the present, and the fix is compared with the past
position: the current estimate minus the motion since then. The correction is the same, as errors of
position and velocity hardly change in such a short time (Larsen et al., Incorporation of time
delayed measurements in a discrete-time Kalman filter, CDC 1998: the delayed state's
cross-covariance is taken as the present one's).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import TICK_US, US_PER_MS
from airl_mav.core.frames import Vector
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.error_state import P, Q


class ErrorFilter(Protocol):
    """Filter for the error covariance; injects corrections into the nominal state.

    The nominal state is a row of `error_state.ROW_SIZE` floats, updated in place.
    """

    @property
    def covariance(self) -> Vector:
        """Covariance of the error, (16, 16)."""

    def predict(self, state: Vector, gyro: Vector, accel: Vector) -> None:
        """Advance nominal state and covariance by one tick's IMU sample, each (3,) FRD."""

    def restart(self, covariance: Vector) -> None:
        """Continue from another covariance (16, 16), discarding the current one."""

    def fuse(self, state: Vector, innovation: Vector, h: Vector, variance: Vector) -> float:
        """Correct the nominal state by one measurement, unless it fails the gate.

        Args:
            state: Nominal state.
            innovation: Measured minus expected (m,).
            h: Jacobian of the expected measurement by the error (m, 16).
            variance: Variances of the independent noises (m,).

        Returns:
            Test ratio: 1 = at the gate; above 1, or NaN, nothing was corrected.
        """


NewFilter = Callable[[Vector, Vector], ErrorFilter]
"""Factory: filter from the first covariance (16, 16) and each tick's increment of its diagonal."""


class Measurement:
    """Buffers for one type of measurement: innovation, its variance and Jacobian."""

    def __init__(
        self, name: str, ratio: int, h: Vector, fused: NDArray[np.int64] | None = None
    ) -> None:
        """Allocate the buffers.

        Args:
            name: Name of the measurement.
            ratio: Index in the estimate's test ratios.
            h: Jacobian (m, 16).
            fused: (1,) array for the time of the newest fusion [µs]; None = a new array.
        """
        self.name = name
        self.slot = es.RATIO + ratio
        self.h = h
        self.innovation, self.variance = np.zeros(len(h)), np.zeros(len(h))
        self._fused = np.full(1, -1) if fused is None else fused

    @property
    def fused_us(self) -> int | None:
        """Time of the newest sample within the gate [µs]; None = none yet."""
        time_us = self._fused.item(0)
        return None if time_us < 0 else time_us

    @fused_us.setter
    def fused_us(self, time_us: int | None) -> None:
        self._fused[0] = -1 if time_us is None else time_us


def selecting(*errors: int) -> Vector:
    """Return the Jacobian (m, 16) of a sensor that measures these states directly."""
    return np.eye(es.N_STATES)[list(errors)]


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
        # A delay shorter than the simulated latency counts as none.
        late_us = (delay_ms - self._simulated_ms) * US_PER_MS
        length = 1 + max(0, round(late_us / TICK_US))
        if length != self._log.maxlen:
            # A new length discards the log: the horizon starts at the present.
            self._log = deque([self._travelled], maxlen=length)
            self.is_past = length > 1

    def moved(self, before: Vector, after: Vector) -> None:
        """Record a tick's prediction: position and velocity (6,) NED before and after it."""
        # A new array each time: the log keeps the old ones.
        self._travelled = self._travelled + (after - before)
        self._log.append(self._travelled)

    def seen_from(self, state: Vector) -> Vector:
        """Return position and velocity (6,) NED at the horizon, based on the current state."""
        # The log's first entry is the motion up to the horizon.
        return state[P:Q] - (self._travelled - self._log[0])
