"""The landing detector: thrust, speed and time decide, as PX4's multicopter land detector."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

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
_TRIGGER_US, _CARRIED_THRUST, _SLOW_DOWN, _SLOW, _LIFT_THRUST, _LIFTED_M_S = range(6)


def thresholds(value: Callable[[str], float]) -> Vector:
    """Return what the parameters say (6,).

    LNDMC_TRIG_TIME [µs]; the thrust below which the floor must be carrying; vertical and horizontal
    speed of a vehicle at rest [m/s]; thrust of one that flies; vertical speed of one that has left
    the floor at any thrust [m/s].
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
    """Detects a landing after LNDMC_TRIG_TIME without motion at low thrust."""

    def __init__(self, value: Callable[[str], float], record: Any = None) -> None:
        """Take a lookup of PX4 parameter names.

        `record` is that of the flight controller; None = a new one.
        """
        if record is None:
            from firmware_sim.engine.record import new_controller

            record = new_controller()
        self._value = value
        self._record = record
        self.read_parameters()
        self.ground: Clearance | None = None
        """How far the ground is below; None = nothing tells it."""
        self._ground_seen = False
        """Whether ranges have ever told the ground."""

    def landed(self, state: Vector, time_us: int, thrust: float, *, descending: bool) -> bool:
        """Return whether a flying vehicle has come to stand.

        `thrust` is the collective that is commanded, 0..1. `descending`: the setpoint asks to go
        down; a low-thrust moment in level flight is no landing.
        """
        ground, record = self.ground, self._record
        if ground is not None and ground.by_range:
            self._ground_seen = True
        if not (descending and rests(state, thrust, self._land) and self._is_near_ground()):
            record["still_since_us"] = -1
            return False
        if record["still_since_us"][0] < 0:
            record["still_since_us"] = time_us
        needed_us = self._land[_TRIGGER_US]
        if self._ground_seen and self.ground is not None and not self.ground.valid:
            needed_us *= UNSURE
        return bool(time_us - record["still_since_us"][0] >= needed_us)

    def lifted(self, state: Vector, thrust: float) -> bool:
        """Return whether a standing vehicle has left the floor."""
        self._record["still_since_us"] = -1
        return bool(lifts_off(state, thrust, self._land))

    def _is_near_ground(self) -> bool:
        """Return whether ranges allow that the vehicle stands; without any they do."""
        ground = self.ground
        if ground is None:
            return True
        return not (self._ground_seen and ground.valid and ground.dist_bottom_m >= NEAR_GROUND_M)

    def read_parameters(self) -> None:
        """Read the parameters anew."""
        self._record["land"] = thresholds(self._value)
        self._land = self._record["land"][0]
