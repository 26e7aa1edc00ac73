"""Registry of the add-ons: one folder each in `airl_mav/addons`; the core works without any.

The `__init__` of an add-on is light and may define:

    COMMANDS: {command of `airl`: (purpose, module with OPTIONS and run)}
    EXECUTORS: {value of `--executor`: module with `connected`}
    LIGHT: the commands can be imported without the simulator
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from typing import Any

_PACKAGE = "airl_mav.addons"


def names() -> list[str]:
    """Return the names of the add-ons."""
    folders = importlib.import_module(_PACKAGE).__path__
    return sorted(each.name for each in pkgutil.iter_modules(folders))


@cache
def _entries(table: str) -> dict[str, Any]:
    """Return the entries of a table of all add-ons."""
    found: dict[str, Any] = {}
    for name in names():
        found |= getattr(importlib.import_module(f"{_PACKAGE}.{name}"), table, {})
    return found


def addon_commands() -> dict[str, tuple[str, str]]:
    """Return the subcommands of add-ons: purpose and module by name."""
    return _entries("COMMANDS")


def addon_executors() -> dict[str, str]:
    """Return the executors of add-ons: modules by name."""
    return _entries("EXECUTORS")
