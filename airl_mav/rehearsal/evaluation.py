"""The folder of a scenario's run: a new one, or one that is gone on with."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from airl_mav.core.errors import UsageError
from airl_mav.flight.record import EpisodeRecord
from airl_mav.rehearsal.run_folder import RUN_FILE, RunFolder, load
from airl_mav.scenario.file import SCENARIO_FILE, save_scenario
from airl_mav.scenario.model import free_fields
from airl_mav.scenario.resolved import ResolvedScenario

CAMPAIGN_FILE = "campaign.json"

FOLDER_KINDS = {
    RUN_FILE: "a single run",
    CAMPAIGN_FILE: "a campaign",
    "train.json": "a training",
    **dict.fromkeys(("gap.json", "ladder.json", "matrix.json"), "runs of an earlier version"),
}
"""What a folder holds, by the first of these files that is found in it."""


def check_folder(path: Path, wanted: str) -> None:
    """Raise UsageError if a folder holds something else than the file by which ours is known."""
    for file, what in FOLDER_KINDS.items():
        if file == wanted and (path / file).exists():
            return
        if (path / file).exists():
            raise UsageError(f"--out {path}: holds {what}; accepted: another folder")


def open_folder(
    out: Path | None, name: str, scenario: ResolvedScenario
) -> tuple[RunFolder, tuple[EpisodeRecord, ...]]:
    """Open the folder of a run: a new one, or one that holds the same run, finished or not.

    A run with the first ones of the seeds is the same run, and is added to.

    Args:
        out: The folder; None makes a new one.
        name: Name of a new run.
        scenario: What is flown.

    Returns:
        The folder, and the episodes that it holds.

    Raises:
        UsageError: It holds something else, or another run.
    """
    config, seeds = scenario.config, scenario.seeds
    if out is not None:
        check_folder(out, RUN_FILE)
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
    if grows or not (out / SCENARIO_FILE).exists():
        # The file is missing where the process was killed as it wrote the folder's first files.
        save_scenario(scenario.scenario, folder.path / SCENARIO_FILE)
    return folder, run.episodes


def another_config(
    held: Mapping[str, Any], asked: Mapping[str, Any], free: Collection[str] = free_fields("gym")
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
