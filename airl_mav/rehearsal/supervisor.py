"""How an episode is followed to its end, by one set of rules for levels with a companion."""

from __future__ import annotations

import math
from enum import Enum

from airl_mav.core.constants import US_PER_S
from airl_mav.flight.judge import Outcome, Referee, TruthSample, Verdict

TAKEOFF_LIMIT_S = 90.0
"""Longest time from the reset to the start of navigation [simulated s]."""

ARRIVAL_S = 10.0
"""Longest time from the goal's edge to where the companion thinks the goal is [simulated s].
Then it is told to land where it is."""


class Order(Enum):
    """What the companion is told."""

    LAND = "land"
    """Stop and land."""
    ABANDON = "abandon"
    """There is nothing left to land."""


class Supervisor:
    """Watches one episode. Pure: no clock, no I/O."""

    def __init__(self, referee: Referee, started_us: int) -> None:
        """Take the referee, and when the episode began [µs]."""
        self.referee = referee
        self.started_us = started_us
        """When the episode began [µs]."""
        self._called_off = False

    @property
    def verdict(self) -> Verdict | None:
        """The verdict, once there is one."""
        return self.referee.verdict

    @property
    def due_us(self) -> float:
        """When an order is due by the passing of time [µs]; inf = none is."""
        referee = self.referee
        if self._called_off:
            return math.inf
        if referee.verdict is not None:
            return referee.verdict.time_us + ARRIVAL_S * US_PER_S + 1.0
        if referee.navigation_us is None:
            return self.started_us + TAKEOFF_LIMIT_S * US_PER_S + 1.0
        return referee.navigation_us + referee.task.time_limit_s * US_PER_S

    def see(self, sample: TruthSample) -> Order | None:
        """Take the next true sample; return what the companion must be told, if anything."""
        referee = self.referee
        if referee.verdict is not None:
            late_us = sample.time_us - referee.verdict.time_us
            if late_us > ARRIVAL_S * US_PER_S:
                return self._call_off(land=sample.collision is None)
            return None
        verdict = referee.observe(sample)
        elapsed_s = (sample.time_us - self.started_us) / US_PER_S
        if verdict is None and referee.navigation_us is None and elapsed_s > TAKEOFF_LIMIT_S:
            verdict = referee.abort(sample.time_us, "navigation never began")
        if verdict is None or verdict.outcome is Outcome.SUCCESS:
            return None
        crashed = verdict.outcome in (Outcome.COLLISION, Outcome.BATTERY)
        return self._call_off(land=not crashed)

    def _call_off(self, *, land: bool) -> Order | None:
        if self._called_off:
            return None
        self._called_off = True
        return Order.LAND if land else Order.ABANDON
