"""Policies written in Python: a class in a file of the user's, named as FILE.py:CLASS."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType

from airl_mav.core.errors import FieldError
from airl_mav.policy.actions import Policy


def names_python(name: str) -> bool:
    """Return whether a policy's name is FILE.py:CLASS."""
    return ".py:" in name


def python_file(name: str) -> Path:
    """Return the file of FILE.py:CLASS."""
    return Path(name.rpartition(":")[0])


def python_class(name: str) -> Callable[[], Policy]:
    """Return the class of FILE.py:CLASS. The file is run, as an import runs it.

    Raises:
        FieldError: There is no such file or class, the file raises, or the class has no `act`.
    """
    file, attribute = python_file(name), name.rpartition(":")[2]
    if not file.is_file():
        raise FieldError("policy", name, problem=f"{file}: no such file")
    try:
        module = _module(file.resolve())
    except Exception as error:
        raise FieldError("policy", name, problem=f"{type(error).__name__}: {error}") from error
    made = getattr(module, attribute, None)
    if not (callable(made) and callable(getattr(made, "act", None))):
        raise FieldError("policy", name, f"FILE.py:CLASS; {file} has no class with a method act")
    policy: Callable[[], Policy] = made
    return policy


@cache
def _module(file: Path) -> ModuleType:
    """Return the module of a file, run once in a process."""
    spec = importlib.util.spec_from_file_location(f"airl_mav_policy_{file.stem}", file)
    assert spec is not None and spec.loader is not None  # noqa: S101 (a file that ends in .py)
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module
