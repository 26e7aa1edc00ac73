"""Python's search for unreachable cycles of objects, made rarer for a while."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

YOUNG_OBJECTS = 50_000
"""So many new containers lead to a search, in place of Python's 700."""


@contextmanager
def seldom_collected() -> Iterator[None]:
    """Search for unreachable cycles seldom, for work that makes very many objects which live on.

    matplotlib builds figures from hundreds of thousands of objects: with Python's own thresholds, a
    fifth of the time that a report takes goes into searching through them; with these, next to
    nothing, for a few MB more of memory. The thresholds of before stand again afterwards.
    """
    before = gc.get_threshold()
    gc.set_threshold(max(YOUNG_OBJECTS, before[0]) if before[0] else 0, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
