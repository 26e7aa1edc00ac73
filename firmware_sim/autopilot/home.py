"""The home position: where it is, and who has put it there."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.core.frames import Geodetic, geodetic_to_local, local_to_geodetic
from firmware_sim.autopilot.error_state import SIGMA, P, V
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.guidance import Guidance

LEAST_MOVE_M, LEAST_CLIMB_M = 1.0, 1.5
"""A vehicle that stands farther from home, or higher or lower, has been moved [m]."""


class Home:
    """Where the vehicle stands while it is disarmed, unless somebody has chosen a place."""

    def __init__(self, estimator: Estimator, guidance: Guidance) -> None:
        """Begin without one; guidance is told of every change."""
        self._estimator, self._guidance = estimator, guidance
        self.place: Geodetic | None = None
        """None until there is a fix."""
        self._is_chosen = False
        """Whether a client or a mission has placed it: arming does not move it."""

    def locate(self) -> None:
        """Set it in flight, once it is known where on the globe the vehicle was armed."""
        origin, context = self._estimator.origin, self._guidance.context
        if origin is not None:
            self.place = local_to_geodetic(np.array(context.home), origin)
            context.home_amsl_m = self.place.altitude_m

    def stands(self) -> None:
        """Follow a disarmed vehicle that stands elsewhere, unless home was chosen.

        Source: PX4 1.16, HomePosition::hasMovedFromCurrentHomeLocation.
        """
        if self.place is None or self._is_chosen:
            return
        state, home = self._estimator.state, self._guidance.context.home
        north, east, down = state[P:V].tolist()
        sigma_north, sigma_east, sigma_down = state[SIGMA : SIGMA + 3].tolist()
        away = math.hypot(north - home[0], east - home[1])
        moved = away > max(2.0 * math.hypot(sigma_north, sigma_east), LEAST_MOVE_M)
        if moved or abs(down - home[2]) > max(2.0 * sigma_down, LEAST_CLIMB_M):
            self.set_here()

    def armed(self) -> bool:
        """Set it to where the vehicle was armed, unless it was chosen; return whether it is new."""
        if self._estimator.origin is None:
            self._guidance.at_home(self._estimator.state)
            return False
        return not self._is_chosen and self.set_here()

    def set_here(self) -> bool:
        """Set it to the present position; return False where that is unknown on the globe."""
        origin, state = self._estimator.origin, self._estimator.state
        if origin is None:
            return False
        self.place = local_to_geodetic(state[P:V], origin)
        self._is_chosen = False
        self._guidance.at_home(state)
        self._guidance.context.home_amsl_m = self.place.altitude_m
        return True

    def set_to(self, place: Geodetic) -> bool:
        """Set it to a chosen place; return False without a fix."""
        if self._estimator.origin is None:
            return False
        self.place, self._is_chosen = place, True
        self.find()
        return True

    def find(self) -> None:
        """Tell guidance where it is in local NED: it, or the origin, has moved."""
        origin, place = self._estimator.origin, self.place
        if origin is None or place is None:
            return
        north, east, down = geodetic_to_local(place, origin).tolist()
        self._guidance.context.home = north, east, down
        self._guidance.context.home_amsl_m = place.altitude_m
