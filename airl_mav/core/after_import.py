"""Import hook: runs a module once another package is imported, without importing that package."""

from __future__ import annotations

import importlib
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any


def after_import(package: str, ours: str) -> None:
    """Import module `ours` after `package` is fully imported; `package` may be missing."""
    if package in sys.modules:
        importlib.import_module(ours)
    else:
        sys.meta_path.insert(0, _Watcher(package, ours))


class _Watcher:
    """Import finder that detects the import of a package and delegates it to other finders."""

    def __init__(self, package: str, ours: str) -> None:
        self._package = package
        self._ours = ours

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the spec of the next finders, extended by the import of our module."""
        if name != self._package:
            return None
        for finder in sys.meta_path:
            if isinstance(finder, _Watcher) or not hasattr(finder, "find_spec"):
                continue
            if (spec := finder.find_spec(name, path, target)) is not None:
                self._watch(spec)
                return spec
        return None

    def _watch(self, spec: ModuleSpec) -> None:
        """Let the package's loader import our module at its end."""
        loader: Any = spec.loader
        execute = getattr(loader, "exec_module", None)
        if execute is None:
            return

        def then(module: ModuleType) -> None:
            execute(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            importlib.import_module(self._ours)

        # Patch only this loader object: the package's spec and loader interface are unchanged.
        loader.exec_module = then
