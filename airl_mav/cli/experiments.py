"""Shared parts of commands that fly several runs: options, flights, comparison, output."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field
from rich.console import Console

from airl_mav.cli.shared_options import Gate, Telling, Voice, leave, requirements_of
from airl_mav.core.fields import COMMON, quantity
from airl_mav.scenario import aircraft, model

if TYPE_CHECKING:
    from airl_mav.experiments.experiment import Experiment, ExperimentRun

NOTHING_REQUIRED = Gate()
FOR_PEOPLE = Telling()

COMMANDS = {"matrix": "airl evaluate"}
"""Kinds of comparisons whose command has another name."""


def episodes(description: str, default: int, least: int = 1) -> Any:
    """Return a field for a number of episodes."""
    return quantity(description, "1", ge=least, le=model.GREATEST_EPISODES, default=default)


class ExperimentOptions(Telling, model.Flights, model.Lateness, model.Decisions, aircraft.Aircraft):
    """Options of all experiments; the default level is the fastest."""

    level: model.LevelName = Field(
        default="gym", description=model.Flights.model_fields["level"].description
    )


class OnboardOptions(Gate, ExperimentOptions):
    """Options for a policy on an onboard computer, compared with a reference."""

    GROUP: ClassVar[str] = "latency"
    computer: str = Field(
        default=model.ONBOARD_COMPUTER,
        description="onboard computer: a shipped profile, or a path to a .toml",
    )
    reference: Annotated[str, COMMON] = Field(
        default=model.REFERENCE_COMPUTER,
        description="computer that the onboard computer is compared with: a shipped profile, or a"
        " path",
    )
    reference_workload: str | None = Field(
        default=None,
        description="workload of the reference; default: the target's if the reference has it, else"
        " the one measured there with this policy, else 1 ms (gym, lockstep) or the time on this"
        " machine (sitl)",
    )


def fly_and_show(
    experiment: Experiment,
    out: Path | None,
    console: Console | None,
    gate: Gate = NOTHING_REQUIRED,
    telling: Telling = FOR_PEOPLE,
) -> tuple[int, ExperimentRun]:
    """Fly the rest of an experiment and show it; return 0, 1, 3 to 5 or 130, and its runs."""
    # Imported here and below: options need no simulator, and flights need no figures.
    from airl_mav.experiments.experiment import run_experiment
    from airl_mav.experiments.live import EXIT_CODES

    voice = Voice(telling, COMMANDS.get(experiment.kind, f"airl {experiment.kind}"), console)
    requirements = requirements_of(gate)
    with voice:
        flown = run_experiment(experiment, out, voice.progress)
        code = EXIT_CODES[flown.ended]
        if len(flown.cells) < 2 and flown.ended != "complete":
            voice.finish(code, flown.ended, flown.path)
            return code, flown
        from airl_mav.report.comparison.show import judge_comparison, show_comparison

        comparison, loaded = flown.compare()
        verdict = judge_comparison(comparison, loaded, requirements)
        if flown.ended == "complete":
            leave(gate, verdict, f"airl {experiment.kind}")
            code = verdict.exit_code
        page = show_comparison(
            comparison, loaded, flown.path, voice.console, verdict, voice.progress
        )
        voice.finish(code, flown.ended, flown.path, verdict=verdict, page=page, runs=loaded)
    return code, flown
