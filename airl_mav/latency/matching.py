"""Find when the flight controller accepted each setpoint that the companion sent.

MAVSDK sends a setpoint at once and then again at 20 Hz until the next one. So the flight
controller's log holds many copies of each. The first copy after a decision is that decision's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.latency.stamps import NO_STAMP

UNMATCHED = -1

SAME_WITHIN = 1e-5
"""Setpoints closer than this in every element [m/s, rad, rad/s] are the same: MAVSDK turns degrees
into radians in float32, which costs the last bits of a yaw."""


def match_setpoints(
    sent_us: ArrayLike,
    sent_values: ArrayLike,
    accepted_us: ArrayLike,
    accepted_values: ArrayLike,
) -> NDArray[np.int64]:
    """Match each sent setpoint (n, 4) with the first accepted copy of it.

    A copy counts when it was accepted at or after the sending, before the next one was sent, and
    carries the same four numbers (NaN, an unused field, equals NaN). When a decision repeats the
    one before, a resend of that one still under way counts as well. It commands the same. Return
    the index (n,) into the accepted ones, `UNMATCHED` where there is none.
    """
    sent = np.asarray(sent_us, np.int64)
    accepted = np.asarray(accepted_us, np.int64)
    sent_rows = np.asarray(sent_values, np.float32).reshape(-1, 4)
    accepted_rows = np.asarray(accepted_values, np.float32).reshape(-1, 4)
    if len(sent) != len(sent_rows) or len(accepted) != len(accepted_rows):
        raise ValueError(
            f"{len(sent)} sending times for {len(sent_rows)} setpoints, "
            f"{len(accepted)} acceptance times for {len(accepted_rows)}"
        )
    if np.any(np.diff(sent) < 0) or np.any(np.diff(accepted) < 0):
        raise ValueError("times go back: sent_us and accepted_us must be in order")
    index = np.full(len(sent), UNMATCHED, np.int64)
    first = np.searchsorted(accepted, sent, side="left")
    end = np.append(np.searchsorted(accepted, sent[1:], side="left"), len(accepted))
    for i, (start, stop) in enumerate(zip(first, end, strict=False)):
        window = accepted_rows[start:stop]
        same = np.isclose(window, sent_rows[i], rtol=0.0, atol=SAME_WITHIN, equal_nan=True)
        hits = np.flatnonzero(same.all(axis=1))
        if hits.size:
            index[i] = start + hits[0]
    return index


def stamps_of(index: ArrayLike, times_us: ArrayLike) -> NDArray[np.int64]:
    """Look up the time (n,) [µs] of each match in `times_us` (m,); `NO_STAMP` where unmatched."""
    where = np.asarray(index, np.int64)
    stamps = np.full(len(where), NO_STAMP, np.int64)
    matched = where != UNMATCHED
    stamps[matched] = np.asarray(times_us, np.int64)[where[matched]]
    return stamps
