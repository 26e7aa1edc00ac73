"""Text that travels compressed inside a page; `templates/page.js` unpacks it."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray


class Steps(TypedDict):
    """A line of numbers as whole steps from one to the next, which compress well."""

    unit: float
    """What a step of 1 is."""
    steps: list[int]
    """From 0 to the first number, from each to the next."""


LEVEL = 7
"""Of gzip, 1 to 9: 9 takes three times as long for a page's data, and saves a hundredth of it."""


def packed(text: str) -> str:
    """Return a text as base64 of gzip. The same text gives the same bytes."""
    return base64.b64encode(gzip.compress(text.encode(), compresslevel=LEVEL, mtime=0)).decode()


def unpacked(data: str) -> str:
    """Return the text that `packed` was given."""
    return gzip.decompress(base64.b64decode(data)).decode()


def steps_of(values: NDArray[np.float64] | Sequence[float], unit: float) -> Steps:
    """Return numbers (n,), all finite, as steps of a unit: each is kept to half a unit."""
    whole = np.round(np.asarray(values, np.float64) / unit).astype(np.int64)
    return {"unit": unit, "steps": np.diff(whole, prepend=0).tolist()}
