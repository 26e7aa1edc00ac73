"""Independent random streams of an episode's seed, the same at every level."""

from __future__ import annotations

from enum import IntEnum
from zlib import crc32

import numpy as np


class Stream(IntEnum):
    """First word of a stream's key.

    `arena.generate` has 0 to 3; the plant's sensors and gusts are 0 and 1 (`sensors_and_gusts`).
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
    """Return the generator of one stream of an episode; `more` numbers tell its parts apart."""
    # Compiled, and imported late: programs that only tell what they can do need no numba.
    from airl_mav.core.seeding import seeded

    return seeded(seed, name, *more)


def words_of(name: str) -> tuple[int, ...]:
    """Return what tells the streams of a further camera apart, by its name; "": the main one's.

    By its name, not its place in a list: what one camera draws does not change with the others.
    """
    return (crc32(name.encode()),) if name else ()


def sensors_and_gusts(
    rng: np.random.Generator,
) -> tuple[np.random.Generator, np.random.Generator]:
    """Return the generators of sensor noise and of gusts, from a new one of the episode's seed."""
    sensors, gusts = rng.spawn(2)
    return sensors, gusts
