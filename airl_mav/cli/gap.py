"""`airl gap`: what a policy loses on an onboard computer, without mitigation and with it."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field
from rich.console import Console

from airl_mav.cli.experiments import fly_and_show
from airl_mav.cli.gate import Gate
from airl_mav.cli.options import scenario_of
from airl_mav.core.fields import quantity
from airl_mav.experiments.gap import (
    DEFAULT_COMPUTER,
    DEFAULT_MITIGATED,
    DEFAULT_REFERENCE,
    declare_gap,
)
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.scenario.model import (
    DEFAULT_ARENA,
    DEFAULT_POLICY,
    Decisions,
    Flights,
    Lateness,
    LevelName,
)


class GapOptions(Gate, Flights, Lateness, Decisions, Aircraft):
    """Measure the hardware gap: what a policy loses on an onboard computer, and with mitigation.

    The policy on a workstation and on the onboard computer; a policy that was trained as late as
    that computer decides, there, in the conditions of its training, and on the workstation. Always
    the same seeds: gaps of success, flight time, distance and energy with 95 % intervals, against
    both references, beside those of the paper. The same --out goes on with what was interrupted.

    Examples:
        airl gap
        airl gap --policy MINE --mitigated none --latency pi.txt
        airl gap --level lockstep --episodes 500
    """

    policy: str = Field(
        default=DEFAULT_POLICY,
        description="policy without mitigation: a name, or a path to a folder with policy.onnx and"
        " card.json",
    )
    mitigated: str = Field(
        default=DEFAULT_MITIGATED,
        description="policy that was trained as late as the computer decides: a name, or a path;"
        " none: fly the gap without mitigation only",
    )
    computer: str = Field(
        default=DEFAULT_COMPUTER,
        description="onboard computer: a shipped profile, or a path to a .toml",
    )
    reference: str = Field(
        default=DEFAULT_REFERENCE,
        description="computer that the gap is measured from: a shipped profile, or a path",
    )
    reference_workload: str | None = Field(
        default=None,
        description="workload of the reference; by default the target's if the reference has it,"
        " otherwise what was measured there for the very policy, or else 1 ms (gym, lockstep), or"
        " what this machine takes (sitl)",
    )
    arena: tuple[str, ...] = Field(
        default=(DEFAULT_ARENA,),
        min_length=1,
        description="arena profiles: shipped names, or paths; of several, each gets its tables",
    )
    level: LevelName = Field(default="gym", description=Flights.model_fields["level"].description)
    episodes: int = quantity(
        "episodes of each policy on each computer in each arena",
        "1",
        ge=1,
        le=100_000,
        default=1000,
    )
    out: Path | None = Field(
        default=None,
        description="folder of the gap: a run folder for each policy on each computer, gap.json,"
        " gap.md and gap.html; by default runs/<UTC time>-gap-<policy>-<computer>",
    )


OPTIONS = GapOptions


def run(options: GapOptions, console: Console | None = None) -> int:
    """Measure the gap; exit status and errors as of `fly_and_show`."""
    experiment = declare_gap(
        scenario_of(options),
        mitigated=options.mitigated,
        reference=options.reference,
        reference_workload=options.reference_workload,
        arenas=options.arena,
    )
    code, _ = fly_and_show(experiment, options.out, console or Console(), options)
    return code
