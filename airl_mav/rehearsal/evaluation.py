"""What an evaluation is at every level: seeded episodes of one setup in one folder, resumable."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from airl_mav.core.errors import UsageError
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.setup import Setup
from airl_mav.rehearsal.run_folder import RUN_FILE, RunFolder, load

LEAVES_RESULTS_ALONE = ("policy_path", "slots", "speed", "tlogs", "workers")
"""Settings that may change when a run is taken up again."""


@dataclass(frozen=True)
class PlannedEpisode:
    """An episode to be flown."""

    index: int
    """Its number in the run."""
    seed: int


@dataclass(frozen=True)
class Evaluation:
    """What is flown, whatever the level."""

    setup: Setup
    seeds: tuple[int, ...]
    """Seed of each episode, by index; no two the same."""
    config: Mapping[str, Any]
    """Every setting, as plain values: what differs in any of them is another run, but for those
    of `LEAVES_RESULTS_ALONE`."""

    def left(self, done: Iterable[EpisodeRecord] = ()) -> list[PlannedEpisode]:
        """Return what is left to be flown when some episodes are done."""
        there = {record.index for record in done}
        return [PlannedEpisode(i, seed) for i, seed in enumerate(self.seeds) if i not in there]


def open_folder(
    out: Path | None,
    name: str,
    evaluation: Evaluation,
    *,
    free: Collection[str] = LEAVES_RESULTS_ALONE,
    may_grow: bool = False,
) -> tuple[RunFolder, tuple[EpisodeRecord, ...]]:
    """Open the folder of a run: a new one, or one that holds the same run, finished or not.

    Args:
        out: The folder; None makes a new one.
        name: Name of a new run.
        evaluation: What is flown.
        free: Settings that may differ, a table of them by its name.
        may_grow: Whether a run with the first ones of the seeds is the same one, and is added to.

    Returns:
        The folder, and the episodes that it holds.

    Raises:
        UsageError: It holds another run.
    """
    config, seeds = evaluation.config, evaluation.seeds
    if out is None or not (out / RUN_FILE).exists():
        folder = RunFolder.create(out, name, config, setup=evaluation.setup, seeds=seeds)
        return folder, ()
    held = load(out).info
    grows = may_grow and len(held.seeds) < len(seeds) and held.seeds == seeds[: len(held.seeds)]
    if difference := another_config(held.config, config, (*free, "episodes") if grows else free):
        raise UsageError(
            f"--out {out}: holds a run with {difference}; accepted: a new folder, or the same "
            "settings to go on"
        )
    folder, run = RunFolder.resume(out)
    folder.sweep()
    if grows:
        folder.plan_again(config, seeds)
    return folder, run.episodes


def another_config(
    held: Mapping[str, Any], asked: Mapping[str, Any], free: Collection[str] = LEAVES_RESULTS_ALONE
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
