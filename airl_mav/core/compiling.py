"""Compilation of kernels: reports of its begin and end, folders for compiled code."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

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


def writable_folder(name: str) -> Path | None:
    """Return a folder with a given name for generated files, created if necessary.

    The folder is beside the package's byte code, or in the user's cache if the package is
    read-only. Returns None if both are read-only.
    """
    package = Path(__file__).resolve().parents[1]
    for parent in (package / "__pycache__", Path.home() / ".cache" / "airl-mav"):
        folder = parent / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return None
