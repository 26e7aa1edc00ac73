"""The home position: where it is, and who has put it there."""

from __future__ import annotations

from airl_mav.core.frames import Geodetic, geodetic_to_local, local_to_geodetic
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.guidance import Guidance


class Home:
    """Set where the vehicle stands at boot and at arming, unless somebody has chosen a place."""

    def __init__(self, estimator: Estimator, guidance: Guidance) -> None:
        """Begin without one; guidance is told of every change."""
        self._estimator, self._guidance = estimator, guidance
        self.place: Geodetic | None = None
        """None until there is a fix."""
        self._is_chosen = False
        """Whether a client or a mission has placed it: arming does not move it."""

    def boot(self) -> bool:
        """Set it as soon as there is a fix; return whether it is new."""
        return self.place is None and self.set_here()

    def armed(self) -> bool:
        """Set it to where the vehicle was armed, unless it was chosen; return whether it is new."""
        return not self._is_chosen and self.set_here()

    def set_here(self) -> bool:
        """Set it to the present position; return False without a fix."""
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
        origin = self._estimator.origin
        if origin is None:
            return False
        self.place, self._is_chosen = place, True
        north, east, down = geodetic_to_local(place, origin).tolist()
        self._guidance.context.home = north, east, down
        self._guidance.context.home_amsl_m = place.altitude_m
        return True
