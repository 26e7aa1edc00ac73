"""Terrain hold: constant height above ground while hovering (MPC_ALT_MODE 2).

Source: PX4 1.16, FlightTaskManualAltitude::_updateAltitudeLock and _terrainFollowing, in
FlightTaskManualAltitudeSmoothVel. Its smoothed sticks override every other altitude except in
terrain hold, so MPC_ALT_MODE 1 behaves like 0, also here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

NAN = math.nan
HOLD = 2
"""Value of MPC_ALT_MODE."""

_DEFLECTED = 1e-3


class Piloting(NamedTuple):
    """Input of the terrain hold."""

    level: float
    """Shaped deflection of the pitch and roll sticks."""
    climbing: bool
    """True if the throttle stick is deflected."""
    speed_m_s: float
    """Horizontal speed."""
    climb_m_s: float
    """Vertical speed, NED."""
    down_m: float
    """Height of the vehicle, NED."""
    ground_m: float
    """Height above ground; NaN = unknown."""
    resets: int
    """Number of terrain height resets."""


class TerrainHold:
    """Hold of the height above ground at the end of a motion."""

    def __init__(self, value: Callable[[str], float]) -> None:
        self._value = value
        self.restart()

    def restart(self) -> None:
        """Reset the hold."""
        self.holds = False
        """True if the height above ground is held instead of the altitude."""
        self.locked_m = NAN
        """Held height above ground; NaN = none."""
        self._resets: int | None = None

    def place(self, now: Piloting, held: float) -> float:
        """Return the target height, NED [m], NaN = none; `held` is the sticks' held height."""
        if int(self._value("MPC_ALT_MODE")) != HOLD:
            self.restart()
            return held
        if now.resets != self._resets:
            self._resets, self.locked_m = now.resets, NAN
        known, limit = math.isfinite(now.ground_m), self._value("MPC_HOLD_MAX_XY")
        deflected = now.level > _DEFLECTED
        if self.holds:
            if deflected or now.speed_m_s > limit or not known:
                self.holds = False
        elif not deflected and now.speed_m_s < 0.5 * limit and known:
            self.holds = True
            if math.isfinite(held):
                # Keep the height error.
                self.locked_m = now.ground_m - (held - now.down_m)
        if not self.holds:
            if not now.climbing and math.isnan(held):
                self.locked_m = NAN
            return held
        return self._follow(now)

    def _follow(self, now: Piloting) -> float:
        slow = self._value("MPC_HOLD_MAX_Z")
        stopped = slow <= 0.0 or abs(now.climb_m_s) < slow
        if now.climbing:
            self.locked_m = NAN
        elif math.isnan(self.locked_m) and stopped:
            self.locked_m = now.ground_m
        return now.down_m - (self.locked_m - now.ground_m)
