"""`airl verdict`: does a policy hold on an onboard computer? As few flights as that takes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli.gate import Gate, leave, requirements_of
from airl_mav.cli.options import POSITIONAL, REPEATED, scenario_of
from airl_mav.core.fields import quantity
from airl_mav.core.progress import RichProgress
from airl_mav.experiments.gap import DEFAULT_COMPUTER, DEFAULT_REFERENCE
from airl_mav.experiments.live import EXIT_CODES
from airl_mav.experiments.verdict import seek_verdict
from airl_mav.report.comparison.show import print_comparison
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.scenario.model import (
    DEFAULT_ARENA,
    DEFAULT_POLICY,
    Decisions,
    Flights,
    Lateness,
    LevelName,
)


class VerdictOptions(Gate, Flights, Lateness, Decisions, Aircraft):
    """Fly a policy as late as an onboard computer decides, until its success rate is decided.

    Flights are added until they show that the rate is reached, or that it is not; a verdict is
    wrong at most once in twenty, however often it is looked. The same seeds are then flown on the
    reference, for one page that compares both. The same --out goes on.

    Examples:
        airl verdict static-obstacles --computer ras-pi-4 --workload template-5x32
        airl verdict MINE --latency pi.txt --require "success >= 98 %"
    """

    policy: Annotated[str, POSITIONAL] = Field(
        default=DEFAULT_POLICY,
        description="a name, or a path to a folder with policy.onnx and card.json",
    )
    require: Annotated[tuple[str, ...], REPEATED] = Field(
        default=("success >= 95 %",), description=Gate.model_fields["require"].description
    )
    computer: str = Field(
        default=DEFAULT_COMPUTER,
        description="onboard computer: a shipped profile, or a path to a .toml",
    )
    reference: str = Field(
        default=DEFAULT_REFERENCE,
        description="computer that the flights are compared with: a shipped profile, or a path",
    )
    arena: str = Field(
        default=DEFAULT_ARENA, description="arena profile: a shipped name, or a path to a .toml"
    )
    level: LevelName = Field(
        default="lockstep", description=Flights.model_fields["level"].description
    )
    episodes: int = quantity(
        "greatest number of flights on the onboard computer", "1", ge=1, le=100_000, default=500
    )
    out: Path | None = Field(
        default=None,
        description="folder: two run folders, gap.html and verdict.json; by default"
        " runs/<UTC time>-verdict-<policy>-<computer>",
    )


OPTIONS = VerdictOptions


def run(options: VerdictOptions, console: Console | None = None) -> int:
    """Seek the verdict.

    Exit status: 0 what is required is met, 1 processes or workers were lost, 3 to 5 as of the
    verdict, 130 Ctrl-C.
    """
    console = console or Console()
    requirements = requirements_of(options)
    with RichProgress(console) as progress:
        sought = seek_verdict(
            scenario_of(options),
            requirements,
            reference=options.reference,
            out=options.out,
            progress=progress,
        )
    if sought.verdict is None or sought.comparison is None or sought.page is None:
        return EXIT_CODES[sought.ended]
    print_comparison(sought.comparison, sought.runs or {}, console, sought.page)
    leave(options, sought.verdict, "airl verdict")
    return sought.verdict.exit_code
