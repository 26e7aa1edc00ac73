"""Home position: storage, automatic updates and client requests."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.core.frames import Geodetic, geodetic_to_local, local_to_geodetic
from firmware_sim.autopilot.error_state import SIGMA, P, V
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.guidance import Guidance

LEAST_MOVE_M, LEAST_CLIMB_M = 1.0, 1.5
"""Minimum horizontal and vertical distance from home that count as a move [m]."""


class Home:
    """Home position; follows the disarmed vehicle unless a client or mission chose a place."""

    def __init__(self, estimator: Estimator, guidance: Guidance) -> None:
        """Start without a home; guidance receives every change."""
        self._estimator, self._guidance = estimator, guidance
        self.place: Geodetic | None = None
        """Geodetic home; None before the first fix."""
        self._is_chosen = False
        """True if set by a client or a mission; arming then keeps it."""

    def locate(self) -> None:
        """Set home in flight, once the geodetic position of arming is known."""
        origin, context = self._estimator.origin, self._guidance.context
        if origin is not None:
            self.place = local_to_geodetic(np.array(context.home), origin)
            context.home_amsl_m = self.place.altitude_m

    def stands(self) -> None:
        """Move home with a disarmed vehicle, unless home was chosen.

        Source: PX4 1.16, HomePosition::hasMovedFromCurrentHomeLocation.
        """
        if self.place is None or self._is_chosen:
            return
        state, home = self._estimator.state, self._guidance.context.home
        north, east, down = state[P:V].tolist()
        sigma_north, sigma_east, sigma_down = state[SIGMA : SIGMA + 3].tolist()
        away = math.hypot(north - home[0], east - home[1])
        # Both limits: an inaccurate estimate alone does not move home.
        moved = away > max(2.0 * math.hypot(sigma_north, sigma_east), LEAST_MOVE_M)
        if moved or abs(down - home[2]) > max(2.0 * sigma_down, LEAST_CLIMB_M):
            self.set_here()

    def armed(self) -> bool:
        """Set home to the arming position unless chosen; return whether home is new."""
        # Without a fix, only local home is known.
        if self._estimator.origin is None:
            self._guidance.at_home(self._estimator.state)
            return False
        return not self._is_chosen and self.set_here()

    def set_here(self) -> bool:
        """Set home to the current position; return False if there is no geodetic origin."""
        origin, state = self._estimator.origin, self._estimator.state
        if origin is None:
            return False
        self.place = local_to_geodetic(state[P:V], origin)
        self._is_chosen = False
        self._guidance.at_home(state)
        self._guidance.context.home_amsl_m = self.place.altitude_m
        return True

    def set_to(self, place: Geodetic) -> bool:
        """Set home to a chosen place; return False without a fix."""
        if self._estimator.origin is None:
            return False
        self.place, self._is_chosen = place, True
        self.find()
        return True

    def find(self) -> None:
        """Update guidance's local NED home after a move of home or origin."""
        origin, place = self._estimator.origin, self.place
        if origin is None or place is None:
            return
        north, east, down = geodetic_to_local(place, origin).tolist()
        self._guidance.context.home = north, east, down
        self._guidance.context.home_amsl_m = place.altitude_m
