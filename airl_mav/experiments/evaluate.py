"""Evaluations (policies by arenas), latency curves, and comparisons of levels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError
from airl_mav.experiments import campaign, experiment
from airl_mav.faults import Fault
from airl_mav.flight import episode_record, statistics
from airl_mav.policy import card, card_writing, registry
from airl_mav.scenario.model import DEFAULT_ARENA, LevelName, Scenario

SHARED = (
    *("level", "vehicle", "computer", "workload", "latency", "ablate", "zone", "episodes", "seed"),
)
"""Fields in the header of a table: equal for all its runs."""

NOT_THE_POLICYS_OWN = (
    "ablate",
    "arena_seed",
    "zone",
    "goal_radius_m",
    "hold_s",
    "altitude_m",
    "max_speed_m_s",
    "decisions",
    "compensate",
    "time_limit_s",
    "watchdog",
    "faults",
)
"""Fields that, when set, keep results off the policy's card."""


def evaluate(
    scenario: Scenario,
    policies: Sequence[str],
    arenas: Sequence[str] = (),
    *,
    out: Path | str | None = None,
    progress: bool = False,
) -> experiment.ExperimentResult:
    """Fly policies in arenas on the same seeds and compare them in a table.

    Args:
        scenario: Flight settings; policy and arena are ignored.
        policies: Names or folders.
        arenas: Names or paths; empty = the policies' training arenas.
        out: Folder to create or resume; None = `runs/<UTC time>-matrix-...`.
        progress: Draw progress bars on standard error.

    Raises:
        UsageError: A scenario cannot be flown, or `out` contains other data.
        RehearsalError: Processes or workers were lost too often.
        KeyboardInterrupt: Ctrl-C; finished flights are kept.
    """
    return experiment.run_and_compare(matrix(scenario, policies, arenas), out, progress=progress)


def matrix(
    scenario: Scenario,
    policies: Sequence[str],
    arenas: Sequence[str] = (),
    *,
    each_fault: bool = False,
) -> experiment.Experiment:
    """Declare a table of policies by arenas; `each_fault` adds a row per policy and fault."""
    cells = evaluation_cells(scenario, policies, arenas, each_fault=each_fault)
    facts = {field: getattr(scenario, field) for field in SHARED}
    return experiment.Experiment("matrix", f"{len(policies)}-policies", facts, cells)


def evaluation_cells(
    scenario: Scenario,
    policies: Sequence[str],
    arenas: Sequence[str] = (),
    *,
    each_fault: bool = False,
) -> tuple[campaign.Cell, ...]:
    """Return an evaluation per policy and arena, and per fault with `each_fault`, or UsageError."""
    if not policies:
        raise FieldError("policies", accepted="one or more names or folders")
    found = [registry.find_policy(name, trust=scenario.trust) for name in policies]
    _check_names("policies", [policy.name for policy in found])
    if not arenas:
        arenas = list(dict.fromkeys(training_arena(policy) for policy in found))
    else:
        _check_names("arena", [Path(arena).stem for arena in arenas])
    ways: list[tuple[str, tuple[Fault, ...]]] = [("", scenario.faults)]
    if each_fault:
        if not scenario.faults:
            raise FieldError("each_fault", True, "with one fault or more")
        ways = [("", ()), *((f", {fault}", (fault,)) for fault in scenario.faults)]
        _check_names("faults", [told for told, _ in ways])
    return tuple(
        experiment.make_cell(
            experiment.file_name(f"{policy.name}-{Path(arena).stem}{told}"),
            f"{policy.name}{told} in {Path(arena).stem}",
            scenario.model_copy(update={"policy": path, "arena": arena, "faults": faults}),
            label=f"{policy.name}{told}",
            group=Path(arena).stem,
        )
        for path, policy in zip(policies, found, strict=True)
        for told, faults in ways
        for arena in arenas
    )


def training_arena(policy: registry.PolicyInfo) -> str:
    """Return the training arena of a policy, or the default arena."""
    return (None if policy.card is None else policy.card.training.arena) or DEFAULT_ARENA


def check_plain(cells: Sequence[campaign.Cell]) -> None:
    """Raise UsageError if settings keep the results off the policies' cards."""
    for cell in cells:
        asked, usual = cell.scenario.scenario, Scenario()
        for field in NOT_THE_POLICYS_OWN:
            if (value := getattr(asked, field)) != getattr(usual, field):
                raise FieldError(field, value, "without on-card: these are not the policy's own")
        if cell.scenario.policy.folder is None:
            raise FieldError("on_card", problem=f"{cell.scenario.policy.name} has no card")


def write_on_card(cell: campaign.Cell, episodes: Sequence[episode_record.EpisodeRecord]) -> None:
    """Write the results of a finished evaluation onto the policy's card, replacing earlier ones."""
    asked, folder = cell.scenario.scenario, cell.scenario.policy.folder
    if folder is None:
        return
    workload = None if asked.workload is None else f"{asked.computer}/{asked.workload}"
    card_writing.add_result(
        folder,
        card.MeasuredResult.of(
            statistics.aggregate(episodes),
            arena=cell.scenario.arena_name,
            level=asked.level,
            latency=asked.latency or workload,
            seed=asked.seed,
            flown_utc=utc_now().date().isoformat(),
        ),
    )


def _check_names(field: str, names: Sequence[str]) -> None:
    """Raise FieldError for duplicate names, which would share a row, a column and a folder."""
    for name in names:
        if names.count(name) > 1:
            raise FieldError(field, name, "each name once")


NATIVE = "native"
"""Name for no injected latency."""

LATENCIES = (NATIVE, "150ms", "300ms", "400ms", "950ms")

LATENCY_SWEEP_FACTS = ("arena", "level", "vehicle", "episodes", "seed")


def latency_sweep(
    scenario: Scenario,
    latencies: Sequence[str] = LATENCIES,
    policies: Sequence[str] = (),
    *,
    compensated: bool = False,
    out: Path | str | None = None,
    progress: bool = False,
) -> experiment.ExperimentResult:
    """Fly policies at increasing latencies and compare the results. Raises as `evaluate`.

    Args:
        scenario: Flight settings; latency and workload are ignored.
        latencies: Sources of t2, increasing, the reference first; `native` = none injected.
        policies: Names or folders; empty = the scenario's policy.
        compensated: Also fly each policy with latency compensation.
        out: Folder to create or resume; None = `runs/<UTC time>-latency-sweep-...`.
        progress: Draw progress bars on standard error.
    """
    declared = declare_latency_sweep(scenario, latencies, policies, compensated=compensated)
    return experiment.run_and_compare(declared, out, progress=progress)


def declare_latency_sweep(
    scenario: Scenario,
    latencies: Sequence[str] = LATENCIES,
    policies: Sequence[str] = (),
    *,
    compensated: bool = False,
) -> experiment.Experiment:
    """Declare a latency curve; see `latency_sweep`. Raises UsageError."""
    if len(latencies) < 2 or len(set(latencies)) < len(latencies):
        raise FieldError("latencies", " ".join(latencies), "two or more, each once, growing")
    names = list(policies) or [scenario.policy]
    cells = []
    found = [registry.find_policy(name, trust=scenario.trust).name for name in names]
    flown_as: list[dict[str, Any]] = [{}, {"compensate": True}] if compensated else [{}]
    for (path, name), way in product(zip(names, found, strict=True), flown_as):
        policy = f"{name}, compensated" if way else name
        for latency in latencies:
            given = None if latency == NATIVE else latency
            label = latency if given is None or not Path(given).is_file() else Path(given).stem
            flown = {"policy": path, "latency": given, "workload": None, **way}
            cells.append(
                experiment.make_cell(
                    experiment.file_name(f"{policy}-{label}"),
                    f"{policy} at {label}",
                    scenario.model_copy(update=flown),
                    label=label,
                    role=label,
                    group=policy,
                )
            )
    facts = {field: getattr(scenario, field) for field in LATENCY_SWEEP_FACTS}
    return experiment.Experiment(
        kind="latency-sweep",
        name="-".join(found),
        facts={"policies": found, **facts},
        cells=tuple(cells),
    )


LEVELS: tuple[LevelName, ...] = ("gym", "lockstep", "sitl")

SITL_EPISODES = 10
"""Default number of episodes at level sitl, which runs in real time."""

LEVELS_FACTS = ("arena", "vehicle", "computer", "workload", "latency", "seed")
"""Fields in the header of a comparison of levels, besides the policy."""


def compare_levels(
    scenario: Scenario,
    levels: Sequence[LevelName] = LEVELS,
    *,
    sitl_episodes: int | None = None,
    out: Path | str | None = None,
    progress: bool = False,
) -> experiment.ExperimentResult:
    """Fly the same scenario at several levels and compare the results. Raises as `evaluate`.

    Args:
        scenario: The scenario; its level is ignored.
        levels: Two or more levels, the reference first.
        sitl_episodes: Episodes at level sitl; None = 10, or all if fewer.
        out: Folder to create or resume; None = `runs/<UTC time>-compare-levels-...`.
        progress: Draw progress bars on standard error.
    """
    declared = declare_compare_levels(scenario, levels, sitl_episodes=sitl_episodes)
    return experiment.run_and_compare(declared, out, progress=progress)


def declare_compare_levels(
    scenario: Scenario,
    levels: Sequence[LevelName] = LEVELS,
    *,
    sitl_episodes: int | None = None,
) -> experiment.Experiment:
    """Declare a comparison of levels; see `compare_levels`. Raises UsageError."""
    if len(set(levels)) < len(levels) or len(levels) < 2:
        raise FieldError(
            "levels", " ".join(levels) or "none", "two or more of gym lockstep sitl, each once"
        )
    if sitl_episodes is not None and not 1 <= sitl_episodes <= scenario.episodes:
        raise FieldError("sitl_episodes", sitl_episodes, f"1 <= value <= {scenario.episodes}")
    fewer = min(sitl_episodes or SITL_EPISODES, scenario.episodes)
    cells = tuple(
        experiment.make_cell(level, level, scenario.model_copy(update=_at(level, fewer)))
        for level in levels
    )
    policy, arena = cells[0].scenario.policy, cells[0].scenario.arena_name
    facts = {
        "policy": policy.name,
        **{field: getattr(scenario, field) for field in LEVELS_FACTS},
    }
    facts["rules"] = "; ".join(dict.fromkeys(cell.scenario.rules for cell in cells))
    return experiment.Experiment(
        kind="compare-levels",
        name=f"{policy.name}-{arena}",
        facts=facts,
        cells=cells,
    )


def _at(level: LevelName, sitl_episodes: int) -> dict[str, object]:
    """Return the changed fields at a level; fields without support there get their defaults."""
    if level == "sitl":
        return {"level": level, "episodes": sitl_episodes, "workers": None, "tlogs": False}
    return {"level": level, "speed": None}
