"""Schedule of faults: pure functions of simulated time and of past flight phases."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.faults.model import Fault

FOREVER_US = 1 << 62
"""End of a fault without an end [µs]."""


def window_us(fault: Fault, entered_us: Mapping[str, int]) -> tuple[int, int] | None:
    """Return start and end, excluded, of a fault [µs since the start of the episode].

    `entered_us` is the first start of each flight phase. Returns None before the fault's phase.
    """
    origin_us = 0 if fault.phase is None else entered_us.get(fault.phase)
    if origin_us is None:
        return None
    begin_us = origin_us + round(fault.at_s * US_PER_S)
    if fault.part == "firmware":
        return begin_us, begin_us + TICK_US  # Suspends simulated time too.
    if fault.for_s is None:
        return begin_us, FOREVER_US
    return begin_us, begin_us + max(1, round(fault.for_s * US_PER_S))


def active(
    faults: Sequence[Fault], time_us: int, entered_us: Mapping[str, int]
) -> dict[int, tuple[int, int]]:
    """Return start and end of the faults active at a time, by index; see `window_us`."""
    windows = ((i, window_us(fault, entered_us)) for i, fault in enumerate(faults))
    return {i: at for i, at in windows if at is not None and at[0] <= time_us < at[1]}


def next_change_us(faults: Sequence[Fault], time_us: int, entered_us: Mapping[str, int]) -> int:
    """Return the next start or end of a fault after a time, `FOREVER_US` for never [µs].

    Phases that have not begun are ignored.
    """
    edges = (
        edge
        for fault in faults
        if (at := window_us(fault, entered_us)) is not None
        for edge in at
        if edge > time_us
    )
    return min(edges, default=FOREVER_US)


def gust_share(elapsed_s: float, duration_s: float) -> float:
    """Return the strength of a discrete gust, 0 to 1, at a time after its start [s].

    (1 - cos(2 pi t / T)) / 2: up to its peak and down again (MIL-F-8785C, 3.7.1.3, discrete gusts).
    """
    if not 0.0 <= elapsed_s <= duration_s:
        return 0.0
    return 0.5 * (1.0 - math.cos(2.0 * math.pi * elapsed_s / duration_s))
