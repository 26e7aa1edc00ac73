"""Rules that end an episode, for all levels with a companion."""

from __future__ import annotations

import math
from enum import Enum

from airl_mav.core.constants import US_PER_S
from airl_mav.flight.judge import Outcome, Referee, TruthSample, Verdict

TAKEOFF_LIMIT_S = 90.0
"""Maximum time from the reset to the start of navigation [simulated s]."""

ARRIVAL_S = 10.0
"""Maximum time from reaching the goal radius to the companion's own goal position [simulated s].
After it, the supervisor orders a landing on the spot."""


class Order(Enum):
    """Order to the companion."""

    LAND = "land"
    """Stop and land."""
    ABANDON = "abandon"
    """End the mission; landing is impossible."""


class EpisodeSupervisor:
    """Supervisor of one episode. Pure: no clock, no I/O."""

    def __init__(self, referee: Referee, started_us: int) -> None:
        """Take the referee and the start of the episode [µs]."""
        self.referee = referee
        self.started_us = started_us
        """Start of the episode [µs]."""
        self._called_off = False

    @property
    def verdict(self) -> Verdict | None:
        """Return the verdict, or None before it."""
        return self.referee.verdict

    @property
    def due_us(self) -> float:
        """Return the time of the next timeout order [µs]; inf = no timeout."""
        referee = self.referee
        if self._called_off:
            return math.inf
        if referee.verdict is not None:
            return referee.verdict.time_us + ARRIVAL_S * US_PER_S + 1.0
        if referee.navigation_us is None:
            return self.started_us + TAKEOFF_LIMIT_S * US_PER_S + 1.0
        return referee.navigation_us + referee.task.time_limit_s * US_PER_S

    def see(self, sample: TruthSample) -> Order | None:
        """Process the next true sample; return an order for the companion, or None."""
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
