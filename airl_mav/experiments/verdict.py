"""`airl verdict`: fly until it is decided whether a policy holds on an onboard computer.

Flights are added in steps, and after each step the success rate is tested in a way that may be
looked at any number of times (`flight.sequential`). What is required besides is judged once, on the
flights that this took.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError
from airl_mav.core.progress import Progress
from airl_mav.experiments.campaign import Cell
from airl_mav.experiments.experiment import Experiment, entry_of
from airl_mav.experiments.fly import fly_scenario
from airl_mav.experiments.gap import NOT_MITIGATED, declare_gap
from airl_mav.experiments.live import Ended
from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.requirements import Finding, Requirement
from airl_mav.flight.sequential import Decision, RateTest
from airl_mav.rehearsal.run_folder import RUN_FILE, load
from airl_mav.report.comparison.model import Comparison
from airl_mav.report.comparison.show import (
    Runs,
    build_comparison,
    judge_comparison,
    write_comparison,
)
from airl_mav.report.verdict import OverallVerdict
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve

STEPS = (20, 40, 60, 80, 100, 150, 200, 300, 400, 600, 800, 1000, 1500, 2000, 3000, 5000, 10_000)
"""Numbers of flights after which it is looked whether they decide."""


@dataclass(frozen=True)
class SoughtVerdict:
    """What was flown, and what it came to."""

    path: Path
    """Its folder: a run folder for the onboard computer and one for the reference."""
    ended: Ended
    verdict: OverallVerdict | None = None
    """None: it was interrupted or broken off."""
    comparison: Comparison | None = None
    runs: Runs | None = None
    """Of the comparison, by name."""
    page: Path | None = None


def seek_verdict(
    scenario: Scenario,
    requirements: Sequence[Requirement],
    *,
    reference: str,
    reference_workload: str | None = None,
    out: Path | None = None,
    progress: Progress,
) -> SoughtVerdict:
    """Fly a policy on its onboard computer until its success rate is decided, then the reference.

    Args:
        scenario: The policy and how it is flown; `episodes` is the greatest number of flights.
        requirements: What is asked. At least one is a least success rate.
        reference: Computer profile whose flights, of the same seeds, the others are compared with.
        reference_workload: As of `declare_gap`.
        out: Folder; the same one goes on. None makes `runs/<UTC time>-verdict-...`.
        progress: Who looks on.

    Raises:
        UsageError: It cannot be flown, or the folder holds another verdict's flights.
    """
    tests = {each: _test_of(each) for each in requirements if _is_rate(each)}
    if not tests:
        raise FieldError("require", accepted="at least one least success rate: 'success >= 95 %'")
    declared = _declare(scenario, reference, reference_workload)
    out = out or Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-verdict-{declared.name}"
    target, undelayed = (_role(declared, role) for role in ("target", "reference"))
    episodes: Sequence[EpisodeRecord] = ()
    n = 0
    for n in _steps(scenario.episodes, _planned(out / target.name)):
        ended, episodes = _fly(target, n, out, progress)
        if ended != "complete":
            return SoughtVerdict(out, ended)
        decided = [test.decide(*_count(episodes)) for test in tests.values()]
        if Decision.UNDECIDED not in decided:
            break
    ended, _ = _fly(undelayed, max(n, _planned(out / undelayed.name)), out, progress)
    if ended != "complete":
        return SoughtVerdict(out, ended)
    entries = [entry_of(cell, cell.name) for cell in (undelayed, target)]
    comparison, runs = build_comparison(out, "gap", {**declared.facts, "episodes": n}, entries)
    verdict = judge_comparison(comparison, runs, requirements)
    verdict = replace(
        verdict,
        findings=tuple(
            _settled(finding, tests[finding.requirement], episodes)
            if finding.requirement in tests
            else finding
            for finding in verdict.findings
        ),
    )
    page = write_comparison(comparison, runs, out, verdict)
    return SoughtVerdict(out, "complete", verdict, comparison, runs, page)


def _declare(scenario: Scenario, reference: str, workload: str | None) -> Experiment:
    return declare_gap(
        scenario, mitigated=NOT_MITIGATED, reference=reference, reference_workload=workload
    )


def _role(experiment: Experiment, role: str) -> Cell:
    (cell,) = (cell for cell in experiment.cells if cell.role == role)
    return cell


def _fly(
    cell: Cell, n: int, out: Path, progress: Progress
) -> tuple[Ended, Sequence[EpisodeRecord]]:
    """Fly the first n episodes of a cell, as far as they are not there."""
    asked = cell.scenario.scenario.model_copy(update={"episodes": n})
    flown = fly_scenario(resolve(asked), out / cell.name, progress)
    return flown.ended, flown.episodes


def _planned(run: Path) -> int:
    """Return how many episodes a run folder plans; 0: there is none."""
    return len(load(run).info.seeds) if (run / RUN_FILE).exists() else 0


def _steps(most: int, planned: int) -> list[int]:
    """Return the numbers of flights to look at: a run that was begun goes on where it was."""
    steps = sorted({step for step in STEPS if planned < step < most} | {most})
    return [planned, *steps] if 0 < planned < most else steps


def _is_rate(requirement: Requirement) -> bool:
    return (requirement.measure, requirement.gap, requirement.sense) == ("success", False, ">=")


def _test_of(requirement: Requirement) -> RateTest:
    """Return the test of a least success rate. Raises FieldError for one of 100 %."""
    if requirement.limit >= 100.0:
        raise FieldError(
            "require", str(requirement), "a success rate below 100 %: no number of flights shows it"
        )
    return RateTest(0.01 * requirement.limit)


def _count(episodes: Sequence[EpisodeRecord]) -> tuple[int, int]:
    """Return how many flights reached the goal, and how many there are."""
    valid = [episode for episode in episodes if not episode.invalid]
    return sum(episode.outcome is Outcome.SUCCESS for episode in valid), len(valid)


def _settled(finding: Finding, test: RateTest, episodes: Sequence[EpisodeRecord]) -> Finding:
    """Return a finding as the test that may be looked at again and again decides it."""
    successes, n = _count(episodes)
    decision = test.decide(successes, n)
    more = None
    if decision is Decision.UNDECIDED and n:
        needed = test.flights_needed(successes / n)
        more = None if needed is None else max(1, needed - n)
    return replace(finding, decision=decision, more_flights=more)
