"""Fidelity ladder: the same policy and seeds at several levels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from airl_mav.core.errors import FieldError
from airl_mav.experiments.experiment import Experiment, ExperimentResult, make_cell, run_and_compare
from airl_mav.scenario.model import LevelName, Scenario

LEVELS: tuple[LevelName, ...] = ("gym", "lockstep", "sitl")

SITL_EPISODES = 10
"""Default number of episodes at level sitl, which runs in real time."""

FACTS = ("arena", "vehicle", "computer", "workload", "latency", "seed")
"""Fields in the header of a ladder, besides the policy."""


def ladder(
    scenario: Scenario,
    levels: Sequence[LevelName] = LEVELS,
    *,
    sitl_episodes: int | None = None,
    out: Path | str | None = None,
    progress: bool = False,
) -> ExperimentResult:
    """Fly the same scenario at several levels and compare the results. Raises as `evaluate`.

    Args:
        scenario: The scenario; its level is ignored.
        levels: Two or more levels, the reference first.
        sitl_episodes: Episodes at level sitl; None = 10, or all if fewer.
        out: Folder to create or resume; None = `runs/<UTC time>-ladder-...`.
        progress: Draw progress bars on standard error.
    """
    declared = declare_ladder(scenario, levels, sitl_episodes=sitl_episodes)
    return run_and_compare(declared, out, progress=progress)


def declare_ladder(
    scenario: Scenario,
    levels: Sequence[LevelName] = LEVELS,
    *,
    sitl_episodes: int | None = None,
) -> Experiment:
    """Declare a ladder; see `ladder`. Raises UsageError."""
    if len(set(levels)) < len(levels) or len(levels) < 2:
        raise FieldError(
            "levels", " ".join(levels) or "none", "two or more of gym lockstep sitl, each once"
        )
    if sitl_episodes is not None and not 1 <= sitl_episodes <= scenario.episodes:
        raise FieldError("sitl_episodes", sitl_episodes, f"1 <= value <= {scenario.episodes}")
    fewer = min(sitl_episodes or SITL_EPISODES, scenario.episodes)
    cells = tuple(
        make_cell(level, level, scenario.model_copy(update=_at(level, fewer))) for level in levels
    )
    policy, arena = cells[0].scenario.policy, cells[0].scenario.arena_name
    facts = {"policy": policy.name, **{field: getattr(scenario, field) for field in FACTS}}
    facts["rules"] = "; ".join(dict.fromkeys(cell.scenario.rules for cell in cells))
    return Experiment(
        kind="ladder",
        name=f"{policy.name}-{arena}",
        facts=facts,
        cells=cells,
    )


def _at(level: LevelName, sitl_episodes: int) -> dict[str, object]:
    """Return the changed fields at a level; fields without support there get their defaults."""
    if level == "sitl":
        return {"level": level, "episodes": sitl_episodes, "workers": None, "tlogs": False}
    return {"level": level, "speed": None}
