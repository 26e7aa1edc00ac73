"""Random draws of an episode, each from the episode's own seed.

So an episode is the same however many fly beside it. Draws that a decision needs are made ahead, a
block of decisions at a time.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.streams import Stream, stream
from airl_mav.envs.saved_state import State, Stateful
from airl_mav.latency.injection import Injection
from airl_mav.latency.samplers import LatencySampler, latency_generator

BLOCK = 32
"""Number of decisions that are drawn at a time."""

NOT_BEGUN = -1
"""Seed of a slot in which no episode has begun."""


class DrawnAhead(Stateful):
    """Draws of n episodes, made ahead a block at a time."""

    def __init__(self, n: int) -> None:
        """Prepare n slots."""
        self._seeds = np.full(n, NOT_BEGUN, np.int64)
        self._blocks = np.zeros(n, np.int64)
        """Blocks drawn in the slot's episode."""

    @abstractmethod
    def begin(self, i: int, seed: int) -> Any:
        """Start the episode of slot i."""

    @abstractmethod
    def _draw_block(self, i: int) -> None:
        """Draw the next block of slot i, and count it."""

    def _held(self) -> Mapping[str, Any]:
        return {"seeds": self._seeds, "blocks": self._blocks}

    def set_state(self, state: State) -> None:
        """Restore a saved state by repeating its draws. Raises UsageError if it does not fit."""
        super().set_state(state)
        for i in np.flatnonzero(self._seeds != NOT_BEGUN).tolist():
            blocks = int(self._blocks[i])
            self.begin(i, int(self._seeds[i]))
            while self._blocks[i] < blocks:
                self._draw_block(i)


def source_of(injections: Sequence[Injection], seed: int) -> Injection:
    """Return the source of t2, of one or more, that the episode of a seed has drawn."""
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
            injections: One or more; of several, each episode draws one.
            native_us: t2 when nothing is injected [µs].
            draw: See `samplers.latency_generator`.
        """
        super().__init__(n)
        self._injections = tuple(injections)
        self._native_us = native_us
        self._draw = draw
        self._samplers: list[LatencySampler | None] = [None] * n
        self._block = np.full((n, BLOCK), native_us, np.int64)

    def begin(self, i: int, seed: int) -> None:
        """Start the episode of slot i. The companion draws the same latencies from this seed."""
        injection = source_of(self._injections, seed)
        self._seeds[i], self._blocks[i] = seed, 0
        # A generator that nothing is drawn from takes its time all the same.
        self._samplers[i] = (
            None
            if injection.latency is None
            else injection.sampler(latency_generator(seed, self._draw))
        )
        self._block[i] = self._native_us

    def take(self, decision: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return t2 (n,) [µs] of each slot's `decision`, counted from 0, one after the other."""
        for i in np.flatnonzero(decision % BLOCK == 0):
            self._draw_block(int(i))
        picked: NDArray[np.int64] = self._block.take(
            np.arange(len(decision)) * BLOCK + decision % BLOCK
        )
        return picked

    def _draw_block(self, i: int) -> None:
        sampler = self._samplers[i]
        if sampler is not None:
            self._block[i] = [sampler.sample_us() for _ in range(BLOCK)]
            self._blocks[i] += 1
