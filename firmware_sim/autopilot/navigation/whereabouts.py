"""Position of the vehicle for missions, the geofence and Return."""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.core.frames import Geodetic, local_to_geodetic
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.guidance import Home
from firmware_sim.autopilot.modes.interface import here, triple
from firmware_sim.autopilot.navigation.flown_item import ExecutorState
from firmware_sim.autopilot.sensor_monitor import NewestSensors


class Whereabouts:
    """Vehicle position from estimator, sensors and home."""

    def __init__(
        self,
        estimator: Estimator,
        sensors: NewestSensors,
        home: Home,
        value: Callable[[str], float],
    ) -> None:
        """Store the sources and the look-up for PX4 parameters."""
        self._estimator, self._sensors, self._home = estimator, sensors, home
        self._value = value

    def situation(self, *, landed: bool) -> ExecutorState | None:
        """Return the flight state for missions; None before the first fix."""
        sample, home, origin = self._sensors.sample, self._home.place, self._estimator.origin
        if sample is None or home is None or origin is None:
            return None
        state = self._estimator.state
        place, velocity = here(state), triple(state, V)
        return ExecutorState(
            sample.time_us, place.position, place.yaw, landed, home, origin, velocity
        )

    def fenced_place(self) -> Geodetic:
        """Return the position selected by GF_SOURCE: the estimate, or GPS.

        Raises RuntimeError before the first fix.
        """
        origin, gps = self._estimator.origin, self._sensors.gps
        if gps is not None and (self._value("GF_SOURCE") > 0.0 or origin is None):
            return gps.position
        if origin is None:
            raise RuntimeError("no fix yet: the vehicle is nowhere on the globe")
        return local_to_geodetic(self._estimator.state[P:V], origin)
