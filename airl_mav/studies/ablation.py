"""Policies without one of their senses, in the body layout and in the paper's own."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Literal, get_args

from pydantic import Field, model_validator
from rich.console import Console

from airl_mav.cli import train
from airl_mav.cli.cells import Cell
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.flight.statistics import Aggregate
from airl_mav.profiles.published import load_published
from airl_mav.report.bars import Bar, Group, bars_picture
from airl_mav.report.document import Section
from airl_mav.report.table import NONE, Column, TableView
from airl_mav.studies.findings import Findings
from airl_mav.studies.parts import (
    AGGREGATE,
    findings_of,
    quality_of,
    rate,
    slug,
)
from airl_mav.studies.study import Flown, Study, StudyConfig

Sense = Literal["none", "velocity", "goal", "depth"]
SENSES: tuple[Sense, ...] = get_args(Sense)
"""What is made zero; the paper's words for the goal: position."""

SENSE_LABELS: dict[Sense, str] = {
    "none": "all senses",
    "velocity": "no velocity",
    "goal": "no goal",
    "depth": "no depth",
}


class PolicyConfig(ProfileModel):
    """A policy in one arena."""

    layout: Literal["body", "paper"] = Field(description="what it sees")
    arena: str = Field(description="arena profile")
    policy: str | None = Field(
        default=None, description="a name, or a path to a folder; left out: trained first"
    )
    training: str | None = Field(
        default=None, description="training configuration that makes it, where there is no policy"
    )
    steps: int | None = quantity(
        "decisions to train; left out: as the configuration says", "1", ge=1, default=None
    )

    @model_validator(mode="after")
    def _one_of_both(self) -> PolicyConfig:
        if (self.policy is None) == (self.training is None):
            raise ValueError("policy, training: accepted: one of them")
        return self

    @property
    def name(self) -> str:
        """Name of the arena without its path."""
        return Path(self.arena).stem

    def trained_at(self, root: Path) -> Path:
        """Return the folder of its training run, inside the study's."""
        return root / slug(f"train-{self.layout}-{self.name}")

    def found(self, root: Path) -> str:
        """Return the policy's name or path."""
        return self.policy or str(self.trained_at(root) / "policy")


class AblationConfig(StudyConfig):
    """Policies, each flown with all senses and without each."""

    policies: tuple[PolicyConfig, ...] = Field(min_length=1, description="what flies where")

    @model_validator(mode="after")
    def _different(self) -> AblationConfig:
        keys = [(each.layout, each.name) for each in self.policies]
        if len(set(keys)) < len(keys):
            raise ValueError("policies: a layout twice in one arena; accepted: each once")
        return self


def prepare(config: AblationConfig, root: Path, console: Console) -> int:
    """Train what is not there; a training that was killed goes on."""
    for each in config.policies:
        folder = each.trained_at(root)
        if each.training is None or (folder / "policy" / "card.json").exists():
            continue
        command = train.TrainOptions(
            config=each.training, out=folder, steps=each.steps, name=folder.name, resume=True
        )
        words = ["airl", "train", each.training, "--out", f"{folder}", "--name", folder.name]
        words += [] if each.steps is None else ["--steps", f"{each.steps}"]
        if code := train.run(command, console, command_line=shlex.join(words)):
            return code
    return 0


def _key(each: PolicyConfig, sense: Sense) -> str:
    return slug(f"{each.layout}-{each.name}-{sense}")


def cells(config: AblationConfig, root: Path) -> list[Cell]:
    """Return every policy with all senses and without each."""
    return [
        Cell(
            _key(each, sense),
            f"{each.layout} layout in {each.name}, {SENSE_LABELS[sense]}",
            config.command(each.found(root), each.arena, ablate=None if sense == "none" else sense),
        )
        for each in config.policies
        for sense in SENSES
    ]


def findings(config: AblationConfig, flown: Mapping[str, Flown]) -> Findings:
    """Say which sense matters."""
    layouts = list(dict.fromkeys(each.layout for each in config.policies))
    return findings_of(
        "ablation",
        config,
        flown,
        title="Sensor ablation",
        question="Which of its senses does a policy need? One input is made zero, without training "
        "again.",
        answers=[_answer(each, flown) for each in config.policies],
        sections=[section for layout in layouts for section in _sections(config, layout, flown)],
        data={
            "policies": [
                {
                    "layout": each.layout,
                    "arena": each.arena,
                    "policy": flown[_key(each, "none")].held.policy.name,
                    "policy_sha256": flown[_key(each, "none")].held.policy.sha256,
                    "training": each.training,
                    **{
                        sense: AGGREGATE.dump_python(_quality(each, sense, flown), mode="json")
                        for sense in SENSES
                    },
                }
                for each in config.policies
            ]
        },
    )


def _quality(each: PolicyConfig, sense: Sense, flown: Mapping[str, Flown]) -> Aggregate:
    return quality_of(flown[_key(each, sense)])


def _sections(
    config: AblationConfig, layout: str, flown: Mapping[str, Flown]
) -> tuple[Section, ...]:
    """Return a layout's tables and bars."""
    held = [each for each in config.policies if each.layout == layout]
    columns = (
        Column("arena", number=False),
        Column("policy", number=False),
        *(Column(SENSE_LABELS[sense], "%") for sense in SENSES),
    )
    rows: list[tuple[str, ...]] = []
    for each in held:
        rows.append(
            (
                each.name,
                flown[_key(each, "none")].held.policy.name,
                *(rate(_quality(each, sense, flown).success_rate) for sense in SENSES),
            )
        )
        if any(_paper(each.name, sense) is not None for sense in SENSES):
            told = (_paper(each.name, sense) for sense in SENSES)
            rows.append(("", "the paper", *(NONE if p is None else f"{p:.0f}" for p in told)))
    notes = (
        "Success of all flights, 95 % intervals in brackets. The paper: section V.D; for Static "
        "Obstacles it has one figure for velocity and position, for Dynamic Obstacles depth alone.",
    )
    title = f"Layout {layout}"
    draw = partial(
        bars_picture,
        f"ablation-{layout}",
        f"success, layout {layout}",
        [SENSE_LABELS[sense] for sense in SENSES],
        [
            Group(
                each.name,
                [
                    Bar(_quality(each, sense, flown).success_rate, _paper(each.name, sense))
                    for sense in SENSES
                ],
            )
            for each in held
        ],
    )
    times = TableView(
        f"times-{layout}",
        f"Layout {layout}: flight time of those that reach the goal",
        (Column("arena", number=False), *(Column(SENSE_LABELS[s], "s") for s in SENSES)),
        tuple((each.name, *(_time(_quality(each, s, flown)) for s in SENSES)) for each in held),
    )
    success = TableView(f"success-{layout}", title, columns, tuple(rows), notes)
    return (
        Section(title, tables=(success, times)),
        Section("Success by sense", 3, draw=lambda: [draw()], in_terminal=False),
    )


def _time(quality: Aggregate) -> str:
    time = quality.flight_time_s
    return NONE if time.value is None else f"{time.value:.2f} (n = {time.n:,})"


def _paper(arena: str, sense: Sense) -> float | None:
    return load_published().ablation.get(arena, {}).get(sense)


def _answer(each: PolicyConfig, flown: Mapping[str, Flown]) -> str:
    """Return the senses of a policy by what their loss costs."""
    rates = {
        sense: 100.0 * (_quality(each, sense, flown).success_rate.value or 0.0) for sense in SENSES
    }
    lost = sorted(SENSES[1:], key=lambda sense: rates[sense])
    told = ", ".join(f"{SENSE_LABELS[sense]} {rates[sense]:.1f} %" for sense in lost)
    return f"Layout {each.layout}, {each.name}: {rates['none']:.1f} % with all; {told}."


ABLATION_STUDY = Study(
    key="ablation",
    model=AblationConfig,
    cells=cells,
    findings=findings,
    quick={
        "episodes": 40,
        "policies": [
            {"layout": "body", "arena": "static-obstacles", "policy": "static-obstacles"},
            {
                "layout": "paper",
                "arena": "static-obstacles",
                "training": "paper-layout",
                "steps": 30_000,
            },
        ],
    },
    prepare=prepare,
)
