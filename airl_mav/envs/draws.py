"""What chance decides in an episode: every draw comes from the episode's own seed.

So an episode is the same whatever flies beside it, and however many do. Draws that a decision
needs are made ahead, a block of decisions at a time.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from airl_mav.envs.estimation import N_ERRORS
from airl_mav.envs.state import State, pack_generators, restore, take, unpack_generators
from airl_mav.latency.injection import Injection
from airl_mav.latency.samplers import LatencySampler

BLOCK = 32
"""Decisions whose draws are made at a time."""


class Stream(IntEnum):
    """Independent random streams of an episode's seed; `arena.generate` has 0 to 3."""

    AIRFRAME = 10
    CAMERA = 11
    ESTIMATION = 12
    DELAY = 13
    DEPTH = 14


def stream(seed: int, name: Stream) -> np.random.Generator:
    """Return the generator of one stream of an episode."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(name,)))


class DelayDraws:
    """t2 of every decision of n episodes [µs]."""

    def __init__(self, n: int, injection: Injection, native_us: int) -> None:
        """Take where the latency comes from; `native_us` when nothing is injected."""
        self._injection = injection
        self._rngs: list[np.random.Generator | None] = [None] * n
        self._samplers: list[LatencySampler | None] = [None] * n
        self._block = np.full((n, BLOCK), native_us, np.int64)

    def begin(self, i: int, seed: int) -> None:
        """Start the episode of slot i. The companion draws the same latencies from this seed."""
        rng = np.random.default_rng(seed)
        self._rngs[i], self._samplers[i] = rng, self._injection.sampler(rng)

    def take(self, decision: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return t2 (n,) [µs] of each slot's `decision`, counted from 0, one after the other."""
        if self._injection.latency is not None:
            for i in np.flatnonzero(decision % BLOCK == 0):
                sampler = self._samplers[i]
                if sampler is not None:
                    self._block[i] = [sampler.sample_us() for _ in range(BLOCK)]
        picked: NDArray[np.int64] = np.take_along_axis(
            self._block, (decision % BLOCK)[:, None], axis=1
        )[:, 0]
        return picked

    def get_state(self) -> State:
        """Return what is drawn already, and where the generators stand."""
        return {"block": self._block.copy(), "generators": pack_generators(self._rngs)}

    def set_state(self, state: State) -> None:
        """Go on from a saved state. Raises UsageError when it does not fit."""
        restore(self._block, state, "block")
        self._rngs = unpack_generators(take(state, "generators"))
        # A sampler remembers nothing but its generator.
        self._samplers = [
            None if rng is None else self._injection.sampler(rng) for rng in self._rngs
        ]


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
