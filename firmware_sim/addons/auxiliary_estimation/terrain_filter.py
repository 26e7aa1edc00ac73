"""Terrain filter: adds the terrain height as a state to any error filter.

PX4's EKF always has a terrain state. Here it is added with the first range, at no cost before. An
inner filter (`ErrorFilter`) carries the 16 errors; this class carries the terrain height, its
variance and its covariance with the 16 errors. Only ranges and optical flow measure the ground. All
other measurements correct the 16 errors as without it. The result equals one filter of 17 states
(Simon, Optimal State Estimation, ch. 5 and 7). Source of the process noise and of the range fusion:
PX4 1.16, EKF/covariance.cpp, terrain_control.cpp and range_height_fusion.cpp.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from airl_mav.core.constants import TICK_S
from airl_mav.core.frames import Vector
from firmware_sim.autopilot import error_state as es

STEP_S = 0.01
"""Time step of PX4's filter, 100 Hz [s]; its terrain noises are per step."""

SIMULATED_MS = 5.0
"""EKF2_RNG_DELAY by default: latency of a range in PX4's simulators. Here a range has no latency,
so only the assumed delay beyond this value counts [ms]."""

GROUND = es.N_STATES
"""Index of the terrain among the 17 states."""

_OF_RANGE = np.zeros(es.N_STATES + 1)
_OF_RANGE[es.POS + 2], _OF_RANGE[GROUND] = -1.0, 1.0
_OF_RANGE.setflags(write=False)
"""Jacobian of the height above ground by the errors: terrain z minus vehicle z."""


def reset_variances(carried: es.ErrorFilter, variances: Mapping[int, float]) -> None:
    """Set variances of errors by their indices, and clear the correlations of these errors."""
    covariance = carried.covariance.copy()
    for index, variance in variances.items():
        covariance[index, :] = covariance[:, index] = 0.0
        covariance[index, index] = variance
    carried.restart(covariance)


class TerrainFilter:
    """Implementation of `error_state.ErrorFilter` with a terrain estimate."""

    def __init__(self, inner: es.ErrorFilter) -> None:
        """Start with the terrain at z = 0; see `put`."""
        self._inner = inner
        self._transition = np.eye(es.N_STATES)
        self.down = 0.0
        """Terrain height, local NED [m]."""
        self.variance = 0.0
        """Variance of the terrain height [m²]."""
        self.cross = np.zeros(es.N_STATES)
        """Covariance (16,) of the terrain height with the errors."""
        self.horizon = es.FusionHorizon(SIMULATED_MS)
        """Vehicle motion since the measurement time of current ranges (EKF2_RNG_DELAY)."""
        self.walk_m_s, self.slope = 0.0, 0.0
        """EKF2_TERR_NOISE and EKF2_TERR_GRAD; both 0 while the ground is the height reference."""

    covariance = property(lambda self: self._inner.covariance)
    """Covariance of the 16 errors, (16, 16)."""

    def predict(self, state: Vector, gyro: Vector, accel: Vector) -> None:
        """Advance the nominal state and all covariances by one tick."""
        # A copy yields the transition matrix, so filters need not expose theirs.
        es.propagate(state.copy(), gyro, accel, self._transition, TICK_S)
        horizon = self.horizon
        before = state[es.P : es.Q].copy() if horizon.is_past else None
        self._inner.predict(state, gyro, accel)
        if before is not None:
            horizon.moved(before, state[es.P : es.Q])
        self.cross = self._transition @ self.cross
        if self.walk_m_s > 0.0:
            north, east = state[es.V : es.V + 2].tolist()
            # Terrain noise: a constant part, and slope times horizontal speed.
            rate = self.walk_m_s**2 + self.slope**2 * (north * north + east * east)
            self.variance += rate * STEP_S * TICK_S

    def restart(self, covariance: Vector) -> None:
        """Continue with another covariance; uncorrelated states lose the terrain correlation."""
        self._inner.restart(covariance)
        # A row with only its diagonal is a state that has been reset.
        alone = np.count_nonzero(covariance, axis=1) <= 1
        self.cross[alone] = 0.0
        # A tiny diagonal keeps the solve regular for states of zero variance.
        known = _solved(covariance + 1e-12 * np.eye(es.N_STATES), self.cross)
        # Otherwise the joint covariance is not positive semidefinite: drop the correlation.
        if known is None or not float(self.cross @ known) <= self.variance:
            self.cross[:] = 0.0

    def fuse(self, state: Vector, innovation: Vector, h: Vector, variance: Vector) -> float:
        """Correct the state by a measurement without terrain, unless it fails the gate."""
        p = self._inner.covariance
        if len(h) == 1:
            # Most measurements are scalar: the same without array overhead.
            row = h[0]
            # Read the covariance before the inner filter changes it.
            before = p @ row
            total = float(row @ before) + variance.item(0)
            ratio = self._inner.fuse(state, innovation, h, variance)
            if ratio <= 1.0:
                # The terrain gains from the correlation only: gain = cross h' / s.
                by_one = float(row @ self.cross)
                weight = by_one / total
                self.down += weight * innovation.item(0)
                self.variance -= by_one * weight
                self.cross = self.cross - before * weight
            return ratio
        spread = p @ h.T
        totals = h @ spread + np.diag(variance)
        ratio = self._inner.fuse(state, innovation, h, variance)
        if ratio <= 1.0:
            by_ground = h @ self.cross
            weights = _solved(totals, by_ground)
            # Singular: the correlation cannot be trusted.
            if weights is None:
                self.cross[:] = 0.0
                return ratio
            self.down += float(weights @ innovation)
            self.variance -= float(by_ground @ weights)
            self.cross = self.cross - spread @ weights
        return ratio

    # --- the ground

    def put(self, down: float, variance: float) -> None:
        """Reset the terrain height and its covariance."""
        self.down, self.variance = down, variance
        self.cross[:] = 0.0

    def clearance_variance(self) -> float:
        """Return the variance of the height above ground [m²]."""
        p = self._inner.covariance
        z = es.POS + 2
        return float(p[z, z]) + self.variance - 2.0 * self.cross.item(z)

    def fuse_range(
        self, state: Vector, innovation: float, variance: float, *, height: bool, ground: bool
    ) -> None:
        """Correct vehicle (`height`) or terrain (`ground`) by a measured height above ground.

        The innovation is measured minus expected [m], with the variance of the measurement [m²].
        """
        self.fuse_with_ground(state, innovation, _OF_RANGE, variance, vehicle=height, ground=ground)

    def fuse_with_ground(
        self,
        state: Vector,
        innovation: float,
        row: Vector,
        variance: float,
        *,
        vehicle: bool,
        ground: bool,
    ) -> None:
        """Correct vehicle or terrain by a measurement that depends on the terrain, without a gate.

        The innovation is measured minus expected; `row` (17,) is the Jacobian by the 16 errors and
        the terrain.
        """
        p = self._joint()
        spread = p @ row
        gain = spread / (float(row @ spread) + variance)
        # A zero gain leaves a state as it is, while its covariance stays consistent.
        if not ground:
            gain[GROUND] = 0.0
        if not vehicle:
            gain[:GROUND] = 0.0
        # Joseph form: valid for any gain.
        p -= np.outer(gain, spread)
        p += np.outer(gain * variance - p @ row, gain)
        # Remove the asymmetry of rounding.
        p = 0.5 * (p + p.T)
        self.down += gain.item(GROUND) * innovation
        self.variance, self.cross = float(p[GROUND, GROUND]), p[:GROUND, GROUND].copy()
        if vehicle:
            self._inner.restart(p[:GROUND, :GROUND])
            es.inject(state, gain[:GROUND] * innovation)

    def spread(self, row: Vector) -> float:
        """Return the variance of an expected measurement by its Jacobian (17,)."""
        return float(row @ self._joint() @ row)

    def _joint(self) -> Vector:
        """Return the covariance of the errors and the terrain (17, 17)."""
        p = np.empty((es.N_STATES + 1, es.N_STATES + 1))
        p[:GROUND, :GROUND] = self._inner.covariance
        p[:GROUND, GROUND] = p[GROUND, :GROUND] = self.cross
        p[GROUND, GROUND] = self.variance
        return p

    def put_by_range(self, innovation: float, variance: float) -> None:
        """Reset the terrain to a height above ground, as uncertain as the vehicle's height."""
        p, z = self._inner.covariance, es.POS + 2
        self.down += innovation
        # The terrain error is the vehicle's height error plus the range error: fully correlated.
        self.variance, self.cross = float(p[z, z]) + variance, p[:, z].copy()


def _solved(matrix: Vector, right: Vector) -> Vector | None:
    """Return x of matrix x = right; None: the matrix is singular.

    Variances stated by clients may differ by more than the floating-point precision.
    """
    try:
        return np.asarray(np.linalg.solve(matrix, right), np.float64)
    except np.linalg.LinAlgError:
        return None
