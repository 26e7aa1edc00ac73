"""Body rates as the flight controller takes them, of n vehicles, and what follows when none come.

It follows another kind of setpoint only when it publishes its control mode, twice a second
(`control.demand.KIND_US`). A companion whose decision is overdue has it end the turn, then stand
(`companion.watchdog`): zero rates are flown at once, the velocity of zero from then on.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.control.demand import KIND_US
from airl_mav.core.constants import TICK_US
from airl_mav.envs.fleet import Fleet
from airl_mav.envs.saved_state import Stateful

RATES_FOLLOWED_US = KIND_US - 100_000
"""Body rates are followed so long after a flight has begun at the earliest: until then the flight
controller flies the velocity with which the companion has switched to offboard, a tenth of a second
before (`companion.mavsdk_link.OFFBOARD_SETTLE_S`) [µs]."""


class Flying(Protocol):
    """Vehicles that fly on."""

    @property
    def fleet(self) -> Fleet:
        """Their state."""
        ...

    def advance(self, ticks: NDArray[np.int64]) -> None:
        """Fly each one for so many ticks (n,)."""
        ...


class RateSetpoints(Stateful):
    """The newest setpoints of n vehicles, and which kind of them is followed."""

    def __init__(self, n: int, timeout_us: int) -> None:
        """Prepare n vehicles; a decision is overdue `timeout_us` after the last one was sent."""
        self.timeout = round(timeout_us / TICK_US)
        """That in ticks."""
        self._newest = np.zeros((n, 4))
        """Body rates and thrusts."""
        self._wanted = np.zeros(n, np.bool_)
        """Whether they are the newest of all setpoints, and not a velocity of zero."""
        self._sent_us = np.zeros(n, np.int64)
        """When the companion has sent the last one; 0: it begins to wait for the first."""

    def begin(self, i: int) -> None:
        """Begin the flight of vehicle i, standing."""
        self._newest[i], self._wanted[i], self._sent_us[i] = 0.0, False, 0

    def overdue(self, now_us: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return in how many ticks (n,) companions stop that send nothing; below 0: they have."""
        return (self._sent_us - now_us) // TICK_US + self.timeout

    def sent(self, at_us: NDArray[np.int64]) -> None:
        """Note when the companions (n,) have sent a setpoint [µs]."""
        self._sent_us[:] = at_us

    def take(self, fleet: Fleet, setpoints: NDArray[np.float64], who: NDArray[np.bool_]) -> None:
        """Give the vehicles in `who` (n,) body rates and thrusts (n, 4)."""
        self._newest[who], self._wanted[who] = setpoints[who], True
        self._fly(fleet, who & fleet.by_rates)

    def stop(self, fleet: Fleet, who: NDArray[np.bool_]) -> None:
        """Have the vehicles in `who` (n,) stand, and not turn until they do."""
        self._newest[who, :3], self._wanted[who] = 0.0, False
        self._fly(fleet, who & fleet.by_rates)

    def advance(self, vehicles: Flying, ticks: NDArray[np.int64]) -> None:
        """Fly each vehicle for so many ticks (n,), of the newest kind as soon as it is followed."""
        fleet = vehicles.fleet
        while (other := self._wanted != fleet.by_rates).any():
            # At that tick already; a setpoint that arrives at its beginning is there by then.
            first = (RATES_FOLLOWED_US - fleet.time_us) // TICK_US
            period = KIND_US // TICK_US
            until = np.where(first >= 0, first, first % period)
            switched = other & (until < ticks)
            if not switched.any():
                break
            flown = np.where(switched, until, ticks)
            vehicles.advance(flown)
            ticks = ticks - flown
            fleet.by_rates[switched] = self._wanted[switched]
            self._fly(fleet, switched)
        vehicles.advance(ticks)

    def _fly(self, fleet: Fleet, who: NDArray[np.bool_]) -> None:
        """Have the vehicles in `who` (n,) fly the newest setpoint of the kind that they follow."""
        fleet.setpoint[who] = np.where(fleet.by_rates[who, None], self._newest[who], 0.0)
        fleet.repeat_us[who] = fleet.time_us[who]

    def _held(self) -> Mapping[str, Any]:
        return {"newest": self._newest, "wanted": self._wanted, "sent_us": self._sent_us}
