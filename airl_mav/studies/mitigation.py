"""Training as late as the onboard computer decides: the hardware gap, and flights to one goal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from pydantic import Field
from rich.console import Console

from airl_mav.cli import gap
from airl_mav.cli.cells import Cell
from airl_mav.cli.gap_command import GapCommand
from airl_mav.cli.gap_plan import GapPlan, plan_gap
from airl_mav.core.errors import UsageError
from airl_mav.report.comparison.gap import gap_tables
from airl_mav.report.comparison.model import Comparison, load_comparison
from airl_mav.report.document import Section
from airl_mav.studies.findings import Findings
from airl_mav.studies.parts import fan_data, fan_gallery, fan_table, findings_of
from airl_mav.studies.study import FanConfig, Flown, Study, StudyConfig

GAP_FOLDER = "gap"
"""Where `airl gap` leaves its own pages, inside the study's folder."""


class MitigationConfig(StudyConfig):
    """A policy, and one that was trained as late as the onboard computer decides."""

    policy: str = Field(description="policy without mitigation: a name, or a path to a folder")
    mitigated: str = Field(description="policy with mitigation: a name, or a path to a folder")
    computer: str = Field(default="ras-pi-4", description="onboard computer")
    workload: str = Field(default="template-5x32", description="workload of both computers")
    reference: str = Field(default="workstation", description="computer that is the reference")
    arena: str = Field(default="static-obstacles", description="arena profile")
    fan: FanConfig = Field(description="flights to one goal")

    def gap_command(self, root: Path | None = None) -> GapCommand:
        """Return the `airl gap` of the study."""
        if self.level == "sitl":
            raise UsageError("level = 'sitl': accepted: gym, lockstep")
        return GapCommand(
            policy=self.policy,
            mitigated=self.mitigated,
            computer=self.computer,
            workload=self.workload,
            reference=self.reference,
            arena=(self.arena,),
            episodes=self.episodes,
            seed=self.seed,
            level=self.level,
            vehicle=self.vehicle,
            out=None if root is None else root / GAP_FOLDER,
        )


def prepare(config: MitigationConfig, root: Path, console: Console) -> int:
    """Measure the gap."""
    return gap.run(config.gap_command(root), console)


def cells(config: MitigationConfig, _root: Path) -> list[Cell]:
    """Return the columns of the gap again, each with its flights to one goal."""
    return [
        Cell(
            f"{planned.role}-{number}-one-goal",
            f"{planned.title}, one goal",
            replace(
                planned.cell.command,
                episodes=config.fan.flights,
                arena_seed=config.fan.arena_seed,
            ),
        )
        for number, planned in enumerate(_plan(config).cells, start=1)
    ]


def _plan(config: MitigationConfig) -> GapPlan:
    return plan_gap(config.gap_command())


def findings(config: MitigationConfig, flown: Mapping[str, Flown]) -> Findings:
    """Say what mitigation does to the gap."""
    gap = _gap(flown)
    (arena,) = gap.groups
    fans = [(each.cell.title.removesuffix(", one goal"), each) for each in flown.values()]
    return findings_of(
        "mitigation",
        config,
        flown,
        title="Mitigation of the hardware gap",
        question="Does a policy that was trained as late as the onboard computer decides fly there "
        "as in training?",
        answers=gap.answers,
        sections=(
            Section("Hardware gap", tables=tuple(gap_tables(gap, arena))),
            Section("Flights to one goal", tables=(fan_table("Flights to one goal", fans),)),
            fan_gallery("fan-mitigation", f"{config.fan.flights} flights each", fans),
        ),
        facts=(("the gap by itself", f"{GAP_FOLDER}/gap.html beside this page"),),
        data={"gap": f"{GAP_FOLDER}/gap.json", "one_goal": fan_data(fans)},
    )


def _gap(flown: Mapping[str, Flown]) -> Comparison:
    """Read the gap that was measured before."""
    root = next(iter(flown.values())).run.path.parent
    return load_comparison(root / GAP_FOLDER, "gap")


MITIGATION_STUDY = Study(
    key="mitigation",
    model=MitigationConfig,
    cells=cells,
    findings=findings,
    quick={"episodes": 40, "fan": {"flights": 12}},
    prepare=prepare,
)
