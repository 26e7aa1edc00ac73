"""That kernels are compiled: after an install the first start takes a minute for it.

Who waits is told by who compiles, in this process or another. Nothing of numba is loaded here;
`kernels` reports what numba begins and ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

COMPILING = "compiling kernels (first start, up to a minute)"
"""What is shown meanwhile; `benchmarks/bench_compiling.py` measures the time."""

Heard = Callable[[bool], None]
"""Is told True when kernels begin to be compiled, False when that is over; often in turn."""

_listeners: list[Heard] = []
_depth = 0
"""Of kernels that are compiled: one that calls others compiles them first."""


@contextmanager
def heard_compiling(tell: Heard) -> Iterator[None]:
    """Be told when this process compiles kernels; code from the cache on disk is not compiled."""
    _listeners.append(tell)
    try:
        yield
    finally:
        _listeners.remove(tell)


def report_compiling(*, begins: bool) -> None:
    """Report that a kernel is about to be compiled, or was. Called under numba's lock."""
    global _depth
    _depth += 1 if begins else -1
    if _depth == (1 if begins else 0):
        for tell in tuple(_listeners):
            tell(begins)
