"""The landing detector: thrust, speed and time decide, as PX4's multicopter land detector."""

from __future__ import annotations

import math
from collections.abc import Callable

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from firmware_sim.autopilot.autopilot_state import Clearance
from firmware_sim.autopilot.error_state import V

# Share of the way from least to hover thrust below which the floor must be carrying
# (LNDMC_LOW_T_THR).
LOW_THRUST = 0.3
# Thrust this close to hover, going up: it flies.
LIFT_THRUST = 0.95
LIFT_SPEED_M_S = 0.15
# So fast it flies at any thrust, as multiples of LNDMC_Z_VEL_MAX: PX4's bound for vertical movement
# right after take-off, wider than later so that what motors do to sensors is not taken for one.
LIFTED_SPEED = 2.5
# Further above the ground than this, by a range, nothing stands [m].
NEAR_GROUND_M = 1.0
# A range that tells no ground any more makes the detection take so many times as long.
UNSURE = 3.0


class LandDetector:
    """Detects a landing after LNDMC_TRIG_TIME without motion at low thrust."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Take a lookup of PX4 parameter names."""
        self._value = value
        self._still_since_us: int | None = None
        self.ground: Clearance | None = None
        """How far the ground is below; None = nothing tells it."""
        self._ground_seen = False
        """Whether ranges have ever told the ground."""

    def landed(self, state: Vector, time_us: int, thrust: float, *, descending: bool) -> bool:
        """Return whether a flying vehicle has come to stand.

        `thrust` is the collective that is commanded, 0..1. `descending`: the setpoint asks to go
        down; a low-thrust moment in level flight is no landing.
        """
        ground = self.ground
        if ground is not None and ground.by_range:
            self._ground_seen = True
        if not (
            descending and self._carried(thrust) and self._still(state) and self._is_near_ground()
        ):
            self._still_since_us = None
            return False
        if self._still_since_us is None:
            self._still_since_us = time_us
        needed_s = self._value("LNDMC_TRIG_TIME")
        if self._ground_seen and self.ground is not None and not self.ground.valid:
            needed_s *= UNSURE
        return time_us - self._still_since_us >= needed_s * US_PER_S

    def lifted(self, state: Vector, thrust: float) -> bool:
        """Return whether a standing vehicle has left the floor.

        MPC_THR_HOVER may be wrong: one that is lighter than it says climbs at less thrust.
        """
        self._still_since_us = None
        climb_m_s = -state.item(V + 2)
        if climb_m_s > LIFTED_SPEED * self._value("LNDMC_Z_VEL_MAX"):
            return True
        hovers = thrust > LIFT_THRUST * self._value("MPC_THR_HOVER")
        return climb_m_s > LIFT_SPEED_M_S and hovers

    def _is_near_ground(self) -> bool:
        """Return whether ranges allow that the vehicle stands; without any they do."""
        ground = self.ground
        if ground is None:
            return True
        return not (self._ground_seen and ground.valid and ground.dist_bottom_m >= NEAR_GROUND_M)

    def _carried(self, thrust: float) -> bool:
        low = self._value("MPC_THR_MIN")
        return thrust <= low + LOW_THRUST * (self._value("MPC_THR_HOVER") - low)

    def _still(self, state: Vector) -> bool:
        north, east, down = state[V : V + 3].tolist()
        slow = abs(down) < self._value("LNDMC_Z_VEL_MAX")
        return slow and math.hypot(north, east) < self._value("LNDMC_XY_VEL_MAX")
