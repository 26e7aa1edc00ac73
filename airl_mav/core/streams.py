"""Independent random streams of an episode's seed, the same at every level."""

from __future__ import annotations

from enum import IntEnum
from zlib import crc32

import numpy as np


class Stream(IntEnum):
    """First word of a stream's key.

    `arena.generate` uses 0 to 3; the plant's sensors and gusts are 0 and 1 (`sensors_and_gusts`).
    """

    AIRFRAME = 10
    CAMERA = 11
    ESTIMATION = 12
    DELAY = 13
    DEPTH = 14
    SOURCE = 15
    WIND = 16
    FAULTS = 17
    STEREO = 18
    APPEARANCE = 19
    PHOTONS = 20
    EXPOSURE = 21
    RANGING = 22


def stream(seed: int, name: Stream, *more: int) -> np.random.Generator:
    """Return the generator of one stream of an episode; `more` numbers identify its parts."""
    return seeded(seed, name, *more)


def seeded(seed: int, *key: int) -> np.random.Generator:
    """Return the generator of a seed and a key."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def words_of(name: str) -> tuple[int, ...]:
    """Return the key words of an additional camera's streams, by its name; empty for "".

    Keys depend on names, not on positions in a list, so adding a camera does not change others.
    """
    return (crc32(name.encode()),) if name else ()


def sensors_and_gusts(
    rng: np.random.Generator,
) -> tuple[np.random.Generator, np.random.Generator]:
    """Return the generators of sensor noise and of gusts, spawned from an episode's generator."""
    sensors, gusts = rng.spawn(2)
    return sensors, gusts
