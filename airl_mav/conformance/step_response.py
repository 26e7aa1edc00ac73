"""What a step response says: arrays in, numbers out.

A value counts as reached in the first sample that shows it: no interpolation between samples, as
the stored columns were measured. So each time is late by up to one sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SETTLED = 0.05
"""A response has settled once it stays so close to the new value, as a share of the step."""

END_S = 1.0
"""The error at the end is a mean over so long [s]."""


class StepResponse(NamedTuple):
    """One step; times from the moment of sending. NaN: not reached."""

    latency_s: float
    """Until the value has moved by a given amount [s]."""
    t10_s: float
    """Until a tenth of the step is done [s]."""
    t50_s: float
    """Until half of it is done [s]."""
    rise_s: float
    """From the first tenth to nine tenths [s]."""
    overshoot_percent: float
    """How far it goes beyond the new value, of the step [%]; negative: it stays short of it."""
    error: float
    """New value minus the mean at the end, positive when it stays short of it [unit]."""
    settle_s: float
    """From when on it stays within 5 % of the step around the new value [s]."""


def step_response(
    times_s: NDArray[np.float64],
    values: NDArray[np.float64],
    before: float,
    after: float,
    change: float,
) -> StepResponse:
    """Return what a step looks like.

    Args:
        times_s: (n,) when the values were true, from the moment of sending; < 0 is before it [s].
        values: (n,) what was to step [unit].
        before: Old setpoint [unit].
        after: New setpoint, another one [unit].
        change: Movement towards the new value that ends the latency, from the mean of what was
            before the step, > 0 [unit].

    Raises:
        ValueError: There is nothing from before the step, or nothing from after it.
    """
    quiet, answer = times_s < 0.0, times_s >= 0.0
    if not quiet.any() or not answer.any():
        raise ValueError("a step response needs samples from before and after the step")
    times = times_s[answer]
    size = abs(after - before)
    share = (values - before) / (after - before)
    start = float(share[quiet].mean())
    share = share[answer]

    def first(level: float) -> float:
        reached = np.flatnonzero(share >= level)
        return float(times[reached[0]]) if reached.size else float("nan")

    outside = np.flatnonzero(np.abs(share - 1.0) > SETTLED)
    last = int(outside[-1]) + 1 if outside.size else 0
    settle_s = float(times[last]) if last < len(times) else float("nan")
    end = share[times >= times[-1] - END_S]
    return StepResponse(
        latency_s=first(start + change / size),
        t10_s=first(0.1),
        t50_s=first(0.5),
        rise_s=first(0.9) - first(0.1),
        overshoot_percent=100.0 * (float(share.max()) - 1.0),
        error=size * (1.0 - float(end.mean())),
        settle_s=settle_s,
    )


def median_response(responses: Sequence[StepResponse]) -> StepResponse:
    """Return the median of several flights of one step, figure by figure.

    Not their mean: now and then noise of the estimate alone makes a movement, long before the step
    does. NaN where one did not get there.
    """
    return StepResponse(*np.median(np.array(responses), axis=0).tolist())
