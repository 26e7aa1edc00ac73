"""Precision land: fly above a reported landing target (LANDING_TARGET) and land on it.

Source: PX4 1.16, navigator/precland.cpp: its states, their conditions and PLD_*.
"""

from __future__ import annotations

import math
from enum import Enum, auto

from airl_mav.control.demand import AnyDemand
from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.error_state import P
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.inputs import LandingTarget, ModeRequest, PrecisionRequest
from firmware_sim.autopilot.modes.automatic import landing_speed
from firmware_sim.autopilot.modes.interface import FlightContext, FlightMode
from firmware_sim.autopilot.smooth_trajectory import PathSegment, triple

PERIOD_US = 50_000
"""Period of target checks [µs]: PX4's navigator runs at 20 Hz."""

_SETTLE_US = 2 * US_PER_S
"""Waiting time for the target at the start, and above the target before the descent [µs]."""

_SEEN_US = US_PER_S
"""Waiting time between finding a target in the search and its approach [µs]."""

_LOST_NEAR_GROUND_US = US_PER_S // 2
"""Target timeout near the ground [µs]."""

_STOP_CLIMBING_M = 1.0
"""Additional climb of the search after the target was found [m]."""


class _State(Enum):
    START = auto()
    """Wait at a place for the target."""
    APPROACH = auto()
    """Fly to the target at the current height."""
    DESCEND = auto()
    """Descend above the target."""
    FINAL = auto()
    """Descend to the ground without target updates."""
    SEARCH = auto()
    """Climb to PLD_SRCH_ALT, waiting for the target."""
    FALLBACK = auto()
    """Ordinary landing at the current position."""


_DOWNWARDS = (_State.DESCEND, _State.FINAL, _State.FALLBACK)


class PrecisionLand(FlightMode, modes=(Mode.PRECISION_LAND,)):
    """Precision landing mode: finds the target and lands on it; without one, lands in place."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._state = _State.START
        self._goal: Vec = (0.0, 0.0, 0.0)
        """Destination, local NED [m]; the height is ignored during the descent."""
        self._required = True
        self._searches = 0
        self._next_us = 0
        self._entered_us = 0
        """Start time of the current state [µs]."""
        self._reached_us: int | None = None
        self._found_us: int | None = None
        self._report_us = 0
        """Time of the newest processed report [µs]."""
        self._is_new = False

    @property
    def destination(self) -> Vec | None:
        """Destination; during the descent, the ground."""
        north, east, down = self._goal
        return north, east, self._context.home[2] if self._state in _DOWNWARDS else down

    def enter(self, state: Vector, request: ModeRequest | None, /) -> None:
        """Start above the request's place, by default here, and search for the target."""
        if not isinstance(request, PrecisionRequest):
            request = PrecisionRequest(triple(state, P), required=True)
        self._goal, self._required = request.place, request.required
        self._searches, self._next_us = 1, 0
        self._report_us, self._is_new = -1, False
        self._reached_us = self._found_us = None
        self._state = _State.START

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Check for the target periodically; return the demand."""
        if time_us >= self._next_us:
            self._next_us = time_us + PERIOD_US
            self._update(triple(state, P), time_us)
        north, east, _ = self._goal
        travel = self._context.travel
        if self._state in _DOWNWARDS:
            context = self._context
            speed = landing_speed(context.value, context.height(state), context.ground_m)
            return travel.fly(
                state, time_us, PathSegment((north, east, math.nan), vertical_m_s=speed)
            )
        return travel.fly(state, time_us, PathSegment(self._goal))

    # --- states

    def _update(self, position: Vec, now_us: int) -> None:
        target = self._context.landing_target
        self._is_new = target is not None and target.time_us != self._report_us
        if target is not None:
            self._report_us = target.time_us
        step = {
            _State.START: self._start,
            _State.APPROACH: self._approach,
            _State.DESCEND: self._descend,
            _State.SEARCH: self._search,
        }.get(self._state)
        if step is not None:
            step(position, now_us)

    def _start(self, position: Vec, now_us: int) -> None:
        if self._begin_approach(position, now_us):
            return
        if not self._required:
            self._fall_back(position)
            return
        if math.dist(position[:2], self._goal[:2]) >= self._context.value("NAV_ACC_RAD"):
            return
        if self._reached_us is None:
            self._reached_us = now_us
        if self._context.value("PLD_SRCH_TOUT") <= 0.0:
            self._fall_back(position)
        elif now_us - self._reached_us > _SETTLE_US:
            north, east, _ = self._goal
            # Above the origin of local NED, PX4's reference altitude.
            self._goal = north, east, -self._context.value("PLD_SRCH_ALT")
            self._become(_State.SEARCH, now_us)

    def _approach(self, position: Vec, now_us: int) -> None:
        target = self._target
        if target is None or (self._is_over(target, position) and not self._is_visible(now_us)):
            self._lose(position, now_us)
            return
        if self._is_new and self._is_over(target, position):
            if self._reached_us is None:
                self._reached_us = now_us
            if now_us - self._reached_us > _SETTLE_US:
                self._become(_State.DESCEND, now_us)
        self._goal = *target.position[:2], self._goal[2]

    def _descend(self, position: Vec, now_us: int) -> None:
        target = self._target
        if target is None:
            self._lose(position, now_us)
            return
        near = self._is_near_ground(target, position, now_us)
        visible = self._is_visible(now_us)
        if near:
            visible = now_us - target.time_us < _LOST_NEAR_GROUND_US
        if visible:
            self._goal = *target.position[:2], self._goal[2]
        elif near:
            self._become(_State.FINAL, now_us)
        else:
            self._lose(position, now_us)

    def _search(self, position: Vec, now_us: int) -> None:
        if self._is_new and self._is_visible(now_us) and self._found_us is None:
            self._found_us = now_us
            north, east, down = self._goal
            self._goal = north, east, max(down, position[2] - _STOP_CLIMBING_M)
        settled = self._found_us is not None and now_us - self._found_us > _SEEN_US
        if settled and self._begin_approach(position, now_us):
            return
        if now_us - self._entered_us > self._context.value("PLD_SRCH_TOUT") * US_PER_S:
            self._fall_back(position)

    # --- from state to state

    def _become(self, state: _State, now_us: int) -> None:
        self._state, self._entered_us = state, now_us
        self._reached_us = self._found_us = None

    def _begin_approach(self, position: Vec, now_us: int) -> bool:
        """Approach a currently visible target; return whether there is one."""
        if not (self._is_new and self._is_visible(now_us)):
            return False
        north, east, _ = self._goal
        self._goal = north, east, position[2]
        self._become(_State.APPROACH, now_us)
        return True

    def _lose(self, position: Vec, now_us: int) -> None:
        """Search for the target at the current position, up to PLD_MAX_SRCH times."""
        self._goal = position
        if self._searches <= self._context.value("PLD_MAX_SRCH"):
            self._searches += 1
            self._become(_State.START, now_us)
        else:
            self._fall_back(position)

    def _fall_back(self, position: Vec) -> None:
        self._goal, self._state = position, _State.FALLBACK

    # --- the target

    @property
    def _target(self) -> LandingTarget | None:
        return self._context.landing_target

    def _is_visible(self, now_us: int) -> bool:
        """Return whether the target was reported within PLD_BTOUT."""
        target = self._target
        if target is None:
            return False
        return now_us - target.time_us <= self._context.value("PLD_BTOUT") * US_PER_S

    def _is_over(self, target: LandingTarget, position: Vec) -> bool:
        """Return whether the vehicle is above the target, within PLD_HACC_RAD on each axis."""
        radius = self._context.value("PLD_HACC_RAD")
        offsets = (a - b for a, b in zip(target.position[:2], position[:2], strict=True))
        return all(abs(offset) < radius for offset in offsets)

    def _is_near_ground(self, target: LandingTarget, position: Vec, now_us: int) -> bool:
        """Return whether the vehicle is within PLD_FAPPR_ALT above a visible target."""
        above = target.position[2] - position[2]
        return self._is_visible(now_us) and above < self._context.value("PLD_FAPPR_ALT")
