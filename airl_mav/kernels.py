"""How hot functions are compiled: one decorator, one set of options, one cache."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import njit

F = TypeVar("F", bound=Callable[..., Any])

_KERNEL_SOURCES = (
    "airl_mav/constants.py",
    "airl_mav/frames.py",
    "airl_mav/kernels.py",
    "airl_mav/arena",
    "airl_mav/camera",
    "airl_mav/control",
    "airl_mav/envs",
    "airl_mav/vehicle",
    "firmware_sim/autopilot",
    "firmware_sim/mavlink/streams",
    "firmware_sim/plant",
)
"""Where kernels, and the constants that are compiled into them, come from."""


def _sources_digest(root: Path) -> str:
    """Return a digest of all sources that end up in compiled code."""
    digest = hashlib.sha256()
    for name in _KERNEL_SOURCES:
        path = root / name
        for source in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(source.read_bytes() if source.is_file() else b"")
    return digest.hexdigest()[:16]


def _choose_cache() -> None:
    """Give compiled code a folder of its own for each state of the sources.

    numba stamps a cached function with its own file only: a kernel that inlines another one from a
    changed file would go on running the old code, also after an upgrade of the package.
    """
    if numba.config.CACHE_DIR:
        return  # NUMBA_CACHE_DIR: the user has chosen
    package = Path(__file__).resolve().parent
    name = f"numba-{_sources_digest(package.parent)}"
    for parent in (package / "__pycache__", Path.home() / ".cache" / "airl-mav"):
        folder = parent / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            numba.config.CACHE_DIR = str(folder)
            return


_choose_cache()


def kernel(function: F) -> F:
    """Compile a function with numba.

    Compiled code is cached on disk, so that only the first start after an install pays for it, and
    releases the GIL. Always inlined: numba would pass the forty gains by value at each call, which
    costs a third of the batch twin's speed. Never `parallel`: one thread a process, processes for
    parallelism.
    """
    return cast(F, njit(cache=True, nogil=True, forceinline=True)(function))
