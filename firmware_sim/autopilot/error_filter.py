"""What carries the covariance of the estimator's error: `filter_kernel`, `filter_filterpy`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from airl_mav.core.frames import Vector


class ErrorFilter(Protocol):
    """Carries the covariance of the error, and moves corrections into the nominal state.

    The nominal state is a row of `error_state.ROW_SIZE` floats, updated in place.
    """

    @property
    def covariance(self) -> Vector:
        """Covariance of the error, (16, 16)."""

    def predict(self, state: Vector, gyro: Vector, accel: Vector) -> None:
        """Move nominal state and covariance by one tick's IMU sample, each (3,) FRD."""

    def restart(self, covariance: Vector) -> None:
        """Go on from another covariance (16, 16): what was known is so no longer."""

    def fuse(self, state: Vector, innovation: Vector, h: Vector, variance: Vector) -> float:
        """Correct the nominal state by one measurement, unless it fails the gate.

        Args:
            state: Nominal state.
            innovation: Measured less expected (m,).
            h: Jacobian of what is expected by the error (m, 16).
            variance: Of the independent noises (m,).

        Returns:
            The test ratio: 1 = at the gate; above it, or NaN, nothing was corrected.
        """


NewFilter = Callable[[Vector, Vector], ErrorFilter]
"""Makes a filter from the first covariance (16, 16) and what each tick adds to its diagonal."""
