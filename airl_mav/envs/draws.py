"""What chance decides in an episode: every draw comes from the episode's own seed.

So an episode is the same whatever flies beside it, and however many do. Draws that a decision
needs are made ahead, a block of decisions at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from airl_mav.envs.estimation import N_ERRORS
from airl_mav.envs.state import State, pack_generators, restore, take, unpack_generators
from airl_mav.latency.injection import Injection
from airl_mav.latency.samplers import LatencySampler, latency_generator

BLOCK = 32
"""Decisions whose draws are made at a time."""

NOT_BEGUN = -1
"""Seed of a slot in which no episode has begun."""


class Stream(IntEnum):
    """Independent random streams of an episode's seed; `arena.generate` has 0 to 3."""

    AIRFRAME = 10
    CAMERA = 11
    ESTIMATION = 12
    DELAY = 13
    DEPTH = 14
    SOURCE = 15


def stream(seed: int, name: Stream) -> np.random.Generator:
    """Return the generator of one stream of an episode."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(name,)))


class DelayDraws:
    """t2 of every decision of n episodes [µs]."""

    def __init__(
        self, n: int, injections: Sequence[Injection], native_us: int, *, draw: int = 0
    ) -> None:
        """Take where the latency comes from.

        Args:
            n: Number of slots.
            injections: One or more; of several, each episode draws one.
            native_us: t2 when nothing is injected [µs].
            draw: See `samplers.latency_generator`.
        """
        self._injections = tuple(injections)
        self._native_us = native_us
        self._draw = draw
        self._seeds = np.full(n, NOT_BEGUN, np.int64)
        self._blocks = np.zeros(n, np.int64)
        """Blocks drawn in the slot's episode."""
        self._samplers: list[LatencySampler | None] = [None] * n
        self._block = np.full((n, BLOCK), native_us, np.int64)

    def begin(self, i: int, seed: int) -> None:
        """Start the episode of slot i. The companion draws the same latencies from this seed."""
        injection = self._injections[0]
        if len(self._injections) > 1:
            chosen = stream(seed, Stream.SOURCE).integers(len(self._injections))
            injection = self._injections[int(chosen)]
        self._seeds[i], self._blocks[i] = seed, 0
        self._samplers[i] = injection.sampler(latency_generator(seed, self._draw))
        self._block[i] = self._native_us

    def take(self, decision: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return t2 (n,) [µs] of each slot's `decision`, counted from 0, one after the other."""
        for i in np.flatnonzero(decision % BLOCK == 0):
            self._draw_block(int(i))
        picked: NDArray[np.int64] = np.take_along_axis(
            self._block, (decision % BLOCK)[:, None], axis=1
        )[:, 0]
        return picked

    def _draw_block(self, i: int) -> None:
        sampler = self._samplers[i]
        if sampler is not None:
            self._block[i] = [sampler.sample_us() for _ in range(BLOCK)]
            self._blocks[i] += 1

    def get_state(self) -> State:
        """Return what the draws are made again from."""
        return {"seeds": self._seeds.copy(), "blocks": self._blocks.copy()}

    def set_state(self, state: State) -> None:
        """Draw again what a saved state had drawn. Raises UsageError when it does not fit."""
        seeds, blocks = self._seeds.copy(), self._blocks.copy()
        restore(seeds, state, "seeds")
        restore(blocks, state, "blocks")
        for i in np.flatnonzero(seeds != NOT_BEGUN):
            self.begin(int(i), int(seeds[i]))
            for _ in range(int(blocks[i])):
                self._draw_block(int(i))


class NormalDraws:
    """Standard normal numbers of n episodes: as many as there are estimation errors a decision."""

    def __init__(self, n: int) -> None:
        self._rngs: list[np.random.Generator | None] = [None] * n
        self._block = np.zeros((n, BLOCK, N_ERRORS))

    def begin(self, i: int, seed: int) -> NDArray[np.float64]:
        """Start the episode of slot i; return the numbers (N_ERRORS,) of its start."""
        rng = stream(seed, Stream.ESTIMATION)
        self._rngs[i], self._block[i] = rng, rng.standard_normal((BLOCK, N_ERRORS))
        first: NDArray[np.float64] = self._block[i, 0]
        return first

    def take(self, decisions: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return numbers (n, N_ERRORS) after each slot's 1st, 2nd, ... decision, one by one."""
        for i in np.flatnonzero(decisions % BLOCK == 0):
            rng = self._rngs[i]
            if rng is not None:
                self._block[i] = rng.standard_normal((BLOCK, N_ERRORS))
        return self._block[np.arange(len(decisions)), decisions % BLOCK]

    def get_state(self) -> State:
        """Return what is drawn already, and where the generators stand."""
        return {"block": self._block.copy(), "generators": pack_generators(self._rngs)}

    def set_state(self, state: State) -> None:
        """Go on from a saved state. Raises UsageError when it does not fit."""
        restore(self._block, state, "block")
        self._rngs = unpack_generators(take(state, "generators"))
