"""Every policy in every arena: who flies well where it was not trained."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import Field, model_validator

from airl_mav.cli.cells import Cell
from airl_mav.flight.paired import compare_pairs
from airl_mav.profiles.published import load_published
from airl_mav.report.comparison.build import compare
from airl_mav.report.comparison.matrix import matrix_tables, success_map
from airl_mav.report.comparison.model import RunEntry
from airl_mav.report.document import Section
from airl_mav.report.heatmap import heat_picture
from airl_mav.report.measures import with_interval
from airl_mav.report.table import Column, TableView
from airl_mav.studies.findings import Findings
from airl_mav.studies.parts import (
    AGGREGATE,
    findings_of,
    quality_of,
    slug,
)
from airl_mav.studies.study import Flown, Study, StudyConfig


class GeneralisationConfig(StudyConfig):
    """Policies and arenas."""

    policies: tuple[str, ...] = Field(min_length=1, description="names, or paths to folders")
    arenas: tuple[str, ...] = Field(min_length=1, description="arena profiles, the easiest first")

    @model_validator(mode="after")
    def _different(self) -> GeneralisationConfig:
        for field, names in (("policies", self.policies), ("arenas", self.arenas)):
            stems = [_name(name) for name in names]
            if len(set(stems)) < len(stems):
                raise ValueError(f"{field}: one twice; accepted: each once")
        return self


def _name(path: str) -> str:
    return Path(path).name.removesuffix(".toml")


def _key(policy: str, arena: str) -> str:
    return slug(f"{_name(policy)}-in-{_name(arena)}")


def cells(config: GeneralisationConfig, _root: Path) -> list[Cell]:
    """Return every policy in every arena."""
    return [
        Cell(
            _key(policy, arena),
            f"{_name(policy)} in {_name(arena)}",
            config.command(policy, arena),
        )
        for policy in config.policies
        for arena in config.arenas
    ]


def findings(config: GeneralisationConfig, flown: Mapping[str, Flown]) -> Findings:
    """Say who flies well where."""
    held = [flown[_key(p, a)] for p in config.policies for a in config.arenas]
    matrix = compare(
        {each.cell.key: each.run for each in held},
        (),
        kind="matrix",
        entries=[
            RunEntry(
                each.cell.key,
                each.held.folder,
                label=each.held.policy.name,
                group=each.held.arena_name,
                rules=each.held.rules,
                trained_in=_trained_in(each),
            )
            for each in held
        ],
    ).runs
    alt = "Success rate of every policy in every arena"
    return findings_of(
        "generalisation",
        config,
        flown,
        title="Generalisation",
        question="Does a policy fly well in arenas that it was not trained in?",
        answers=_answers(config, flown),
        sections=(
            Section("Policies by arenas", tables=(*matrix_tables(matrix), _paper_table())),
            Section(
                "Success at a glance",
                3,
                draw=lambda: [heat_picture("generalisation", alt, success_map(matrix))],
                in_terminal=False,
            ),
        ),
        data={
            "policies": list(config.policies),
            "arenas": list(config.arenas),
            "cells": [
                {
                    "policy": cell.label,
                    "arena": cell.entry.group,
                    "trained_in": cell.entry.trained_in,
                    "folder": cell.entry.folder,
                    **AGGREGATE.dump_python(cell.quality, mode="json"),
                }
                for cell in matrix
            ],
        },
    )


def _trained_in(flown: Flown) -> str | None:
    card = flown.held.policy.card
    arena = None if card is None else card.training.arena
    return None if arena is None else Path(arena).stem


def _home(flown: Flown) -> bool:
    return _trained_in(flown) == flown.held.arena_name


def _paper_table() -> TableView:
    """Return the paper's table."""
    published = load_published()
    arenas = tuple(published.best_networks)
    columns = (
        Column("trained in", number=False),
        *(Column(arena, "%") for arena in arenas),
    )
    rows = tuple(
        (
            f"{arena} ({published.best_networks[arena].network})",
            *(f"{rates[flown_in]:.0f}" for flown_in in arenas),
        )
        for arena, rates in published.generalisation.items()
    )
    notes = ("Section V.C, success by arena flown in.",)
    return TableView("the-paper", "The paper's generalisation table", columns, rows, notes)


def _answers(config: GeneralisationConfig, flown: Mapping[str, Flown]) -> list[str]:
    """Return for every policy with an arena of its own how it does in easier and harder ones."""
    lines = []
    for policy in config.policies:
        homes = [arena for arena in config.arenas if _home(flown[_key(policy, arena)])]
        if not homes:
            continue
        home = homes[0]
        own = flown[_key(policy, home)]
        place = config.arenas.index(home)
        told = []
        for arenas, word in (
            (config.arenas[:place], "easier"),
            (config.arenas[place + 1 :], "harder"),
        ):
            parts = [f"{_name(a)} {_against(own, flown[_key(policy, a)])}" for a in arenas]
            if parts:
                told.append(f"{word}: {', '.join(parts)}")
        rate = 100.0 * (quality_of(own).success_rate.value or 0.0)
        lines.append(
            f"{_name(policy)}: {rate:.1f} % at home in {_name(home)}; points from there in "
            f"{'; '.join(told)}."
        )
    return lines


def _against(home: Flown, away: Flown) -> str:
    """Return the difference in success from home, on the same seeds."""
    change = compare_pairs(home.run.episodes, away.run.episodes).success_rate
    return with_interval(change.difference, 1, "+")


GENERALISATION_STUDY = Study(
    key="generalisation",
    model=GeneralisationConfig,
    cells=cells,
    findings=findings,
    quick={"episodes": 30},
)
