"""Random generators from a seed and a key: equal to numpy's, created in a third of the time.

An episode uses six generators. numpy needs more time for one than for an arena's obstacles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.random.bit_generator import ISeedSequence
from numpy.typing import NDArray

from airl_mav.core.kernels import kernel

_POOL = 4
"""Number of 32-bit words into which numpy mixes seed and key."""

_STATE = 4
"""Number of 64-bit words in the seed of a PCG64."""

_ONE_WORD = 1 << 32

# Constants of `seed_seq_fe`: initial value and multiplier of the hashes of pool and state, and
# multipliers that mix two words.
_POOL_SALT, _POOL_FACTOR = np.uint32(0x43B0D7E5), np.uint32(0x931E8875)
_STATE_SALT, _STATE_FACTOR = np.uint32(0x8B51F9DD), np.uint32(0x58F38DED)
_MIX_LEFT, _MIX_RIGHT = np.uint32(0xCA01F9DD), np.uint32(0x4973F715)


class _Words(ISeedSequence):
    """Seed sequence with precomputed words, for one use without spawning."""

    def __init__(self, words: NDArray[np.uint64]) -> None:
        self._words = words

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> NDArray[Any]:
        """Return the words. Raises ValueError for a request that is not a PCG64's."""
        if n_words != _STATE or np.dtype(dtype) != np.uint64:
            raise ValueError(f"{n_words} words of {np.dtype(dtype)}: accepted: {_STATE} of uint64")
        return self._words


def seeded(seed: int, *key: int) -> np.random.Generator:
    """Return `default_rng(SeedSequence(seed, spawn_key=key))`, without support for spawning."""
    numbers = (seed, *key)
    if not 0 <= min(numbers) <= max(numbers) < _ONE_WORD:
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
    # numpy accepts any ISeedSequence; its type hints only SeedSequence.
    words: Any = _Words(_mixed(np.array(numbers, np.uint32)))
    return np.random.default_rng(words)


@kernel
def _mixed(numbers: NDArray[np.uint32]) -> NDArray[np.uint64]:
    """Return the state of numpy's SeedSequence for a seed and its key, one word each.

    M. E. O'Neill's `randutils::seed_seq_fe`, as in numpy/random/bit_generator.pyx: with a key, the
    seed is padded with zeros to the size of the pool.
    """
    seed, key = numbers[0], numbers[1:]
    pool = np.zeros(_POOL, np.uint32)
    pool[0] = seed
    salt = _POOL_SALT
    for i in range(_POOL):
        pool[i], salt = _hashed(pool[i], salt, _POOL_FACTOR)
    for source in range(_POOL):
        for i in range(_POOL):
            if i != source:
                word, salt = _hashed(pool[source], salt, _POOL_FACTOR)
                pool[i] = _joined(pool[i], word)
    for number in key:
        for i in range(_POOL):
            word, salt = _hashed(number, salt, _POOL_FACTOR)
            pool[i] = _joined(pool[i], word)
    state = np.empty(_STATE, np.uint64)
    salt = _STATE_SALT
    for i in range(_STATE):
        low, salt = _hashed(pool[2 * i % _POOL], salt, _STATE_FACTOR)
        high, salt = _hashed(pool[(2 * i + 1) % _POOL], salt, _STATE_FACTOR)
        state[i] = np.uint64(low) | np.uint64(high) << np.uint64(32)
    return state


@kernel
def _hashed(word: np.uint32, salt: np.uint32, factor: np.uint32) -> tuple[np.uint32, np.uint32]:
    """Return the hash of a word, and the next salt."""
    word = np.uint32(word ^ salt)
    salt = np.uint32(salt * factor)
    word = np.uint32(word * salt)
    return np.uint32(word ^ word >> np.uint32(16)), salt


@kernel
def _joined(word: np.uint32, other: np.uint32) -> np.uint32:
    """Return the mix of two words."""
    mixed = np.uint32(_MIX_LEFT * word - _MIX_RIGHT * other)
    return np.uint32(mixed ^ mixed >> np.uint32(16))
