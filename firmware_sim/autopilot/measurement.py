"""What the estimator fuses: buffers of each kind of measurement."""

from __future__ import annotations

import numpy as np

from airl_mav.core.frames import Vector
from firmware_sim.autopilot import error_state as es


class Measurement:
    """Buffers of one kind of measurement: innovation, its variance and Jacobian."""

    def __init__(self, name: str, ratio: int, h: Vector) -> None:
        """Allocate them: `ratio` is its index in the estimate's ratios, h the Jacobian (m, 16)."""
        self.name = name
        self.slot = es.RATIO + ratio
        self.h = h
        self.innovation, self.variance = np.zeros(len(h)), np.zeros(len(h))
        self.fused_us: int | None = None
        """When one was last within the gate; None = never."""


def selecting(*errors: int) -> Vector:
    """Return the Jacobian (m, 16) of a sensor that measures these states themselves."""
    return np.eye(es.N_STATES)[list(errors)]
