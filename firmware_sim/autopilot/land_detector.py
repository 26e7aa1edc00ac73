"""The landing detector: thrust, speed and time decide, as PX4's multicopter land detector."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from airl_mav.constants import US_PER_S
from firmware_sim.autopilot.state import Estimate

# Share of the way from least to hover thrust below which the floor must be carrying
# (LNDMC_LOW_T_THR).
LOW_THRUST = 0.3
# Thrust this close to hover, going up: it flies.
LIFT_THRUST = 0.95
LIFT_SPEED_M_S = 0.15


class LandDetector:
    """Stateful: landed needs LNDMC_TRIG_TIME of stillness at low thrust."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Take a lookup of PX4 parameter names."""
        self._value = value
        self._still_since_us: int | None = None

    def landed(self, estimate: Estimate, thrust: float, descending: bool) -> bool:
        """Return whether a flying vehicle has come to stand.

        Args:
            estimate: Newest estimate.
            thrust: Collective that is commanded, 0..1.
            descending: Whether the setpoint asks to go down: a low-thrust moment in
                level flight is no landing.
        """
        value = self._value
        low = value("MPC_THR_MIN")
        limit = low + LOW_THRUST * (value("MPC_THR_HOVER") - low)
        still = (
            descending
            and thrust <= limit
            and abs(estimate.velocity[2]) < value("LNDMC_Z_VEL_MAX")
            and np.hypot(*estimate.velocity[:2]) < value("LNDMC_XY_VEL_MAX")
        )
        if not still:
            self._still_since_us = None
            return False
        if self._still_since_us is None:
            self._still_since_us = estimate.time_us
        elapsed_us = estimate.time_us - self._still_since_us
        return elapsed_us >= value("LNDMC_TRIG_TIME") * US_PER_S

    def lifted(self, estimate: Estimate, thrust: float) -> bool:
        """Return whether a standing vehicle has left the floor."""
        self._still_since_us = None
        climbing = estimate.velocity[2] < -LIFT_SPEED_M_S
        return bool(climbing and thrust > LIFT_THRUST * self._value("MPC_THR_HOVER"))
