"""Notifications about kernel compilation, which takes a minute at the first start.

Listeners are called by the compiling process, or on behalf of another one. numba is not imported
here; `kernels` reports when numba starts and ends compiling.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

COMPILING = "compiling kernels (first start, up to a minute)"
"""Status text during compilation; `benchmarks/bench_compiling.py` measures the time."""

Heard = Callable[[bool], None]
"""Listener, called with True at the start of compilation and False at the end, repeatedly."""

_listeners: list[Heard] = []
_depth = 0
"""Number of nested compilations: a kernel compiles the kernels that it calls first."""


@contextmanager
def heard_compiling(tell: Heard) -> Iterator[None]:
    """Notify a listener of compilation in this process, except for loads from the disk cache."""
    _listeners.append(tell)
    try:
        yield
    finally:
        _listeners.remove(tell)


def report_compiling(*, begins: bool) -> None:
    """Report the start or the end of a kernel's compilation. Called under numba's lock."""
    global _depth
    _depth += 1 if begins else -1
    if _depth == (1 if begins else 0):
        for tell in tuple(_listeners):
            tell(begins)
