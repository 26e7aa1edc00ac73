"""Generators of a seed and a key: numpy's own, begun in a third of the time.

An episode draws from six of them, and numpy takes longer to make one than it takes to draw an
arena's obstacles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.random.bit_generator import ISeedSequence
from numpy.typing import NDArray

from airl_mav.core.kernels import kernel

_POOL = 4
"""Words of 32 bits that numpy mixes seed and key into."""

_STATE = 4
"""Words of 64 bits that seed a PCG64."""

_ONE_WORD = 1 << 32

# Of `seed_seq_fe`: where the hashes of pool and state begin, how they go on, and what two words are
# mixed by.
_POOL_SALT, _POOL_FACTOR = np.uint32(0x43B0D7E5), np.uint32(0x931E8875)
_STATE_SALT, _STATE_FACTOR = np.uint32(0x8B51F9DD), np.uint32(0x58F38DED)
_MIX_LEFT, _MIX_RIGHT = np.uint32(0xCA01F9DD), np.uint32(0x4973F715)


class _Words(ISeedSequence):
    """A seed sequence whose words are known; it is asked for them once, and spawns none."""

    def __init__(self, words: NDArray[np.uint64]) -> None:
        self._words = words

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> NDArray[Any]:
        """Return the words. Raises ValueError when others are asked for than a PCG64's."""
        if n_words != _STATE or np.dtype(dtype) != np.uint64:
            raise ValueError(f"{n_words} words of {np.dtype(dtype)}: accepted: {_STATE} of uint64")
        return self._words


def seeded(seed: int, *key: int) -> np.random.Generator:
    """Return `default_rng(SeedSequence(seed, spawn_key=key))`, but one that spawns none."""
    numbers = (seed, *key)
    if not 0 <= min(numbers) <= max(numbers) < _ONE_WORD:
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
    # numpy takes every ISeedSequence; its types name SeedSequence alone.
    words: Any = _Words(_mixed(np.array(numbers, np.uint32)))
    return np.random.default_rng(words)


@kernel
def _mixed(numbers: NDArray[np.uint32]) -> NDArray[np.uint64]:
    """Return the state that numpy's SeedSequence makes of a seed and its key, a word each.

    M. E. O'Neill's `randutils::seed_seq_fe`, as numpy/random/bit_generator.pyx has it: the seed is
    filled up with zeros to the size of the pool where there is a key.
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
    """Return two words mixed into one."""
    mixed = np.uint32(_MIX_LEFT * word - _MIX_RIGHT * other)
    return np.uint32(mixed ^ mixed >> np.uint32(16))
