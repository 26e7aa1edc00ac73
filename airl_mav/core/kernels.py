"""How hot functions are compiled: one decorator, one set of options, one cache."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import njit

from airl_mav.core.cache import writable_folder

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGES = ("airl_mav", "firmware_sim")
"""Those of the distribution that hold kernels."""


_CACHE_NAME = "numba-"
"""How the name of a folder of compiled code begins; the digest of the sources follows."""

_IMPORT = re.compile(rf"^from ((?:{'|'.join(_PACKAGES)})[\w.]*) import", re.MULTILINE)


def _sources_digest(root: Path) -> str:
    """Return a digest of every source that can end up in compiled code.

    Those are the files in which a kernel is defined, and all that these import, directly or not:
    constants are compiled into the kernels that use them.
    """
    texts = {
        ".".join(path.relative_to(root).with_suffix("").parts): path.read_text(encoding="utf-8")
        for package in _PACKAGES
        for path in (root / package).rglob("*.py")
    }
    pending = [name for name, text in texts.items() if "@kernel" in text]
    found: set[str] = set()
    while pending:
        name = pending.pop()
        if name in texts and name not in found:
            found.add(name)
            pending += _IMPORT.findall(texts[name])
    digest = hashlib.sha256()
    for name in sorted(found):
        digest.update(texts[name].encode())
    return digest.hexdigest()[:16]


def _choose_cache() -> None:
    """Give compiled code a folder of its own for each state of the sources.

    numba stamps a cached function with its own file only: a kernel that inlines another one from a
    changed file would go on running the old code, also after an upgrade of the package.
    """
    if numba.config.CACHE_DIR:
        return  # NUMBA_CACHE_DIR: the user has chosen
    package = Path(__file__).resolve().parents[1]
    folder = writable_folder(f"{_CACHE_NAME}{_sources_digest(package.parent)}")
    if folder is not None:
        numba.config.CACHE_DIR = str(folder)


_choose_cache()


def cache_folder() -> Path | None:
    """Return the folder of this state of the sources, for what their kernels were measured to do.

    None where there is none of our own: the user has chosen another, or none can be written.
    """
    chosen = Path(numba.config.CACHE_DIR or "")
    return chosen if chosen.name.startswith(_CACHE_NAME) else None


def kernel(function: F) -> F:
    """Compile a function with numba.

    Compiled code is cached on disk, so that only the first start after an install pays for it, and
    releases the GIL. Always inlined: numba would pass the forty gains by value at each call, which
    costs a third of the batch twin's speed. Never `parallel`: one thread a process, processes for
    parallelism.
    """
    return cast(F, njit(cache=True, nogil=True, forceinline=True)(function))
