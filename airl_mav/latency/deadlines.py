"""Which decisions miss a deadline: they take effect too late, or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.latency.stamps import NO_STAMP


def deadline_miss_ratio(latencies: ArrayLike, deadline: float) -> float | None:
    """Return the share of decisions that miss a deadline, 0 to 1; None: no decisions."""
    if not deadline > 0.0:
        raise ValueError(f"deadline={deadline}: must be > 0")
    values = np.asarray(latencies, np.float64)
    return float(np.mean(values > deadline)) if values.size else None


def ages_at_effect(stamps: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Return the age [µs] of each decision's frame when the decision took effect.

    That is the stage `end_to_end`: exposure of the frame to the first motor command that reflects
    the decision. A decision that never took effect, although a later one of the flight did, is
    infinitely old. Those after the last one that took effect are left out.
    """
    if "capture_us" not in stamps or "motor_us" not in stamps:
        return np.zeros(0)
    captured, moved = stamps["capture_us"], stamps["motor_us"]
    effective = np.flatnonzero(moved != NO_STAMP)
    if not effective.size:
        return np.zeros(0)
    judged = slice(0, int(effective[-1]) + 1)
    ages = np.where(moved == NO_STAMP, np.inf, (moved - captured).astype(np.float64))[judged]
    known: NDArray[np.float64] = ages[captured[judged] != NO_STAMP]
    return known
