"""Registry of the add-ons: one folder each in `addons` of a package; the core works without any.

The `__init__` of an add-on is light and may define tables, which the core reads by name. In
`airl_mav.addons`:

    COMMANDS: {command of `airl`: (group of `airl --help`, purpose, module with OPTIONS and run)}
    COLOUR: {part of colour cameras, see `camera.render.colour`: object}
    EXECUTORS: {value of `--executor`: module with `connected`}
    EXPORTS: {option of `airl export`: function from a policy's folder to a new policy}
    ALGORITHMS: {name in training files: `Algorithm` of `training.algorithm_table`}
    VIEW: {part of the live view: its class or function} (`rehearsal.live_view`)
    RECORDINGS: {suffix of a flight's recording: function that makes a run folder of it}
    FORENSICS: {`examine` or `section`: function for the causes of a run's failed flights}
    LIGHT: the commands can be imported without the simulator
    ENVIRONMENTS: {id of a Gymnasium environment: class}
    LOCKSTEP: {"firmware" or "companion": function that flies one side of two processes}
    PROFILE_SECTIONS: {section of a profile such as "arena.appearance": its model}
    SITL_OPTIONS: {option of `airl sitl`: function to a context manager around the flights}

In `companion.addons`:

    CAMERAS: {"driver": function that opens a camera by the name of a driver}
    RECORDERS: {"black_box": context manager that records a mission}
    REPORTS: {"vehicle": context manager that sends messages in a mission}

In `firmware_sim.addons`:

    FIRMWARE: {value of `--firmware`: `firmware_sim.external.programs.FirmwareKind`}
    BODIES: {value of `--plant`: class of the vehicle's `plant.body.PlantBody`}
    AIDING: {any name: class of the `estimator.Aiding` that fuses further sensors}
    FLIGHT_MODES: {name of a `flight_modes.Mode`: module with its `FlightMode`}
    SENSORS: {name in `profiles.vehicle.Sensors`: its `sensor_table.Sensor`}
    MISSIONS: {name: subclass of `navigation.plan.Missions`}
    SERVICES: {name: MAVLink service, a module as described in `firmware_sim.mavlink.services`}
    STREAMS: {name: module with BUILDERS of streamed messages, as `firmware_sim.mavlink.streams`}
    CAPABILITIES: {name: bit of MAV_PROTOCOL_CAPABILITY}
    EVENTS: {name: module with event `Definition`s}
    FLIGHT_LOGS: {name: function that opens a `firmware_sim.firmware.FlightLog`}
    TOPICS: {name: module of the flight log's topics, for other add-ons}
    FAULT_EFFECTS: {`parts`, `camera` or `link`: class that executes faults there}

Values are text (`module` or `module:name`); `load` imports what they name, on first use.
`after_import` runs a module of this package once another package is imported.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from functools import cache
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from airl_mav.core.errors import FieldError

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


def load_entry(package: str, table: str, name: str, option: tuple[str, object], addon: str) -> Any:
    """Import what an entry of a table names.

    Args:
        package: Package of the add-ons.
        table: Table of the entry.
        name: Name of the entry.
        option: Option that needs the entry, and its value.
        addon: Add-on that has the entry.

    Raises:
        FieldError: The add-on is missing.
    """
    place = entries(package, table).get(name)
    if place is None:
        raise FieldError(*option, problem=f"needs the add-on {package}/addons/{addon}")
    return load(place)


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
