"""Measurement buffers of the estimator."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.frames import Vector
from firmware_sim.autopilot import error_state as es


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
