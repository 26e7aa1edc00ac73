"""How two clocks relate, from exchanges in which one asks and the other answers with its time.

An answer was stamped somewhere between question and reception. So an exchange gives the offset up
to half its round trip, however unequal the two ways are (F. Cristian, "Probabilistic clock
synchronization", Distributed Computing 3, 1989). The one with the least round trip is the best
(the clock filter of NTP, RFC 5905, section 10). A line through the best exchange before and the
best one after gives the drift. The exchanges in between check it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.core.constants import US_PER_MS

RESOLUTION_US = 1.0
"""Both clocks give whole microseconds, rounded down [µs]."""

GREATEST_DRIFT = 1e-3
"""Greatest relative rate of two clocks of real time, seconds a second: Linux corrects a clock by up
to 500 ppm (adjtimex), and both may be corrected."""

LEAST_EXCHANGES = 8
"""Fewest answers before, in between and after: the stages of NTP's clock filter."""

LEAST_AGREEING = 0.99
"""Share of the exchanges in between that the line must agree with. A single answer may carry a
stamp that was read just before its process was suspended."""


class ClockError(Exception):
    """The clocks cannot be related, and why."""


@dataclass(frozen=True)
class Exchanges:
    """Questions and their answers; each (n,) int64 [µs]."""

    sent_us: NDArray[np.int64]
    """Asked, by the own clock."""
    remote_us: NDArray[np.int64]
    """Answered, by the other clock."""
    received_us: NDArray[np.int64]
    """Answer received, by the own clock."""

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.sent_us)

    @property
    def round_trip_us(self) -> NDArray[np.int64]:
        """(n,) from question to answer [µs]."""
        return self.received_us - self.sent_us

    @property
    def middle_us(self) -> NDArray[np.float64]:
        """(n,) middle between question and answer, by the own clock [µs]."""
        return self.sent_us + self.round_trip_us / 2.0

    @property
    def offset_us(self) -> NDArray[np.float64]:
        """(n,) what the other clock is ahead, both ways taken as equally long [µs]."""
        return self.remote_us - self.middle_us

    @property
    def uncertainty_us(self) -> NDArray[np.float64]:
        """(n,) how far `offset_us` may be off at `middle_us` [µs]."""
        return self.round_trip_us / 2.0 * (1.0 + GREATEST_DRIFT) + RESOLUTION_US


@dataclass(frozen=True)
class Reading:
    """What one clock is ahead of the other, at a time."""

    at_us: float
    """By the own clock [µs]."""
    offset_us: float
    """The other clock less the own one [µs]."""
    uncertainty_us: float
    """Greatest error of the offset [µs]."""


def best_reading(exchanges: Exchanges) -> Reading:
    """Return the reading of the least round trip; ClockError without a majority for it."""
    n = len(exchanges)
    if n < LEAST_EXCHANGES:
        raise ClockError(f"{n} answers in a row, {LEAST_EXCHANGES} are needed")
    at, offset, within = exchanges.middle_us, exchanges.offset_us, exchanges.uncertainty_us
    for i in np.argsort(exchanges.round_trip_us, kind="stable"):
        apart = np.abs(offset - offset[i])
        agree = apart <= within + within[i] + GREATEST_DRIFT * np.abs(at - at[i])
        if 2 * np.count_nonzero(agree) > n:
            return Reading(float(at[i]), float(offset[i]), float(within[i]))
    raise ClockError("the answers contradict each other, as if a clock did not keep real time")


@dataclass(frozen=True)
class ClockRelation:
    """The offset of the other clock as a line over the own one."""

    before: Reading
    after: Reading
    checked: int
    """Exchanges in between."""
    agreeing: int
    """Those of them that do not contradict the line."""

    @property
    def drift(self) -> float:
        """What the other clock gains, seconds a second of the own one."""
        span_us = self.after.at_us - self.before.at_us
        return (self.after.offset_us - self.before.offset_us) / span_us

    @property
    def drift_uncertainty(self) -> float:
        """Greatest error of the drift."""
        span_us = self.after.at_us - self.before.at_us
        return (self.after.uncertainty_us + self.before.uncertainty_us) / span_us

    def offset_at(self, own_us: ArrayLike) -> NDArray[np.float64]:
        """Return what the other clock is ahead [µs] at times of the own one [µs]."""
        after_before = np.asarray(own_us, np.float64) - self.before.at_us
        return np.asarray(self.before.offset_us + self.drift * after_before)

    def uncertainty_at(self, own_us: ArrayLike) -> NDArray[np.float64]:
        """Return the greatest error of `offset_at` [µs], if both clocks run evenly."""
        span_us = self.after.at_us - self.before.at_us
        share = (np.asarray(own_us, np.float64) - self.before.at_us) / span_us
        a, b = self.before.uncertainty_us, self.after.uncertainty_us
        return np.asarray(np.abs(1.0 - share) * a + np.abs(share) * b)

    def own_time(self, remote_us: ArrayLike) -> NDArray[np.float64]:
        """Return times of the other clock [µs] by the own one [µs]."""
        # remote = own + before.offset + drift (own - before.at), solved for own.
        remote_before = self.before.at_us + self.before.offset_us
        told = np.asarray(remote_us, np.float64) - remote_before
        return np.asarray(self.before.at_us + told / (1.0 + self.drift))


def relate(before: Exchanges, between: Exchanges, after: Exchanges) -> ClockRelation:
    """Return the line through the best exchange before and after, checked with those between."""
    first, last = best_reading(before), best_reading(after)
    if len(between) < LEAST_EXCHANGES:
        raise ClockError(f"{len(between)} answers in between, {LEAST_EXCHANGES} are needed")
    if last.at_us <= first.at_us:
        raise ClockError("no time between the exchanges before and after")
    relation = ClockRelation(first, last, 0, 0)
    if abs(relation.drift) > GREATEST_DRIFT + relation.drift_uncertainty:
        raise ClockError(
            f"the other clock gained {relation.drift * 1e6:+,.0f} ppm, more than any clock of real "
            f"time ({GREATEST_DRIFT * 1e6:,.0f} ppm)"
        )
    at = between.middle_us
    off = np.abs(between.offset_us - relation.offset_at(at))
    agree = off <= between.uncertainty_us + relation.uncertainty_at(at)
    agreeing = int(np.count_nonzero(agree))
    if agreeing < LEAST_AGREEING * len(between):
        worst_ms = float(off.max()) / US_PER_MS
        raise ClockError(
            f"the clocks did not run evenly: {len(between) - agreeing} of {len(between)} exchanges "
            f"contradict the line by up to {worst_ms:.3f} ms"
        )
    return ClockRelation(first, last, len(between), agreeing)
