"""Landing detector by thrust, speed and time, like PX4's multicopter land detector."""

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

# Share of the range from minimum to hover thrust below which the ground must carry the vehicle
# (LNDMC_LOW_T_THR).
LOW_THRUST = 0.3
# Thrust relative to hover thrust that indicates lift-off while climbing.
LIFT_THRUST = 0.95
LIFT_SPEED_M_S = 0.15
# Vertical speed that indicates flight at any thrust, in multiples of LNDMC_Z_VEL_MAX: PX4's limit
# right after take-off, wide enough to exclude motor-induced sensor noise.
LIFTED_SPEED = 2.5
# Height above ground by range beyond which the vehicle is not landed [m].
NEAR_GROUND_M = 1.0
# Factor on the detection time while the range to the ground is invalid.
UNSURE = 3.0


# Layout of the thresholds.
_TRIGGER_US, _CARRIED_THRUST, _SLOW_DOWN, _SLOW, _LIFT_THRUST, _LIFTED_M_S, _NEAR = range(7)


def thresholds(value: Callable[[str], float]) -> Vector:
    """Return the thresholds from the parameters (7,).

    LNDMC_TRIG_TIME [µs]; thrust below which the ground must carry the vehicle; vertical and
    horizontal speed at rest [m/s]; thrust in flight; vertical speed that indicates flight at any
    thrust [m/s]; 1 = near the ground, or unknown.
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
    """Return whether motion and collective 0..1 indicate a vehicle carried by the ground."""
    slow = abs(state[V + 2]) < land[_SLOW_DOWN]
    return bool(
        thrust <= land[_CARRIED_THRUST]
        and slow
        and math.hypot(state[V], state[V + 1]) < land[_SLOW]
        and land[_NEAR] != 0.0
    )


@kernel
def lifts_off(state: Vector, thrust: float, land: Vector) -> bool:
    """Return whether a standing vehicle has left the ground.

    MPC_THR_HOVER may be wrong: a lighter vehicle climbs at less thrust.
    """
    # Lift-off needs both climb and thrust near hover, or a fast climb.
    climb_m_s = -state[V + 2]
    hovers = climb_m_s > LIFT_SPEED_M_S and thrust > land[_LIFT_THRUST]
    return bool(climb_m_s > land[_LIFTED_M_S] or hovers)


class LandDetector:
    """Thresholds in a flight controller's record; compiled ticks do the detection."""

    def __init__(self, value: Callable[[str], float], record: NDArray[Any]) -> None:
        """Store the look-up for PX4 parameters and the record of a flight controller."""
        self._value, self._record = value, record
        self._ground: Clearance | None = None
        self._ground_seen = False
        """True if ranges have ever measured the ground."""
        self.read_parameters()

    def read_parameters(self) -> None:
        """Read the parameters again."""
        self._record["land"] = thresholds(self._value)
        self.see(self._ground)

    def carries(self, thrust: float) -> bool:
        """Return whether the ground must carry the vehicle at a collective thrust 0..1."""
        return bool(thrust <= self._record["land"].item(0, _CARRIED_THRUST))

    def see(self, ground: Clearance | None) -> None:
        """Update the height above ground; None = not measured.

        Landing requires that ranges, if present, indicate the ground.
        """
        land, self._ground = self._record["land"][0], ground
        if ground is None:
            return
        # A terrain estimate without ranges must not prevent a landing.
        self._ground_seen = self._ground_seen or ground.by_range
        far = ground.valid and ground.dist_bottom_m >= NEAR_GROUND_M
        unsure = UNSURE if self._ground_seen and not ground.valid else 1.0
        land[_TRIGGER_US] = self._value("LNDMC_TRIG_TIME") * US_PER_S * unsure
        land[_NEAR] = not (self._ground_seen and far)
