"""Plug-ins: custom components, selected by name in place of built-in ones.

A component is named as `FILE.py:NAME`, as `MODULE:NAME`, or by an entry point of an installed
package, in the group of its kind. Loading a component runs its module, like an import. Names may
therefore come from a command line or from the user's files, but not from downloaded data.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from pydantic import AfterValidator
from pydantic_core import PydanticCustomError

from airl_mav.core.errors import FieldError

_FILE = re.compile(r"(?P<file>.+\.py):(?P<name>[^:/\\]*)", re.DOTALL)
_MODULE = re.compile(r"(?P<module>[^\W\d]\w*(\.[^\W\d]\w*)*):(?P<name>[^\W\d]\w*)")


@dataclass(frozen=True)
class PluginKind:
    """Kind of component that plug-ins can provide."""

    field: str
    """Field that selects the component, as named in messages."""
    group: str
    """Entry point group of installed packages."""
    wanted: str
    """Required type: "a class with a method act"."""


POLICIES = PluginKind("policy", "airl_mav.policies", "a class with a method act")
REWARDS = PluginKind(
    "reward", "airl_mav.rewards", "a function, or a class whose objects can be called"
)
NETWORKS = PluginKind("network.kind", "airl_mav.networks", "a class of SB3's BaseFeaturesExtractor")
LAYOUTS = PluginKind("layout", "airl_mav.layouts", "a class with methods boxes and encode")
ACTION_SETS = PluginKind("actions", "airl_mav.action_sets", "a class with a method commands")
GENERATORS = PluginKind("generator", "airl_mav.generators", "a function that makes an Arena")
CAMERAS = PluginKind("camera", "airl_mav.cameras", "a class with a lens and a method read")
MODELS = PluginKind(
    "model", "airl_mav.models", "a torch.nn.Module, or what makes one without arguments"
)

DOORS = (POLICIES, REWARDS, NETWORKS, LAYOUTS, ACTION_SETS, GENERATORS, CAMERAS, MODELS)


def names_code(name: str) -> bool:
    """Return True if a name is FILE.py:NAME or MODULE:NAME."""
    return names_file(name) or _MODULE.fullmatch(name) is not None


def names_file(name: str) -> bool:
    """Return True if a name is FILE.py:NAME."""
    return _FILE.fullmatch(name) is not None


def announced(door: PluginKind) -> dict[str, str]:
    """Return the components of installed packages, name to MODULE:NAME, without importing them."""
    return {each.name: f"{each.module}:{each.attr}" for each in entry_points(group=door.group)}


def reference(door: PluginKind, name: str) -> str | None:
    """Return a component's FILE.py:NAME or MODULE:NAME by any of its names; None = unknown."""
    return name if names_code(name) else announced(door).get(name)


def accepted(door: PluginKind, shipped: Sequence[str]) -> str:
    """Return the accepted names as text for messages."""
    known = [repr(name) for name in (*shipped, *announced(door))]
    return f"{', '.join(known)}, FILE.py:NAME or MODULE:NAME"


def part_name(door: PluginKind, shipped: Sequence[str]) -> AfterValidator:
    """Return the validator of a field with the name of a built-in component or a plug-in.

    The component is not loaded: reading a file runs no code.
    """

    def check(name: str) -> str:
        if name in shipped or reference(door, name) is not None:
            return name
        listed = accepted(door, shipped)
        raise PydanticCustomError("literal_error", "unknown part", {"expected": listed})

    return AfterValidator(check)


_loaded: set[tuple[str, str]] = set()
"""Kind and name of the components loaded by this process."""


def is_loaded(door: PluginKind, name: str) -> bool:
    """Return True if this process has loaded a component by this name, as given by the user."""
    return (door.group, name) in _loaded


def load_part(door: PluginKind, name: str, fits: Callable[[Any], bool] = callable) -> Any:
    """Return a component by any of its names. Its file or module runs once per process.

    The name is FILE.py:NAME, MODULE:NAME, or an installed package's entry point; `fits` accepts or
    rejects the component. Raises FieldError if the file, module or component is missing, its module
    raises, or it is rejected.
    """
    found = reference(door, name)
    if found is None:
        raise FieldError(door.field, name, accepted(door, ()))
    where, _, attribute = found.rpartition(":")
    if names_file(found) and not Path(where).is_file():
        raise FieldError(door.field, name, problem=f"{where}: no such file")
    try:
        module = _file_module(Path(where).resolve()) if names_file(found) else _module(where)
    except Exception as error:
        told = " ".join(f"{type(error).__name__}: {error}".split())
        raise FieldError(door.field, name, problem=told) from error
    part = getattr(module, attribute, None)
    if part is None or not fits(part):
        raise FieldError(door.field, name, f"{door.wanted}; {where} has none of this name")
    _loaded.add((door.group, name))
    return part


def load_object(door: PluginKind, name: str, methods: Sequence[str]) -> Any:
    """Return an object with methods, constructed without arguments if the component is a class.

    Raises FieldError as `load_part`, and if it cannot be constructed.
    """
    found = load_part(
        door, name, lambda part: all(callable(getattr(part, each, None)) for each in methods)
    )
    try:
        return found() if isinstance(found, type) else found
    except Exception as error:
        problem = f"cannot be made without arguments: {type(error).__name__}: {error}"
        raise FieldError(door.field, name, problem=problem) from error


def digest_of(found: str) -> str | None:
    """Return the SHA-256 of a component's file; None without a file. Raises OSError."""
    where = found.rpartition(":")[0]
    file: str | None = where
    if not names_file(found):
        file = getattr(_module(where), "__file__", None)
    return None if file is None else hashlib.sha256(Path(file).read_bytes()).hexdigest()


def _module(name: str) -> ModuleType:
    """Import a module; the current folder is searched last."""
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        # The path of a console script starts with the script's folder instead.
        sys.path.append(here)
    return importlib.import_module(name)


@cache
def _file_module(file: Path) -> ModuleType:
    """Return the module of a file, run once per process."""
    # The name includes the folder: dataclasses and pickles look up their module, and files of the
    # same name must be different modules.
    folder = hashlib.sha256(str(file.parent).encode()).hexdigest()[:8]
    spec = importlib.util.spec_from_file_location(f"airl_mav_plugin_{file.stem}_{folder}", file)
    assert spec is not None and spec.loader is not None  # noqa: S101 (the file ends in .py)
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[module.__name__]
        raise
    return module
