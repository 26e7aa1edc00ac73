"""A filter that knows the height of the ground, too: one more state around any other filter.

PX4's EKF has the terrain among its states. Here it is added when the first range comes, so that
nothing is spent on it before. The filter of the 16 errors is another one's (`ErrorFilter`); this
carries the ground's height, its variance and its covariance with the 16 errors. Nothing but a range
measures the ground, so that the 16 errors are corrected by all else as if there were no such state.
The whole equals one filter of 17 states (Simon, Optimal State Estimation, ch. 5 and 7).
Source of the process noise and of how a range is fused: PX4 1.16, EKF/covariance.cpp,
terrain_control.cpp and range_height_fusion.cpp.
"""

from __future__ import annotations

import numpy as np

from airl_mav.core.constants import TICK_S
from airl_mav.core.frames import Vector
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.error_filter import ErrorFilter
from firmware_sim.autopilot.fusion_horizon import FusionHorizon

STEP_S = 0.01
"""PX4's filter runs at 100 Hz: its noises of the ground are per such a step [s]."""

SIMULATED_MS = 5.0
"""EKF2_RNG_DELAY by default: what a range takes on its way through PX4's simulators. Here it takes
nothing, so that only what is assumed beyond it counts [ms]."""

GROUND = es.N_STATES
"""Index of the ground among 17 states."""

_OF_RANGE = np.zeros(es.N_STATES + 1)
_OF_RANGE[es.POS + 2], _OF_RANGE[GROUND] = -1.0, 1.0
_OF_RANGE.setflags(write=False)
"""How the height above ground depends on the errors: the ground's z less the vehicle's."""


class TerrainFilter:
    """Implements `error_filter.ErrorFilter`, and estimates where the ground is."""

    def __init__(self, inner: ErrorFilter) -> None:
        """Begin with the ground at z = 0; see `put`."""
        self._inner = inner
        self._transition = np.eye(es.N_STATES)
        self.down = 0.0
        """Where the ground is, local NED [m]."""
        self.variance = 0.0
        """Of that [m²]."""
        self.cross = np.zeros(es.N_STATES)
        """Covariance (16,) of that with the errors."""
        self.horizon = FusionHorizon(SIMULATED_MS)
        """Where the vehicle was when a range that comes now was measured (EKF2_RNG_DELAY)."""
        self.walk_m_s, self.slope = 0.0, 0.0
        """EKF2_TERR_NOISE and EKF2_TERR_GRAD; both 0 while the ground is the height's reference."""

    covariance = property(lambda self: self._inner.covariance)
    """Of the 16 errors, (16, 16)."""

    def predict(self, state: Vector, gyro: Vector, accel: Vector) -> None:
        """Move the nominal state and all covariances by one tick."""
        # What the errors become is found on a copy: no filter needs to tell its matrices.
        es.propagate(state.copy(), gyro, accel, self._transition, TICK_S)
        horizon = self.horizon
        before = state[es.P : es.Q].copy() if horizon.is_past else None
        self._inner.predict(state, gyro, accel)
        if before is not None:
            horizon.moved(before, state[es.P : es.Q])
        self.cross = self._transition @ self.cross
        if self.walk_m_s > 0.0:
            north, east = state[es.V : es.V + 2].tolist()
            rate = self.walk_m_s**2 + self.slope**2 * (north * north + east * east)
            self.variance += rate * STEP_S * TICK_S

    def restart(self, covariance: Vector) -> None:
        """Continue with another covariance. Uncorrelated states lose that with the ground."""
        self._inner.restart(covariance)
        alone = np.count_nonzero(covariance, axis=1) <= 1
        self.cross[alone] = 0.0
        known = _solved(covariance + 1e-12 * np.eye(es.N_STATES), self.cross)
        if known is None or not float(self.cross @ known) <= self.variance:
            self.cross[:] = 0.0

    def fuse(self, state: Vector, innovation: Vector, h: Vector, variance: Vector) -> float:
        """Correct the state by a measurement that is none of the ground, unless it fails."""
        p = self._inner.covariance
        if len(h) == 1:
            # Most are: the same without what arrays cost.
            row = h[0]
            before = p @ row
            total = float(row @ before) + variance.item(0)
            ratio = self._inner.fuse(state, innovation, h, variance)
            if ratio <= 1.0:
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
            if weights is None:
                self.cross[:] = 0.0
                return ratio
            self.down += float(weights @ innovation)
            self.variance -= float(by_ground @ weights)
            self.cross = self.cross - spread @ weights
        return ratio

    # --- the ground

    def put(self, down: float, variance: float) -> None:
        """Say where the ground is; nothing else tells of it."""
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
        """Correct by a height above ground.

        Args:
            state: Nominal state, updated.
            innovation: Measured less expected [m].
            variance: Of the measurement [m²].
            height: Whether it says how high the vehicle is.
            ground: Whether it says where the ground is.
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
        """Correct by a measurement that the ground has a part in; there is no gate.

        Args:
            state: Nominal state, updated.
            innovation: Measured less expected.
            row: How it changes by the 16 errors and the ground (17,).
            variance: Of the measurement.
            vehicle: Whether it tells of the vehicle.
            ground: Whether it says where the ground is.
        """
        p = self._joint()
        spread = p @ row
        gain = spread / (float(row @ spread) + variance)
        if not ground:
            gain[GROUND] = 0.0
        if not vehicle:
            gain[:GROUND] = 0.0
        # Joseph's form: right for any gain.
        p -= np.outer(gain, spread)
        p += np.outer(gain * variance - p @ row, gain)
        p = 0.5 * (p + p.T)
        self.down += gain.item(GROUND) * innovation
        self.variance, self.cross = float(p[GROUND, GROUND]), p[:GROUND, GROUND].copy()
        if vehicle:
            self._inner.restart(p[:GROUND, :GROUND])
            es.inject(state, gain[:GROUND] * innovation)

    def spread(self, row: Vector) -> float:
        """Return the variance that errors and ground give a measurement, by its Jacobian (17,)."""
        return float(row @ self._joint() @ row)

    def _joint(self) -> Vector:
        """Return the covariance of the errors and the ground (17, 17)."""
        p = np.empty((es.N_STATES + 1, es.N_STATES + 1))
        p[:GROUND, :GROUND] = self._inner.covariance
        p[:GROUND, GROUND] = p[GROUND, :GROUND] = self.cross
        p[GROUND, GROUND] = self.variance
        return p

    def put_by_range(self, innovation: float, variance: float) -> None:
        """Put the ground where a height above ground says, as uncertain as the vehicle's height."""
        p, z = self._inner.covariance, es.POS + 2
        self.down += innovation
        self.variance, self.cross = float(p[z, z]) + variance, p[:, z].copy()


def _solved(matrix: Vector, right: Vector) -> Vector | None:
    """Return x of matrix x = right; None: the matrix is singular.

    Variances that a client has stated may lie further apart than numbers are exact.
    """
    try:
        return np.asarray(np.linalg.solve(matrix, right), np.float64)
    except np.linalg.LinAlgError:
        return None
