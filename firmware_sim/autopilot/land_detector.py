"""The landing detector: thrust, speed and time decide, as PX4's multicopter land detector."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
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


# Layout of the thresholds.
_TRIGGER_US, _CARRIED_THRUST, _SLOW_DOWN, _SLOW, _LIFT_THRUST, _LIFTED_M_S, _NEAR = range(7)


def thresholds(value: Callable[[str], float]) -> Vector:
    """Return the thresholds by the parameters (7,).

    LNDMC_TRIG_TIME [µs]; the thrust below which the floor must be carrying; vertical and horizontal
    speed of a vehicle at rest [m/s]; thrust of one that flies; vertical speed of one that has left
    the floor at any thrust [m/s]; 1 = near the ground as far as is known.
    """
    low, hover, vertical = value("MPC_THR_MIN"), value("MPC_THR_HOVER"), value("LNDMC_Z_VEL_MAX")
    return np.array(
        [
            value("LNDMC_TRIG_TIME") * US_PER_S,
            low + LOW_THRUST * (hover - low),
            vertical,
            value("LNDMC_XY_VEL_MAX"),
            LIFT_THRUST * hover,
            LIFTED_SPEED * vertical,
            1.0,
        ]
    )


@kernel
def rests(state: Vector, thrust: float, land: Vector) -> bool:
    """Return whether a vehicle at a collective 0..1 moves as one that the floor carries."""
    slow = abs(state[V + 2]) < land[_SLOW_DOWN]
    return bool(
        thrust <= land[_CARRIED_THRUST]
        and slow
        and math.hypot(state[V], state[V + 1]) < land[_SLOW]
        and land[_NEAR] != 0.0
    )


@kernel
def lifts_off(state: Vector, thrust: float, land: Vector) -> bool:
    """Return whether a standing vehicle has left the floor.

    MPC_THR_HOVER may be wrong: one that is lighter than it says climbs at less thrust.
    """
    climb_m_s = -state[V + 2]
    hovers = climb_m_s > LIFT_SPEED_M_S and thrust > land[_LIFT_THRUST]
    return bool(climb_m_s > land[_LIFTED_M_S] or hovers)


class LandDetector:
    """Keeps the thresholds of a flight controller's record; compiled ticks detect."""

    def __init__(self, value: Callable[[str], float], record: NDArray[Any]) -> None:
        """Take a lookup of PX4 parameter names and the record of a flight controller."""
        self._value, self._record = value, record
        self._ground: Clearance | None = None
        self._ground_seen = False
        """Whether ranges have ever told the ground."""
        self.read_parameters()

    def read_parameters(self) -> None:
        """Read the parameters anew."""
        self._record["land"] = thresholds(self._value)
        self.see(self._ground)

    def see(self, ground: Clearance | None) -> None:
        """Take how far the ground is below; None = nothing tells it.

        A vehicle stands only where ranges allow it; without any they do.
        """
        land, self._ground = self._record["land"][0], ground
        if ground is None:
            return
        self._ground_seen = self._ground_seen or ground.by_range
        far = ground.valid and ground.dist_bottom_m >= NEAR_GROUND_M
        unsure = UNSURE if self._ground_seen and not ground.valid else 1.0
        land[_TRIGGER_US] = self._value("LNDMC_TRIG_TIME") * US_PER_S * unsure
        land[_NEAR] = not (self._ground_seen and far)
