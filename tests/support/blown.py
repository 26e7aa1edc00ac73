"""Flights in the wind of the vectorized simulator, without decisions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from airl_mav.core.constants import TICK_US
from airl_mav.envs.draws import Winds
from airl_mav.envs.fleet import Fleet


def fly_blown(
    winds: Winds, fleet: Fleet, ticks: int, advance: Callable[[np.ndarray], None]
) -> None:
    """Fly vehicles of the same age for `ticks` ticks, in stretches of constant wind."""
    left = ticks
    while left > 0:
        winds.blow(fleet)
        ends_us = winds.ends_us()
        block = left if ends_us is None else int(ends_us[0] - fleet.time_us[0]) // TICK_US
        flown = min(left, block)
        advance(np.full(len(fleet.time_us), flown))
        left -= flown
