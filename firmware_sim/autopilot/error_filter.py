"""Interface of the error filters `filter_kernel` and `filter_filterpy`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from airl_mav.core.frames import Vector


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
