"""Guidance: demand of the active mode for the controllers; `modes` implements the modes."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.control.demand import AnyDemand, AttitudeDemand, Demand, RateDemand
from airl_mav.core.frames import Geodetic, Vector, geodetic_to_local, local_to_geodetic
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.climb import Climb
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.error_state import SIGMA, P, V
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes import implementations
from firmware_sim.autopilot.modes.interface import NAN, FlightContext, FlightMode, ModeRequest, here
from firmware_sim.engine.record import Record

# Bound once: looking up an enum member in every tick is slow.
_GROUND, _AIR = FlightPhase.GROUND, FlightPhase.AIR


class Guidance:
    """Dispatcher of the flight modes; `enter` switches the active mode.

    `state` is always the estimator's newest nominal state (`error_state`).
    """

    def __init__(
        self, value: Callable[[str], float], say: Callable[[OperatorText], None], record: Record
    ) -> None:
        """Start in Hold.

        Args:
            value: Look-up for PX4 parameters by name.
            say: Sends a text to the operator.
            record: Record of the flight controller.
        """
        self.context = FlightContext(value, Climb(record), say=say)
        """Context shared by the modes."""
        self._modes = {mode: new(self.context) for mode, new in implementations().items()}
        self._flown: FlightMode = self._modes[Mode.HOLD]
        self._stopped = False
        """True if the motors are stopped permanently."""
        self._spool_since_us: int | None = None

    def flies(self, mode: Mode) -> bool:
        """Return whether a mode is implemented: some are add-ons."""
        return mode in self._modes

    def enter(self, mode: Mode, state: Vector, request: ModeRequest | None = None) -> None:
        """Start a mode at the current state, with the optional arguments of a user request."""
        self.context.climb.stop()
        self._stopped = mode is Mode.TERMINATION
        if self._stopped:
            return
        # Without a request, the next mode may continue the motion of the last one.
        if request is None:
            request = self._flown.remainder(state)
        new = self._modes[mode]
        # Settings of a mode do not survive a change of mode.
        if new is not self._flown:
            self.context.travel.speed_m_s, self.context.orbit = NAN, None
        self._flown = new
        self._flown.enter(state, request)

    def at_home(self, state: Vector) -> None:
        """Set home to the current position: the ground under the vehicle at arming."""
        self.context.home, self.context.home_yaw = here(state)
        self._spool_since_us = None

    def take_off_to(
        self,
        altitude_m: float | None,
        place: tuple[float, float] | None,
        state: Vector,
        *,
        flying: bool,
    ) -> None:
        """Set the height above home [m] and the place (north, east [m]) of the next take-off.

        Default height: MIS_TAKEOFF_ALT, in flight above the current height as in PX4. Default
        place: straight up.
        """
        context = self.context
        context.takeoff_place = place
        height = context.height(state) if flying else 0.0
        if altitude_m is None:
            default = context.value("MIS_TAKEOFF_ALT")
            text = f"Using default takeoff altitude: {default:.1f} m"
            context.say(OperatorText(Severity.INFO, text, events.TAKEOFF_DEFAULT.event(default)))
            altitude_m = default + height
        # As in PX4: a take-off does not descend.
        if altitude_m < height:
            higher = events.TAKEOFF_ALREADY_HIGHER.event()
            context.say(
                OperatorText(Severity.CRITICAL, "Already higher than takeoff altitude", higher)
            )
            altitude_m = height
        context.takeoff_altitude_m = altitude_m

    def is_done(self, state: Vector) -> bool:
        """Return whether the active mode has reached its goal."""
        return not self._stopped and self._flown.is_done(state)

    @property
    def destination(self) -> Vec | None:
        """Destination of the active mode, local NED [m]; None = no destination."""
        return None if self._stopped else self._flown.destination

    def demand(self, state: Vector, phase: FlightPhase, time_us: int) -> AnyDemand | None:
        """Return the current demand; None = the motors are stopped."""
        self.context.standing = phase is not _AIR
        if self._stopped:
            return None
        if phase is _AIR:
            self._spool_since_us = None
            return self._flown.demand(state, time_us)
        # On the ground, only a mode that lifts off starts the motors.
        if phase is _GROUND and self._flown.lifts:
            return self._ramped(self._flown.demand(state, time_us), time_us)
        self._spool_since_us = None
        return None

    def is_steady(self, phase: FlightPhase) -> bool:
        """Return whether the demand is constant until the next request or decision."""
        if self._stopped or phase < _GROUND:
            return True
        if phase is _AIR or not self._flown.lifts:
            return self._flown.is_steady
        # In the ramp, compiled ticks update the demand.
        return self.context.climb.flies

    def _ramped(self, demand: AnyDemand, time_us: int) -> AnyDemand:
        """Return a demand on the ground with the climb rate limited by the take-off ramp.

        A height is replaced by that rate.
        """
        if isinstance(demand, AttitudeDemand | RateDemand):
            return demand  # direct thrust: there is nothing to limit
        if self._spool_since_us is None:
            self._spool_since_us = time_us
        context = self.context
        straight = self._flown is self._modes[Mode.TAKEOFF] and context.takeoff_place is None
        # After lift-off, the climb continues from the ramp.
        limit = context.climb.ramp(self._spool_since_us, context.value, time_us, flies=straight)
        (north, east, _), (vn, ve, vd) = demand.position, demand.velocity
        # Limit only the climb; NaN or zero beside a height means that the height commands it.
        higher = vd == 0.0 and demand.position[2] < context.home[2]
        down = -limit if math.isnan(vd) or higher else max(vd, -limit)
        return Demand((north, east, NAN), (vn, ve, down), demand.yaw, demand.yaw_rate)


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
