"""`airl verdict`: sequential test of a policy's success rate on an onboard computer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL, REPEATED
from airl_mav.cli.shared_options import (
    Gate,
    OnboardOptions,
    Voice,
    episodes,
    leave,
    requirements_of,
)
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import COMMON
from airl_mav.experiments import hardware_gap, live
from airl_mav.flight.requirements import LOOKS
from airl_mav.scenario import model

DEFAULT_REQUIREMENT = "success >= 95 %"
DEFAULT_GAP = "success gap >= 0 points"
"""Default requirement for a comparison of two policies."""


class VerdictOptions(OnboardOptions):
    """Fly a policy with an onboard computer's latency, until its success rate is decided.

    Flights are added until the rate is shown to be met or not met. The probability of a wrong
    verdict is at most 5 %, regardless of the number of interim analyses. The same seeds are then
    flown on the reference, for a comparison page. With --against, two policies fly the same seeds
    until their gap of success is decided. The same --out resumes an interrupted run.

    Examples:
        airl verdict static-obstacles --computer ras-pi-4 --workload template-5x32
        airl verdict MINE --latency pi.txt --require "success >= 98 %"
        airl verdict MINE --against static-obstacles --require "success gap >= -2 points"
    """

    policy: Annotated[str, POSITIONAL] = Field(
        default=model.DEFAULT_POLICY,
        description="a name, or a path to a folder with policy.onnx and card.json",
    )
    against: Annotated[str | None, COMMON] = Field(
        default=None,
        description="another policy, a name or path: flies on the same computer and seeds until the"
        f" gap of success is decided; by default '{DEFAULT_GAP}'",
    )
    arena: model.ArenaName = model.DEFAULT_ARENA
    require: Annotated[tuple[str, ...], REPEATED] = Field(
        default=(),
        description=f"{Gate.model_fields['require'].description}; by default"
        f" '{DEFAULT_REQUIREMENT}'",
    )
    level: model.LevelName = Field(
        default="lockstep", description=model.Flights.model_fields["level"].description
    )
    episodes: int = episodes(
        "greatest number of flights on the onboard computer; it is looked whether they decide after"
        f" {', '.join(map(str, LOOKS[:10]))}, ...",
        500,
        LOOKS[0],
    )
    out: Annotated[Path | None, COMMON, "output"] = Field(
        default=None,
        description="folder: two run folders, hardware-gap.html and verdict.json; by default"
        " runs/<UTC time>-verdict-<policy>-<computer>",
    )


OPTIONS = VerdictOptions


def run(options: VerdictOptions, console: Console | None = None) -> int:
    """Seek the verdict; return 0, 1 (workers lost), 3 to 5 (verdict) or 130 (Ctrl-C)."""
    voice = Voice(options, "airl verdict", console)
    # Not the field's default: given requirements would be appended to the default.
    default = DEFAULT_REQUIREMENT if options.against is None else DEFAULT_GAP
    asked = options.model_copy(update={"require": options.require or (default,)})
    requirements = requirements_of(asked)
    undelayed = options.reference, options.reference_workload
    if options.against and undelayed != (model.REFERENCE_COMPUTER, None):
        raise FieldError("against", options.against, "left out with --reference")
    with voice:
        sought = hardware_gap.seek_verdict(
            options.scenario,
            requirements,
            reference=options.reference,
            reference_workload=options.reference_workload,
            against=options.against,
            out=options.out,
            progress=voice.progress,
        )
        verdict, comparison, runs = sought.verdict, sought.comparison, sought.runs or {}
        code = live.EXIT_CODES[sought.ended]
        if verdict is None or comparison is None:
            voice.finish(code, sought.ended, sought.path)
            return code
        # Imported here: flights do not need the figures.
        from airl_mav.report.comparison.show import show_comparison

        leave(options, verdict, "airl verdict")
        page = show_comparison(
            comparison, runs, sought.path, voice.console, verdict, voice.progress
        )
        code = verdict.exit_code
        voice.finish(code, sought.ended, sought.path, verdict=verdict, page=page, runs=runs)
    return code
