"""Registry of the add-ons: one folder each in `addons` of a package; the core works without any.

The `__init__` of an add-on is light and may define tables, which the core reads by name. In
`airl_mav.addons`:

    COMMANDS: {command of `airl`: (purpose, module with OPTIONS and run)}
    EXECUTORS: {value of `--executor`: module with `connected`}
    ALGORITHMS: {name in training files: `Algorithm` of `training.algorithm_table`}
    LIGHT: the commands can be imported without the simulator

In `firmware_sim.addons`:

    FLIGHT_MODES: {name of a `flight_modes.Mode`: module with its `FlightMode`}

Values are text (`module` or `module:name`); `load` imports what they name, on first use.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from typing import Any

PACKAGES = ("airl_mav", "companion", "firmware_sim")


def names(package: str = "airl_mav") -> list[str]:
    """Return the names of the add-ons of a package."""
    folders = importlib.import_module(f"{package}.addons").__path__
    return sorted(each.name for each in pkgutil.iter_modules(folders))


@cache
def entries(package: str, table: str) -> dict[str, Any]:
    """Return the entries of a table of all add-ons of a package, by name."""
    found: dict[str, Any] = {}
    for name in names(package):
        found |= getattr(importlib.import_module(f"{package}.addons.{name}"), table, {})
    return found


def load(place: str) -> Any:
    """Import the module, or the object of a module, that `module` or `module:name` names."""
    module, _, name = place.partition(":")
    loaded = importlib.import_module(module)
    return getattr(loaded, name) if name else loaded


def addon_commands() -> dict[str, tuple[str, str]]:
    """Return the subcommands of add-ons: purpose and module by name."""
    return entries("airl_mav", "COMMANDS")


def addon_executors() -> dict[str, str]:
    """Return the executors of add-ons: modules by name."""
    return entries("airl_mav", "EXECUTORS")


def addon_algorithms() -> dict[str, str]:
    """Return the learning algorithms of add-ons: rows of the algorithm table by name."""
    return entries("airl_mav", "ALGORITHMS")
