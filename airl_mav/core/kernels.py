"""Compilation of hot functions: one decorator, one set of options, one cache."""

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

from airl_mav.core.compiling import report_compiling, writable_folder

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGES = ("airl_mav", "firmware_sim")
"""Packages of the distribution that contain kernels."""

_ROOT = Path(__file__).resolve().parents[2]
"""Folder of the packages."""

_CACHE_NAME = "numba-"
"""Prefix of folder names for compiled code, followed by the digest of its sources."""

_PACKAGE = rf"(?:{'|'.join(_PACKAGES)})[\w.]*"
_IMPORT = re.compile(
    rf"^[ \t]*(?:from ({_PACKAGE}) import (\([^)]*\)|.*)|import ({_PACKAGE}))", re.MULTILINE
)


@cache
def _file_of(module: str) -> Path | None:
    """Return the file of a module of this distribution; None if there is no such module."""
    path = _ROOT.joinpath(*module.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file
    return None


@cache
def _read(file: Path) -> tuple[str, tuple[Path, ...]]:
    """Return the digest of a source file, and its imported files."""
    text = file.read_text(encoding="utf-8")
    names: list[str] = []
    for package, imported, module in _IMPORT.findall(text):
        names += [module] if module else [package]
        names += [f"{package}.{name}" for name in re.findall(r"\w+", imported)]
    files = {found for name in names if (found := _file_of(name)) is not None}
    return hashlib.sha256(text.encode()).hexdigest(), tuple(sorted(files))


def _closure(files: Iterable[Path]) -> dict[Path, str]:
    """Return the digests of source files and of all direct and indirect imports."""
    pending, found = list(files), dict[Path, str]()
    while pending:
        each = pending.pop()
        if each not in found:
            found[each], imported = _read(each)
            pending += imported
    return found


@cache
def _closure_digest(file: Path) -> str:
    """Return a digest of a source file and of all its direct and indirect imports."""
    found = _closure([file])
    listed = "".join(sorted(f"{each.name} {digest}\n" for each, digest in found.items()))
    return hashlib.sha256(listed.encode()).hexdigest()[:16]


@cache
def _folder(digest: str) -> Path | None:
    """Return the cache folder for a digest of sources; None if no folder is writable."""
    return writable_folder(f"{_CACHE_NAME}{digest}")


def cache_folder(source: str) -> Path | None:
    """Return the cache folder for a source file and all its imports.

    A change of any of these files gives another folder. None if no folder is writable, if the user
    has set a folder for all compiled code (`NUMBA_CACHE_DIR`), or if the source is not a file.
    """
    file = Path(source).resolve()
    if numba.config.CACHE_DIR or not file.is_file():
        return None
    return _folder(_closure_digest(file))


@contextmanager
def _caching_in(folder: Path | None) -> Iterator[None]:
    """Set numba's cache folder within the context; None = numba's default."""
    chosen = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = chosen if folder is None else str(folder)
    try:
        yield
    finally:
        numba.config.CACHE_DIR = chosen


def kernel(function: F) -> F:
    """Compile a function with numba.

    Compiled code is cached on disk and releases the GIL. Only the first start after an install
    compiles. Kernels are always inlined: numba would pass the forty gains by value at each call, at
    the cost of a third of the vectorized simulator's speed. They are never `parallel`: each process
    has one thread, and processes provide parallelism.

    A division by zero gives infinity or NaN, as in numpy. Checks for a ZeroDivisionError take a
    tenth of the vectorized simulator's speed, and prevent vector instructions.

    numba invalidates a cached function only if its own file changes. A kernel that inlines another
    kernel, or a constant, from a changed file would keep running the old code, even after an
    upgrade of the package. The cache folder therefore depends on the file and all its imports.
    """
    return _compiled(function, forceinline=True)


def large_kernel(function: F) -> F:
    """Compile a function with numba, not inlined: for long functions that are rarely called."""
    return _compiled(function, forceinline=False)


def borrowing_kernel(function: F) -> F:
    """Compile a function as `kernel` does, without reference counts of arrays.

    numba counts the references to every array: one more for each view, `row[left:end]`, and one
    less at its end, both atomically. For images drawn in short rows this takes half the time.

    The caller must own all arrays and hold them until the function returns. The function cannot
    create arrays (numba refuses to compile it), and must not return any, not even within a tuple.
    """
    return _compiled(function, forceinline=True, counts=False)


def large_borrowing_kernel(function: F) -> F:
    """Compile a function as `borrowing_kernel`, but not inlined, as `large_kernel`."""
    return _compiled(function, forceinline=False, counts=False)


kernel_files: set[str] = set()
"""Source files of the kernels loaded so far."""


def sources() -> list[Path]:
    """Return the source files of the kernels loaded so far, with their imports."""
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
    """Return a kernel's call template for other kernels, compiled once for all constants."""
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
    """Listener for every function that numba compiles; excludes functions found in the cache."""

    def on_start(self, event: event.Event) -> None:  # noqa: ARG002 (any is one)
        report_compiling(begins=True)

    def on_end(self, event: event.Event) -> None:  # noqa: ARG002
        report_compiling(begins=False)


event.register("numba:compile", _Compiler())
