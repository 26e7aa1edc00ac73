"""How hot functions are compiled: one decorator, one set of options."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a function with numba.

    Compiled code is cached on disk, so that only the first start after an install pays for it, and
    releases the GIL. Never `parallel`: one thread a process, processes for parallelism.
    """
    return cast(F, njit(cache=True, nogil=True)(function))
