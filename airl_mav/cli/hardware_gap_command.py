"""`airl hardware-gap`: a policy on an onboard computer, with and without mitigation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli.shared_options import OnboardOptions, episodes, fly_and_show
from airl_mav.core.fields import COMMON
from airl_mav.experiments.hardware_gap import (
    DEFAULT_MITIGATED,
    DEFAULT_UNMITIGATED,
    declare_hardware_gap,
)
from airl_mav.scenario.model import DEFAULT_ARENA


class HardwareGapOptions(OnboardOptions):
    """Measure the hardware gap: a policy's loss on an onboard computer, also with mitigation.

    The policy flies on a workstation, with the onboard computer's latency alone, and on the whole
    onboard computer. A policy trained with that latency flies there, in its training conditions,
    and on the workstation. All runs use the same seeds. The tables show gaps of success, flight
    time, distance and energy with 95 % intervals, against both references, and the paper's results.
    The same --out resumes an interrupted run.

    Examples:
        airl hardware-gap
        airl hardware-gap --policy MINE --mitigated none --latency pi.txt
        airl hardware-gap --level lockstep --episodes 500
    """

    policy: Annotated[str, COMMON, "policy"] = Field(
        default=DEFAULT_UNMITIGATED,
        description="policy without mitigation: a name, or a path to a folder with policy.onnx and"
        " card.json",
    )
    mitigated: Annotated[str, COMMON, "policy"] = Field(
        default=DEFAULT_MITIGATED,
        description="policy trained with the computer's latency: a name, or a path; none: only"
        " fly without mitigation",
    )
    arena: Annotated[tuple[str, ...], COMMON, "arena"] = Field(
        default=(DEFAULT_ARENA,),
        min_length=1,
        description="arena profiles: shipped names, or paths; of several, each gets its tables",
    )
    episodes: int = episodes("episodes of each policy on each computer in each arena", 1000)
    out: Annotated[Path | None, COMMON, "output"] = Field(
        default=None,
        description="folder of the comparison: a run folder for each policy on each computer,"
        " hardware-gap.json, .md and .html; by default"
        " runs/<UTC time>-hardware-gap-<policy>-<computer>",
    )


OPTIONS = HardwareGapOptions


def run(options: HardwareGapOptions, console: Console | None = None) -> int:
    """Measure the gap; exit status and errors as in `fly_and_show`."""
    experiment = declare_hardware_gap(
        options.scenario,
        mitigated=options.mitigated,
        reference=options.reference,
        reference_workload=options.reference_workload,
        arenas=options.arena,
    )
    code, _ = fly_and_show(experiment, options.out, console, options, options)
    return code
