"""Relation of two clocks, from exchanges of a request and a time-stamped answer.

An answer is stamped between request and reception. An exchange therefore gives the offset up to
half its round trip, for any asymmetry (F. Cristian, "Probabilistic clock synchronization",
Distributed Computing 3, 1989). The exchange with the minimum round trip is the best (the clock
filter of NTP, RFC 5905, section 10). A line through the best exchange before and the best one after
gives the drift. The exchanges in between check it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.core.constants import US_PER_MS

RESOLUTION_US = 1.0
"""Resolution of both clocks: whole microseconds, rounded down [µs]."""

GREATEST_DRIFT = 1e-3
"""Maximum relative rate of two real-time clocks, seconds per second: Linux corrects a clock by up
to 500 ppm (adjtimex), and both may be corrected."""

LEAST_EXCHANGES = 8
"""Minimum number of answers before, in between and after: the stages of NTP's clock filter."""

LEAST_AGREEING = 0.99
"""Minimum share of the exchanges in between that agree with the line. A single answer may contain a
stamp that was read just before its process was suspended."""


class ClockError(Exception):
    """The clocks cannot be related; the message is the reason."""


@dataclass(frozen=True)
class Exchanges:
    """Requests and answers; each (n,) int64 [µs]."""

    sent_us: NDArray[np.int64]
    """Request times, by the local clock."""
    remote_us: NDArray[np.int64]
    """Answer times, by the remote clock."""
    received_us: NDArray[np.int64]
    """Reception times, by the local clock."""

    def __len__(self) -> int:
        """Return the number of exchanges."""
        return len(self.sent_us)

    @property
    def round_trip_us(self) -> NDArray[np.int64]:
        """(n,) time from request to answer [µs]."""
        return self.received_us - self.sent_us

    @property
    def middle_us(self) -> NDArray[np.float64]:
        """(n,) midpoint between request and answer, by the local clock [µs]."""
        return self.sent_us + self.round_trip_us / 2.0

    @property
    def offset_us(self) -> NDArray[np.float64]:
        """(n,) lead of the remote clock for symmetric paths [µs]."""
        return self.remote_us - self.middle_us

    @property
    def uncertainty_us(self) -> NDArray[np.float64]:
        """(n,) maximum error of `offset_us` at `middle_us` [µs]."""
        return self.round_trip_us / 2.0 * (1.0 + GREATEST_DRIFT) + RESOLUTION_US


@dataclass(frozen=True)
class Reading:
    """Offset between two clocks at a time."""

    at_us: float
    """Time by the local clock [µs]."""
    offset_us: float
    """Remote clock minus local clock [µs]."""
    uncertainty_us: float
    """Maximum error of the offset [µs]."""


def best_reading(exchanges: Exchanges) -> Reading:
    """Return the reading of the minimum round trip; ClockError unless a majority agrees."""
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
    """Offset of the remote clock as a line over the local clock."""

    before: Reading
    after: Reading
    checked: int
    """Number of exchanges in between."""
    agreeing: int
    """Number of them that agree with the line."""

    @property
    def drift(self) -> float:
        """Gain of the remote clock, seconds per local second."""
        span_us = self.after.at_us - self.before.at_us
        return (self.after.offset_us - self.before.offset_us) / span_us

    @property
    def drift_uncertainty(self) -> float:
        """Maximum error of the drift."""
        span_us = self.after.at_us - self.before.at_us
        return (self.after.uncertainty_us + self.before.uncertainty_us) / span_us

    def offset_at(self, own_us: ArrayLike) -> NDArray[np.float64]:
        """Return the lead of the remote clock [µs] at local times [µs]."""
        after_before = np.asarray(own_us, np.float64) - self.before.at_us
        return np.asarray(self.before.offset_us + self.drift * after_before)

    def uncertainty_at(self, own_us: ArrayLike) -> NDArray[np.float64]:
        """Return the maximum error of `offset_at` [µs], if both clocks run evenly."""
        span_us = self.after.at_us - self.before.at_us
        share = (np.asarray(own_us, np.float64) - self.before.at_us) / span_us
        a, b = self.before.uncertainty_us, self.after.uncertainty_us
        return np.asarray(np.abs(1.0 - share) * a + np.abs(share) * b)

    def own_time(self, remote_us: ArrayLike) -> NDArray[np.float64]:
        """Convert times of the remote clock [µs] to the local clock [µs]."""
        # remote = own + before.offset + drift (own - before.at), solved for own.
        remote_before = self.before.at_us + self.before.offset_us
        told = np.asarray(remote_us, np.float64) - remote_before
        return np.asarray(self.before.at_us + told / (1.0 + self.drift))


def relate(before: Exchanges, between: Exchanges, after: Exchanges) -> ClockRelation:
    """Return the line through the best exchange before and after, checked with the rest."""
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
