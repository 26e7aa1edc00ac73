"""Scenario files: the fields of a scenario as TOML, for repeated and modified runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tomli_w

from airl_mav.core.files import replace_file
from airl_mav.core.plugins import names_file
from airl_mav.scenario.model import Scenario

SCENARIO_FILE = "scenario.toml"
"""Scenario file in a run folder."""


def save_scenario(scenario: Scenario, path: Path) -> None:
    """Write a scenario with absolute paths; fields at None are omitted."""
    data = anchored(scenario).model_dump(mode="json", exclude_none=True)
    replace_file(path, tomli_w.dumps(data).encode())


def anchored(scenario: Scenario) -> Scenario:
    """Return a scenario with absolute paths, independent of the working directory."""
    # Late import: reading a command line or a run folder needs no policy.
    from airl_mav.policy.registry import policy_names

    policy, latency = scenario.policy, scenario.latency or ""
    named = {name: getattr(scenario, name) for name in ("vehicle", "arena", "computer")}
    paths = {name: value for name, value in named.items() if value.endswith(".toml")}
    if names_file(policy) or (policy not in policy_names() and Path(policy).is_dir()):
        paths["policy"] = policy
    if ".toml/" in latency or Path(latency).is_file():
        paths["latency"] = latency
    real = {name: value.absolute() for name, value in scenario.real if isinstance(value, Path)}
    changes: dict[str, Any] = {name: f"{Path(value).absolute()}" for name, value in paths.items()}
    return scenario.model_copy(update={**changes, "real": scenario.real.model_copy(update=real)})
