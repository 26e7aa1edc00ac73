"""Random draws of an episode, generated from the episode's seed only.

An episode is therefore independent of the number of parallel flights. Draws for decisions are made
ahead, a block of decisions at a time.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import TICK_US
from airl_mav.core.frames import Vector
from airl_mav.core.streams import Stream, sensors_and_gusts, stream
from airl_mav.envs.faults import gusts, lasting, twin_faults
from airl_mav.envs.fleet import Fleet, FlightStatus
from airl_mav.envs.saved_state import State, Stateful
from airl_mav.faults.fault import Fault
from airl_mav.latency.injection import Injection, LatencySampler, latency_generator
from airl_mav.profiles.conditions import WindSettings
from airl_mav.vehicle.atmosphere import BLOCK as WIND_BLOCK
from airl_mav.vehicle.atmosphere import Wind, wind_of_episode

BLOCK = 32
"""Number of decisions drawn at a time."""

NOT_BEGUN = -1
"""Seed of a slot without an episode."""


class DrawnAhead(Stateful):
    """Draws of n episodes, made ahead a block at a time."""

    def __init__(self, n: int) -> None:
        """Prepare n slots."""
        self._seeds = np.full(n, NOT_BEGUN, np.int64)
        self._blocks = np.zeros(n, np.int64)
        """Number of blocks drawn in the slot's episode."""

    @abstractmethod
    def begin(self, i: int, seed: int) -> Any:
        """Start the episode of slot i."""

    @abstractmethod
    def _draw_block(self, i: int) -> None:
        """Draw the next block of slot i, and count it."""

    def _held(self) -> Mapping[str, Any]:
        return {"seeds": self._seeds, "blocks": self._blocks}

    def set_state(self, state: State) -> None:
        """Restore a saved state by repeating its draws. Raises UsageError for a mismatch."""
        super().set_state(state)
        for i in np.flatnonzero(self._seeds != NOT_BEGUN).tolist():
            blocks = int(self._blocks[i])
            self.begin(i, int(self._seeds[i]))
            while self._blocks[i] < blocks:
                self._draw_block(i)


def source_of(injections: Sequence[Injection], seed: int) -> Injection:
    """Return the source of t2 for an episode's seed, drawn from one or more."""
    if len(injections) == 1:
        return injections[0]
    return injections[int(stream(seed, Stream.SOURCE).integers(len(injections)))]


class DelayDraws(DrawnAhead):
    """t2 of every decision of n episodes [µs]."""

    def __init__(
        self, n: int, injections: Sequence[Injection], native_us: int, *, draw: int = 0
    ) -> None:
        """Prepare n slots.

        Args:
            n: Number of slots.
            injections: One or more; each episode draws one of them.
            native_us: t2 without injection [µs].
            draw: See `injection.latency_generator`.
        """
        super().__init__(n)
        self._injections = tuple(injections)
        self._native_us = native_us
        self._draw = draw
        self._samplers: list[LatencySampler | None] = [None] * n
        self.block = np.full((n, BLOCK), native_us, np.int64)
        """(n, BLOCK) t2 of the present decisions [µs]; decision k is in column k % BLOCK."""

    def begin(self, i: int, seed: int) -> None:
        """Start the episode of slot i. The companion draws the same latencies from this seed."""
        injection = source_of(self._injections, seed)
        self._seeds[i], self._blocks[i] = seed, 0
        # Creating a generator takes time, even without draws.
        self._samplers[i] = (
            None
            if injection.latency is None
            else injection.sampler(latency_generator(seed, self._draw))
        )
        self.block[i] = self._native_us

    def draw(self, decision: NDArray[np.int64]) -> None:
        """Draw the next block of slots whose `decision` (n,), counted from 0, starts a block."""
        # All draws of a block come from the episode's generator, in order.
        for i in np.flatnonzero(decision % BLOCK == 0):
            self._draw_block(int(i))

    def _draw_block(self, i: int) -> None:
        sampler = self._samplers[i]
        if sampler is not None:
            self.block[i] = [sampler.sample_us() for _ in range(BLOCK)]
            self._blocks[i] += 1


class Winds(DrawnAhead):
    """Wind of n episodes; the same gust history per seed as in the plant."""

    def __init__(self, n: int, settings: WindSettings, faults: Sequence[Fault] = ()) -> None:
        """Prepare n slots; `faults` of the wind act in all of them."""
        super().__init__(n)
        self._faults = twin_faults(faults, "wind")
        # Every field except the gust's time constant is 0.
        still = not (set(settings.model_dump(exclude={"gust_time_s"}).values()) - {0.0})
        self.calm = still and not self._faults
        """True if no wind blows in any episode."""
        self._settings = settings
        self.gusty = settings.gust_m_s > 0.0 or bool(self._faults)
        self._winds: list[Wind | None] = [None] * n
        # No gusts: one row holds the steady wind for the whole flight.
        self.air = np.zeros((n, WIND_BLOCK if self.gusty else 0 if self.calm else 1, 3))
        """(n, k, 3) present blocks, as an argument of `fleet_step.advance`."""

    def begin(self, i: int, seed: int) -> Vector:
        """Start the episode of slot i; return its steady wind (3,) NED [m/s]."""
        if self.calm:
            return np.zeros(3)
        rng = sensors_and_gusts(np.random.default_rng(seed))[1]
        wind = Wind(wind_of_episode(self._settings, seed), rng)
        self._winds[i], self._seeds[i], self._blocks[i] = wind, seed, 0
        self._draw_block(i)
        # Faults since before the flight have already tilted the vehicle at its start.
        return wind.steady + lasting(self._faults) if self._faults else wind.steady

    def ends_us(self) -> NDArray[np.int64] | None:
        """Return the end times of the present blocks (n,); None for steady wind."""
        return self._blocks * WIND_BLOCK * TICK_US if self.gusty else None

    def blow(self, fleet: Fleet) -> None:
        """Draw the next block of flights at the end of their block."""
        ends_us = self.ends_us()
        if ends_us is not None:
            due = (fleet.verdict == FlightStatus.FLYING) & (fleet.time_us >= ends_us)
            for i in np.flatnonzero(due).tolist():
                self._draw_block(i)

    def _draw_block(self, i: int) -> None:
        wind = self._winds[i]
        if wind is not None:
            self.air[i] = wind.ahead()
            # The block number counts from the start of the episode, as the faults' times do.
            if self._faults:
                self.air[i] += gusts(self._faults, int(self._blocks[i]) * WIND_BLOCK, WIND_BLOCK)
            self._blocks[i] += 1
