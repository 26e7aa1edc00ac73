"""The stages of every decision, in the order of the decisions; and which of them stand out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.latency.stages import STAGES, Samples, stage_durations
from airl_mav.latency.stamps import NO_STAMP

FENCE_RANGES = 3.0
"""Interquartile ranges above the third quartile: Tukey's outer fence, beyond which a value is "far
out" (Exploratory Data Analysis, 1977, section 2D)."""

FENCE_SAMPLES = 16
"""With fewer samples a quartile has at most four on its far side: no fence is drawn."""

FENCE_SHARE = 0.05
"""When more lie beyond the fence they are no outliers but a second kind of decision."""


def decision_series(stamps: Mapping[str, NDArray[Any]]) -> dict[str, Samples]:
    """Return the duration [µs] of each decision's stages (n,), `NO_STAMP` where it is unknown."""
    names = {name for stage in STAGES for name in (stage.start, stage.end)}
    n = max((len(stamps[name]) for name in names & stamps.keys()), default=0)
    series: dict[str, Samples] = {}
    for key, (there, durations) in stage_durations(stamps).items():
        series[key] = np.full(n, NO_STAMP, np.int64)
        series[key][there] = durations
    return series


@dataclass(frozen=True)
class Fence:
    """Where outliers begin."""

    limit_us: float
    """A duration above it is an outlier [µs]."""
    beyond: int
    """How many lie above it."""
    n: int
    second_kind: bool
    """More lie above it than outliers would: nothing is marked."""

    def marks(self, durations: Samples) -> NDArray[np.bool_]:
        """Return (k,) which of the durations (k,) [µs] are outliers."""
        if self.second_kind:
            return np.zeros(len(durations), np.bool_)
        above: NDArray[np.bool_] = durations > self.limit_us
        return above


def fence(samples: Samples) -> Fence | None:
    """Return Tukey's outer fence of durations (n,) [µs]; None with too few for quartiles."""
    n = len(samples)
    if n < FENCE_SAMPLES:
        return None
    low, high = np.percentile(samples, [25.0, 75.0])
    limit = float(high + FENCE_RANGES * (high - low))
    beyond = int(np.count_nonzero(samples > limit))
    return Fence(limit, beyond, n, second_kind=beyond > FENCE_SHARE * n)
