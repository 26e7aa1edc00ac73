"""What the commands that fly several runs share: options; fly, compare, print."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field
from rich.console import Console

from airl_mav.cli.gate import Gate, leave, requirements_of
from airl_mav.core.fields import quantity
from airl_mav.core.progress import RichProgress
from airl_mav.experiments.experiment import Experiment, ExperimentRun, run_experiment
from airl_mav.experiments.gap import DEFAULT_COMPUTER, DEFAULT_REFERENCE
from airl_mav.experiments.live import EXIT_CODES
from airl_mav.report.comparison.show import print_comparison
from airl_mav.report.verdict import load_verdict
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.scenario.model import GREATEST_EPISODES, Decisions, Flights, Lateness, LevelName

NOTHING_REQUIRED = Gate()


def episodes(description: str, default: int, least: int = 1) -> Any:
    """Return a number of episodes as a field."""
    return quantity(description, "1", ge=least, le=GREATEST_EPISODES, default=default)


class ExperimentOptions(Flights, Lateness, Decisions, Aircraft):
    """What all of them can be asked for; the level is that of the most flights a second."""

    level: LevelName = Field(default="gym", description=Flights.model_fields["level"].description)


class OnboardOptions(Gate, ExperimentOptions):
    """A policy on an onboard computer, compared with a reference."""

    computer: str = Field(
        default=DEFAULT_COMPUTER,
        description="onboard computer: a shipped profile, or a path to a .toml",
    )
    reference: str = Field(
        default=DEFAULT_REFERENCE,
        description="computer that the onboard computer is compared with: a shipped profile, or a"
        " path",
    )
    reference_workload: str | None = Field(
        default=None,
        description="workload of the reference; by default the target's if the reference has it,"
        " otherwise what was measured there for the very policy, or else 1 ms (gym, lockstep), or"
        " what this machine takes (sitl)",
    )


def fly_and_show(
    experiment: Experiment, out: Path | None, console: Console, gate: Gate = NOTHING_REQUIRED
) -> tuple[int, ExperimentRun]:
    """Fly what is left of an experiment and show the comparison of what is there.

    Returns:
        Exit status, 0 all episodes flown, 1 processes or workers were lost, 3 to 5 as of the
        verdict, 130 Ctrl-C; and what was flown.

    Raises:
        UsageError: The input cannot be used.
    """
    requirements = requirements_of(gate)
    with RichProgress(console) as progress:
        flown = run_experiment(experiment, out, progress)
    code = EXIT_CODES[flown.ended]
    if len(flown.cells) > 1 or flown.ended == "complete":
        comparison, loaded, page = flown.compare(requirements)
        print_comparison(comparison, loaded, console, page)
        if flown.ended == "complete":
            verdict = load_verdict(flown.path)
            leave(gate, verdict, f"airl {experiment.kind}")
            code = verdict.exit_code
    return code, flown
