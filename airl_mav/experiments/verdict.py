"""`airl verdict`: a group-sequential test of a policy's success rate (`flight.sequential`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError
from airl_mav.core.progress import Progress
from airl_mav.experiments.campaign import Cell
from airl_mav.experiments.executors import Executor
from airl_mav.experiments.experiment import entry_of, file_name, known_seeds
from airl_mav.experiments.gap import NOT_MITIGATED, declare_gap
from airl_mav.experiments.live import Ended, FlownRun
from airl_mav.experiments.run import fly_scenario, workers_of
from airl_mav.flight.requirements import LOOKS, Requirement, RequirementDecision
from airl_mav.flight.statistics import reached_goals
from airl_mav.rehearsal.run_folder import RUN_FILE, check_folder, load_info
from airl_mav.report.comparison.comparison_model import Comparison, comparison_file
from airl_mav.report.run_verdict import OverallVerdict
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve

if TYPE_CHECKING:
    from airl_mav.report.comparison import show


@dataclass(frozen=True)
class SoughtVerdict:
    """Result of a sequential test."""

    path: Path
    """Folder with a run folder for the onboard computer and one for the reference."""
    ended: Ended
    verdict: OverallVerdict | None = None
    """Verdict; None = the test was interrupted or ended with an error."""
    comparison: Comparison | None = None
    runs: show.Runs | None = None


def seek_verdict(
    scenario: Scenario,
    requirements: Sequence[Requirement],
    *,
    reference: str,
    reference_workload: str | None = None,
    out: Path | None = None,
    progress: Progress,
) -> SoughtVerdict:
    """Fly a policy on its onboard computer until the test is decided, then on the reference."""
    tests = [each.test() for each in requirements if each.least_rate]
    if not tests:
        raise FieldError("require", accepted="at least one least success rate: 'success >= 95 %'")
    declared = declare_gap(
        scenario,
        mitigated=NOT_MITIGATED,
        reference=reference,
        reference_workload=reference_workload,
    )
    cells = {cell.role: cell for cell in declared.cells}
    target, undelayed = cells["target"], cells["reference"]
    out = out or Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-verdict-{file_name(declared.name)}"
    check_folder(out, comparison_file(out, declared.kind).name)
    for warning in known_seeds((target,)):
        progress.note(warning, "yellow")
    with workers_of(scenario) as executor:
        fly = partial(_fly, out=out, progress=progress, executor=executor)
        for n in _looks(scenario.episodes, _planned(out / target.name)):
            flown = fly(target, n)
            if flown.ended != "complete":
                return SoughtVerdict(out, flown.ended)
            reached = reached_goals(flown.episodes)
            decided = all(
                test.decide(reached) is not RequirementDecision.UNDECIDED for test in tests
            )
            # Flights that remain invalid prevent a verdict; further flights do not help.
            if decided or len(reached) < n:
                break
        flown = fly(undelayed, max(n, _planned(out / undelayed.name)))
    if flown.ended != "complete":
        return SoughtVerdict(out, flown.ended)
    # Imported here: flights do not need the figures.
    from airl_mav.report.comparison import show

    facts = {**declared.facts, "episodes": n, show.FLOWN_UNTIL: "the success rate was decided"}
    # The last interim analysis sets the planned number, which the run folder contains.
    entries = [replace(entry_of(cell, cell.name), planned=None) for cell in (undelayed, target)]
    comparison, runs = show.build_comparison(out, declared.kind, facts, entries)
    verdict = show.judge_comparison(comparison, runs, requirements)
    return SoughtVerdict(out, "complete", verdict, comparison, runs)


def _fly(
    cell: Cell, n: int, *, out: Path, progress: Progress, executor: Executor | None
) -> FlownRun:
    """Fly the missing episodes among the first n of a cell."""
    asked = cell.scenario.scenario.model_copy(update={"episodes": n})
    return fly_scenario(resolve(asked), out / cell.name, progress, executor=executor)


def _planned(run: Path) -> int:
    """Return the planned number of episodes of a run folder; 0 = no run."""
    return len(load_info(run).seeds) if (run / RUN_FILE).exists() else 0


def _looks(most: int, planned: int) -> list[int]:
    """Return the flight counts of interim analyses; FieldError if `most` is below the first."""
    if most < LOOKS[0]:
        raise FieldError("episodes", most, f"value >= {LOOKS[0]}, the first look")
    return [look for look in LOOKS if planned <= look <= max(most, planned)] or [planned]
