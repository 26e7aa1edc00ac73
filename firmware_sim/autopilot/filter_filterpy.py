"""Error filter based on filterpy: the reference of `KernelFilter`.

It follows the textbook and is many times slower.
"""

from __future__ import annotations

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from airl_mav.core.constants import TICK_S
from airl_mav.core.frames import Vector
from firmware_sim.autopilot.error_state import N_STATES, gate_ratio, inject, propagate


class FilterpyFilter:
    """Implementation of `error_state.ErrorFilter` with filterpy."""

    def __init__(self, covariance: Vector, noise: Vector) -> None:
        """Start with a covariance (16, 16); variances `noise` (16,) are added in every tick."""
        self._ekf = ExtendedKalmanFilter(dim_x=N_STATES, dim_z=1)
        self._ekf.x = np.zeros(N_STATES)
        self._ekf.P, self._ekf.Q = covariance.copy(), np.diag(noise)

    @property
    def covariance(self) -> Vector:
        """Covariance of the error, (16, 16)."""
        p: Vector = self._ekf.P
        return p

    def predict(self, state: Vector, gyro: Vector, accel: Vector) -> None:
        """Advance the nominal state, updated in place, and the covariance by one tick."""
        # filterpy holds F as an attribute: `propagate` writes into it.
        propagate(state, gyro, accel, self._ekf.F, TICK_S)
        self._ekf.predict()

    def restart(self, covariance: Vector) -> None:
        """Continue from another covariance (16, 16)."""
        self._ekf.P = covariance.copy()

    def fuse(self, state: Vector, innovation: Vector, h: Vector, variance: Vector) -> float:
        """Correct the nominal state by one measurement, unless it fails the gate."""
        ekf = self._ekf
        # The gate is tested before `update`, which would change the covariance.
        s = h @ ekf.P @ h.T + np.diag(variance)
        ratio: float = gate_ratio(innovation, np.diag(s).copy())
        if ratio <= 1.0:
            ekf.dim_z = len(innovation)
            ekf.update(innovation, lambda _x: h, lambda x: h @ x, R=np.diag(variance))
            inject(state, ekf.x)
            # The correction is in the nominal state now: the error is zero again.
            ekf.x = np.zeros(N_STATES)
        return ratio
