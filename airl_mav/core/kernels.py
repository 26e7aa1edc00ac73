"""How hot functions are compiled: one decorator, one set of options, one cache."""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import njit
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher

from airl_mav.core.cache import writable_folder
from airl_mav.core.compiling import report_compiling

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGES = ("airl_mav", "firmware_sim")
"""Those of the distribution that hold kernels."""

_ROOT = Path(__file__).resolve().parents[2]
"""Folder of the packages."""

_CACHE_NAME = "numba-"
"""How the name of a folder of compiled code begins; the digest of its sources follows."""

_PACKAGE = rf"(?:{'|'.join(_PACKAGES)})[\w.]*"
_IMPORT = re.compile(
    rf"^[ \t]*(?:from ({_PACKAGE}) import (\([^)]*\)|.*)|import ({_PACKAGE}))", re.MULTILINE
)


@cache
def _file_of(module: str) -> Path | None:
    """Return the file of a module of this distribution; None: there is none, or it is a name."""
    path = _ROOT.joinpath(*module.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file
    return None


@cache
def _read(file: Path) -> tuple[str, tuple[Path, ...]]:
    """Return the digest of a source file, and the files that it imports."""
    text = file.read_text(encoding="utf-8")
    names: list[str] = []
    for package, imported, module in _IMPORT.findall(text):
        names += [module] if module else [package]
        names += [f"{package}.{name}" for name in re.findall(r"\w+", imported)]
    files = {found for name in names if (found := _file_of(name)) is not None}
    return hashlib.sha256(text.encode()).hexdigest(), tuple(sorted(files))


def _closure(files: Iterable[Path]) -> dict[Path, str]:
    """Return the digests of source files and all that they import, directly or not."""
    pending, found = list(files), dict[Path, str]()
    while pending:
        each = pending.pop()
        if each not in found:
            found[each], imported = _read(each)
            pending += imported
    return found


@cache
def _closure_digest(file: Path) -> str:
    """Return a digest of a source file and all that it imports, directly or not."""
    found = _closure([file])
    listed = "".join(sorted(f"{each.name} {digest}\n" for each, digest in found.items()))
    return hashlib.sha256(listed.encode()).hexdigest()[:16]


@cache
def _folder(digest: str) -> Path | None:
    """Return the folder of what was made of sources; None: nothing can be written."""
    return writable_folder(f"{_CACHE_NAME}{digest}")


def cache_folder(source: str) -> Path | None:
    """Return the folder for what is made of a source file and of all that it imports.

    Another state of any of them has another folder. None where none can be written, or where the
    user has chosen one for all compiled code (`NUMBA_CACHE_DIR`), or the source is in no file.
    """
    file = Path(source).resolve()
    if numba.config.CACHE_DIR or not file.is_file():
        return None
    return _folder(_closure_digest(file))


@contextmanager
def _caching_in(folder: Path | None) -> Iterator[None]:
    """Let numba keep what is decorated meanwhile in a folder; None: where it would."""
    chosen = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = chosen if folder is None else str(folder)
    try:
        yield
    finally:
        numba.config.CACHE_DIR = chosen


def kernel(function: F) -> F:
    """Compile a function with numba.

    Compiled code is cached on disk and releases the GIL. Only the first start after an install
    compiles. Kernels are always inlined: numba would pass the forty gains by value at each call,
    which costs a third of the batch twin's speed. They are never `parallel`: one thread a process,
    processes for parallelism.

    A division by zero gives infinity or NaN, as numpy's. Checks for a ZeroDivisionError take a
    tenth of the twin's speed, and prevent vector instructions.

    numba stamps a cached function with its own file only. A kernel that inlines another one, or a
    constant, from a changed file would keep running the old code, also after an upgrade of the
    package. So each is kept in a folder of its file and of all that this imports.
    """
    return _compiled(function, forceinline=True)


def large_kernel(function: F) -> F:
    """Compile a function with numba, not inlined: it is long, and rarely needed."""
    return _compiled(function, forceinline=False)


def borrowing_kernel(function: F) -> F:
    """Compile a function as `kernel` does, without counting who holds its arrays.

    numba counts the holders of every array: one more for each view, `row[left:end]`, one less when
    it is done with, both atomically. Where an image is drawn in short rows, that is half the time.

    For what only borrows arrays: all are the caller's, who holds them until it returns. It can make
    none (numba refuses to compile it), and must return none, not even within a tuple.
    """
    return _compiled(function, forceinline=True, counts=False)


def large_borrowing_kernel(function: F) -> F:
    """Compile a function as `borrowing_kernel`, called and not inlined, as `large_kernel`."""
    return _compiled(function, forceinline=False, counts=False)


kernel_files: set[str] = set()
"""Source files of the kernels loaded so far."""


def sources() -> list[Path]:
    """Return the source files that the kernels loaded so far depend on."""
    return sorted(_closure(Path(each).resolve() for each in kernel_files))


def _compiled(function: F, *, forceinline: bool, counts: bool = True) -> F:
    kernel_files.add(function.__code__.co_filename)
    options = {"nogil": True, "error_model": "numpy", "forceinline": forceinline, "_nrt": counts}
    compiled = njit(**options)(function)
    with _caching_in(cache_folder(function.__code__.co_filename)):
        compiled._cache = _Cache(function)
    compiled.get_call_template = partial(_call_template, compiled)
    return cast(F, compiled)


def _call_template(compiled: Dispatcher, args: Iterable[Any], kws: dict[str, Any]) -> Any:
    """Return how a kernel is called from others: compiled once for all values of a constant."""
    types = map(numba.types.unliteral, args)
    return Dispatcher.get_call_template(compiled, tuple(types), kws)


class _Cache(FunctionCache):  # type: ignore[misc]
    """numba's cache of a function, written by one process at a time.

    Without a lock, two processes that save a function for different types at the same time write
    the same file. The index then names code of the wrong types, and running it ends the process.
    """

    def save_overload(self, sig: object, data: object) -> None:
        """Save compiled code."""
        self._impl.locator.ensure_cache_path()
        descriptor = os.open(self.cache_path, os.O_RDONLY)
        try:
            with suppress(OSError):  # Some network file systems have no locks.
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            super().save_overload(sig, data)
        finally:
            os.close(descriptor)


class _Compiler(event.Listener):  # type: ignore[misc]
    """Hears of every function that numba compiles; of none that it finds in its cache."""

    def on_start(self, event: event.Event) -> None:  # noqa: ARG002 (any is one)
        report_compiling(begins=True)

    def on_end(self, event: event.Event) -> None:  # noqa: ARG002
        report_compiling(begins=False)


event.register("numba:compile", _Compiler())
