"""The wind over the batch twin: that of every episode, drawn ahead."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import TICK_US
from airl_mav.core.frames import Vector
from airl_mav.core.streams import sensors_and_gusts
from airl_mav.envs.draws import DrawnAhead
from airl_mav.envs.faults import gusts, lasting, twin_faults
from airl_mav.envs.fleet import Fleet, Verdict
from airl_mav.faults.model import Fault
from airl_mav.profiles.conditions import WindSettings
from airl_mav.vehicle.wind import BLOCK, Wind, wind_of_episode


class Winds(DrawnAhead):
    """The wind of n episodes; from the seed of each the same history of gusts as the plant's."""

    def __init__(self, n: int, settings: WindSettings, faults: Sequence[Fault] = ()) -> None:
        """Prepare n slots; what is added by `faults` of the wind blows in all of them."""
        super().__init__(n)
        self._faults = twin_faults(faults, "wind")
        still = not (set(settings.model_dump(exclude={"gust_time_s"}).values()) - {0.0})
        self.calm = still and not self._faults
        """Whether no wind blows in any episode."""
        self._settings = settings
        self._gusty = settings.gust_m_s > 0.0 or bool(self._faults)
        self._winds: list[Wind | None] = [None] * n
        self._air = np.zeros((n, BLOCK if self._gusty else 1, 3))
        """As `flight.advance` takes it: the present block."""

    def begin(self, i: int, seed: int) -> Vector:
        """Start the episode of slot i; return its steady wind (3,) NED [m/s]."""
        if self.calm:
            return np.zeros(3)
        rng = sensors_and_gusts(np.random.default_rng(seed))[1]
        wind = Wind(wind_of_episode(self._settings, seed), rng)
        self._winds[i], self._seeds[i], self._blocks[i] = wind, seed, 0
        self._draw_block(i)
        return wind.steady + lasting(self._faults) if self._faults else wind.steady

    def fly(
        self,
        fleet: Fleet,
        ticks: NDArray[np.int64],
        advance: Callable[[NDArray[np.int64], NDArray[np.float64] | None], None],
    ) -> None:
        """Fly all vehicles, in stretches that end with their blocks of wind.

        Args:
            fleet: Read after each stretch.
            ticks: (n,) how many ticks each one flies.
            advance: Flies every vehicle that still does for its number of ticks (n,) in the air
                that `flight.advance` takes.
        """
        if not self._gusty:
            advance(ticks, None if self.calm else self._air)
            return
        left = np.where(fleet.verdict == Verdict.FLYING, ticks, 0)
        while left.any():
            tick = fleet.time_us // TICK_US
            for i in np.flatnonzero((left > 0) & (tick >= self._blocks * BLOCK)).tolist():
                self._draw_block(i)
            stretch = np.minimum(left, BLOCK - tick % BLOCK)
            advance(stretch, self._air)
            left = np.where(fleet.verdict == Verdict.FLYING, left - stretch, 0)

    def _draw_block(self, i: int) -> None:
        wind = self._winds[i]
        if wind is not None:
            self._air[i] = wind.ahead()
            if self._faults:
                self._air[i] += gusts(self._faults, int(self._blocks[i]) * BLOCK, BLOCK)
            self._blocks[i] += 1
