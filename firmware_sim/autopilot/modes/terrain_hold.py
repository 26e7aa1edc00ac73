"""Holding the height above ground while a vehicle stands: MPC_ALT_MODE 2.

Source: PX4 1.16, FlightTaskManualAltitude::_updateAltitudeLock and _terrainFollowing, as
FlightTaskManualAltitudeSmoothVel flies them. Its smoothed sticks put their own altitude in the
place of every other one but while the ground is held: MPC_ALT_MODE 1 flies there as 0 does, and so
it does here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

NAN = math.nan
HOLD = 2
"""MPC_ALT_MODE."""

_DEFLECTED = 1e-3


class Piloting(NamedTuple):
    """What decides whether the ground is held."""

    level: float
    """How far pitch and roll sticks are deflected, shaped."""
    climbing: bool
    """Whether the throttle stick is deflected."""
    speed_m_s: float
    """Horizontal."""
    climb_m_s: float
    """Vertical, NED."""
    down_m: float
    """Where the vehicle is, NED."""
    ground_m: float
    """How far the ground is below; NaN = not known."""
    resets: int
    """How often the ground has been put elsewhere."""


class TerrainHold:
    """Keeps the height above ground that the vehicle has when it comes to stand."""

    def __init__(self, value: Callable[[str], float]) -> None:
        self._value = value
        self.restart()

    def restart(self) -> None:
        """Begin."""
        self.holds = False
        """Whether the ground is held, and not the altitude."""
        self.locked_m = NAN
        """Height above ground that is kept; NaN = none."""
        self._resets: int | None = None

    def place(self, now: Piloting, held: float) -> float:
        """Return where to be, NED [m], NaN = nowhere; `held` is where the sticks would be."""
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
                # The same error of height as before.
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
