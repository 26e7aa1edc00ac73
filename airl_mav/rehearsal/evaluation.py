"""A run and its folder: opened for a scenario, new or to be gone on with."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from airl_mav.core.errors import UsageError
from airl_mav.flight.record import EpisodeRecord
from airl_mav.rehearsal.run_folder import RUN_FILE, RunFolder, load
from airl_mav.scenario.file import SCENARIO_FILE, save_scenario
from airl_mav.scenario.model import free_fields
from airl_mav.scenario.resolved import ResolvedScenario


def run_settings(scenario: ResolvedScenario) -> dict[str, Any]:
    """Return all that is written down of a run, as plain values.

    The scenario as asked for, what it comes to, and the content of profiles and policy: a name does
    not tell a changed one.
    """
    profiles: dict[str, BaseModel] = {
        "vehicle": scenario.vehicle,
        "arena": scenario.arena,
        "computer": scenario.computer,
    }
    if scenario.injection.latency is not None:
        profiles["latency"] = scenario.injection.latency
    return {
        **scenario.scenario.model_dump(mode="json"),
        "pilot": asdict(scenario.pilot),
        "watchdog": scenario.watchdog.model_dump(mode="json"),
        "policy_sha256": scenario.policy.sha256,
        "profiles_sha256": {
            kind: hashlib.sha256(profile.model_dump_json().encode()).hexdigest()
            for kind, profile in profiles.items()
        },
    }


def open_run(
    scenario: ResolvedScenario, out: Path | None, name: str
) -> tuple[RunFolder, tuple[EpisodeRecord, ...]]:
    """Open the folder of a run: a new one, or one that holds the same run, finished or not.

    A run with the first ones of the seeds is the same run, and is added to.

    Args:
        scenario: What is flown.
        out: The folder; None makes a new one.
        name: Name of a new run.

    Returns:
        The folder, and the episodes that it holds.

    Raises:
        UsageError: It holds another run.
    """
    config, seeds = run_settings(scenario), scenario.scenario.seeds
    if out is None or not (out / RUN_FILE).exists():
        folder = RunFolder.create(out, name, config, setup=scenario.setup, seeds=seeds)
        save_scenario(scenario.scenario, folder.path / SCENARIO_FILE)
        return folder, ()
    held = load(out).info
    grows = len(held.seeds) < len(seeds) and held.seeds == seeds[: len(held.seeds)]
    free = free_fields(scenario.scenario.level) | ({"episodes"} if grows else set())
    if difference := another_config(held.config, config, free):
        raise UsageError(
            f"--out {out}: holds a run with {difference}; accepted: a new folder, or the same "
            "settings to go on"
        )
    folder, run = RunFolder.resume(out)
    folder.sweep()
    if grows:
        folder.plan_again(config, seeds)
        save_scenario(scenario.scenario, folder.path / SCENARIO_FILE)
    return folder, run.episodes


def another_config(
    held: Mapping[str, Any], asked: Mapping[str, Any], free: Collection[str] = ()
) -> str | None:
    """Return the first setting in which two configurations differ, or None when they do not.

    Settings in `free` are passed over, a table of them by its name.
    """
    old, new = _flat(held), _flat(json.loads(json.dumps(asked)))
    for key in sorted(old.keys() | new.keys()):
        known = key in free or key.partition(".")[0] in free
        if not known and old.get(key) != new.get(key):
            return f"{key} = {old.get(key)!r}, not {new.get(key)!r}"
    return None


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the settings by their dotted names."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
