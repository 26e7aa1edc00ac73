"""Gusts on demand, on top of the wind that blows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.faults.schedule import gust_share
from firmware_sim.faults.timeline import Acting
from firmware_sim.plant.plant import Blowing


def gust_at(acting: Sequence[Acting], time_us: int) -> Vector:
    """Return the wind (3,) NED [m/s] that faults add at a time [µs]."""
    total = np.zeros(3)
    for each in acting:
        share = 1.0
        if each.fault.kind == "gust":
            elapsed_us, whole_us = time_us - each.since_us, each.until_us - each.since_us
            share = gust_share(elapsed_us / US_PER_S, whole_us / US_PER_S)
        total += share * np.array(each.fault.value)
    return total


class Gusts:
    """A wind, and what faults add to it."""

    def __init__(self, wind: Blowing) -> None:
        """Take the wind that blows anyway."""
        self.more: Vector | None = None
        """(3,) NED [m/s], set for the tick that comes; None: nothing."""
        self._wind = wind

    def step(self) -> Vector:
        """Advance one tick and return the wind (3,) NED [m/s]."""
        wind = self._wind.step()
        return wind if self.more is None else wind + self.more
