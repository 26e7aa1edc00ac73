"""Scenario files: the fields of a scenario as TOML, to be flown, changed and flown again."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import tomli_w

from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.core.files import replace_file
from airl_mav.scenario.model import Scenario

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SCENARIO_FILE = "scenario.toml"
"""Name of the scenario in a run folder."""


def read_scenario_file(path: Path) -> dict[str, Any]:
    """Return what a scenario file says. Raises UsageError if it cannot be read, or is no TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path}: not valid TOML: {error}") from None


def load_scenario(path: Path) -> Scenario:
    """Return the scenario of a file. Raises UsageError that names the file, field and range."""
    return validated(Scenario, read_scenario_file(path), path)


def save_scenario(scenario: Scenario, path: Path) -> None:
    """Write a scenario with all its fields; what is left open stays out."""
    data = scenario.model_dump(mode="json", exclude_none=True)
    replace_file(path, tomli_w.dumps(data).encode())
