"""Error filter in compiled code: the default.

Equivalent to `filter_filterpy` up to rounding. It uses the structure of the matrices: most rows of
the transition matrix equal the identity's. The noises of a measurement's components are
independent, so sequential fusion equals joint fusion (Bar-Shalom, Li, Kirubarajan, Estimation with
Applications to Tracking and Navigation, ch. 7.2.2). The covariance is always exactly symmetric.
"""

from __future__ import annotations

import numpy as np

from airl_mav.core.constants import TICK_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from firmware_sim.autopilot.error_state import (
    ACC,
    ATT,
    GYRO,
    N_STATES,
    POS,
    VEL,
    gate_ratio,
    inject,
    propagate,
)

_MOVING = 9
"""Number of propagated states: position, velocity, attitude. Biases and offset are constant."""


@kernel
def _times_transposed(f: Vector, p: Vector, columns: int, out: Vector) -> None:
    """Write (f p)' (columns, 9) for the moving rows of f (16, 16) and the first columns of p."""
    # Position, velocity and attitude rows in turn; only entries that differ from I are used.
    for j in range(columns):
        ax, ay, az = p[ATT, j], p[ATT + 1, j], p[ATT + 2, j]
        bx, by, bz = p[ACC, j], p[ACC + 1, j], p[ACC + 2, j]
        for k in range(3):
            i = POS + k
            out[j, i] = p[i, j] + f[i, VEL + k] * p[VEL + k, j]
            i = VEL + k
            by_attitude = f[i, ATT] * ax + f[i, ATT + 1] * ay + f[i, ATT + 2] * az
            by_bias = f[i, ACC] * bx + f[i, ACC + 1] * by + f[i, ACC + 2] * bz
            out[j, i] = p[i, j] + by_attitude + by_bias
            # f holds the unit diagonal of the attitude block.
            i = ATT + k
            turned = f[i, ATT] * ax + f[i, ATT + 1] * ay + f[i, ATT + 2] * az
            out[j, i] = turned + f[i, GYRO + k] * p[GYRO + k, j]


@kernel
def predict(
    state: Vector, p: Vector, noise: Vector, f: Vector, gyro: Vector, accel: Vector, dt: float
) -> None:
    """Advance the nominal state and its covariance, p = f p f' + noise, in place."""
    propagate(state, gyro, accel, f, dt)
    half = np.empty((N_STATES, _MOVING))
    whole = np.empty((_MOVING, _MOVING))
    # First f p, then (f p) f', each transposed, so that one function does both.
    _times_transposed(f, p, N_STATES, half)
    _times_transposed(f, half, _MOVING, whole)
    # Compute the upper triangle and mirror it: the covariance stays exactly symmetric.
    for i in range(_MOVING):
        for j in range(i, _MOVING):
            p[i, j] = p[j, i] = whole[i, j]
        # Biases and offset do not move: only their covariance with moving states changes.
        for j in range(_MOVING, N_STATES):
            p[i, j] = p[j, i] = half[j, i]
    for i in range(N_STATES):
        p[i, i] += noise[i]


@kernel
def fuse(state: Vector, p: Vector, innovation: Vector, h: Vector, variance: Vector) -> float:
    """Correct the nominal state and its covariance in place; return the gate ratio."""
    m = len(innovation)
    column = np.empty(N_STATES)
    total = np.empty(m)
    # The gate tests all components against the covariance before the fusion.
    for k in range(m):
        total[k] = spread(p, h[k], column) + variance[k]
    ratio = gate_ratio(innovation, total)
    # False for NaN, too.
    if not ratio <= 1.0:
        return ratio
    error = np.zeros(N_STATES)
    # Sequential scalar fusion: no matrix inverse.
    for k in range(m):
        weight = 1.0 / (spread(p, h[k], column) + variance[k])
        # The error so far already explains a part of this component.
        rest = innovation[k]
        for i in range(N_STATES):
            rest -= h[k, i] * error[i]
        for i in range(N_STATES):
            # p is symmetric: p h' is both the column and, transposed, the row.
            error[i] += column[i] * rest * weight
            for j in range(N_STATES):
                p[i, j] -= column[i] * column[j] * weight
    inject(state, error)
    return ratio


@kernel
def spread(p: Vector, row: Vector, out: Vector) -> float:
    """Write p row' (16,); return row p row'. Zeros of the row are skipped."""
    out[:] = 0.0
    for k in range(N_STATES):
        if row[k] != 0.0:
            for i in range(N_STATES):
                out[i] += row[k] * p[k, i]
    square = 0.0
    for k in range(N_STATES):
        square += row[k] * out[k]
    return square


class KernelFilter:
    """Implementation of `fusion_horizon.ErrorFilter` in compiled code."""

    def __init__(self, covariance: Vector, noise: Vector) -> None:
        """Start with a covariance (16, 16); variances `noise` (16,) are added in every tick."""
        self.covariance = covariance.copy()
        self._noise = noise.copy()
        self._transition = np.eye(N_STATES)

    def keep_in(self, covariance: Vector, transition: Vector, noise: Vector) -> None:
        """Use these arrays for covariance and transition (16, 16) and noise (16,) from now on."""
        # Copy the values first: the arrays of the record replace the own ones.
        covariance[:], transition[:], noise[:] = self.covariance, self._transition, self._noise
        self.covariance, self._transition, self._noise = covariance, transition, noise

    def predict(self, state: Vector, gyro: Vector, accel: Vector) -> None:
        """Advance the nominal state, updated in place, and the covariance by one tick."""
        predict(state, self.covariance, self._noise, self._transition, gyro, accel, TICK_S)

    def restart(self, covariance: Vector) -> None:
        """Continue from another covariance (16, 16)."""
        self.covariance[:] = covariance

    def fuse(self, state: Vector, innovation: Vector, h: Vector, variance: Vector) -> float:
        """Correct the nominal state by one measurement, unless it fails the gate."""
        ratio: float = fuse(state, self.covariance, innovation, h, variance)
        return ratio
