"""Every policy in every arena: who flies well where it was not trained."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator

from airl_mav.cli.cells import Cell
from airl_mav.flight.paired import compare
from airl_mav.flight.paper import ARENAS, BEST_OF_SWEEP, GENERALISATION
from airl_mav.report.grid import grid_picture
from airl_mav.report.matrix import Cell as MatrixCell
from airl_mav.report.matrix import matrix_tables
from airl_mav.report.tables import Column, TableView
from airl_mav.studies.parts import (
    AGGREGATE,
    facts_of,
    made_of,
    quality_of,
    runs_of,
    slug,
    with_range,
)
from airl_mav.studies.sheet import Gallery, Section, Sheet
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


def sheet(config: GeneralisationConfig, flown: Mapping[str, Flown]) -> Sheet:
    """Say who flies well where."""
    matrix = [_matrix_cell(flown[_key(p, a)]) for p in config.policies for a in config.arenas]
    rates = np.array(
        [
            [quality_of(flown[_key(p, a)]).success_rate.value or 0.0 for a in config.arenas]
            for p in config.policies
        ]
    )
    rows = [_name(policy) for policy in config.policies]
    picture = grid_picture(
        "generalisation",
        "success [%]; a star: trained there",
        rows,
        [_name(arena) for arena in config.arenas],
        100.0 * rates,
        [
            [
                f"{100.0 * rates[r, c]:.1f}{'*' if _home(flown[_key(p, a)]) else ''}"
                for c, a in enumerate(config.arenas)
            ]
            for r, p in enumerate(config.policies)
        ],
        (0.0, 100.0),
    )
    return Sheet(
        key="generalisation",
        title="Generalisation",
        question="Does a policy fly well in arenas that it was not trained in?",
        answers=tuple(_in_words(config, flown)),
        sections=(
            Section(
                "Policies by arenas",
                (*matrix_tables(matrix), _paper_table()),
                (Gallery("Success at a glance", (picture,)),),
            ),
        ),
        facts=facts_of(config, flown),
        runs=runs_of(flown),
        data={
            "policies": list(config.policies),
            "arenas": list(config.arenas),
            "cells": [
                {
                    "policy": cell.policy,
                    "arena": cell.arena,
                    "trained_in": cell.trained_in,
                    "folder": cell.folder,
                    **AGGREGATE.dump_python(cell.quality, mode="json"),
                }
                for cell in matrix
            ],
        },
        provenance=made_of(flown),
    )


def _matrix_cell(flown: Flown) -> MatrixCell:
    return MatrixCell(
        policy=flown.held.policy.name,
        arena=flown.held.arena_name,
        folder=flown.held.folder,
        trained_in=_trained_in(flown),
        rules=flown.held.rules,
        quality=quality_of(flown),
    )


def _trained_in(flown: Flown) -> str | None:
    card = flown.held.policy.card
    arena = None if card is None else card.training.arena
    return None if arena is None else Path(arena).stem


def _home(flown: Flown) -> bool:
    return _trained_in(flown) == flown.held.arena_name


def _paper_table() -> TableView:
    """Return the paper's table."""
    columns = (
        Column("trained in", number=False),
        *(Column(arena, "%") for arena in ARENAS),
    )
    rows = tuple(
        (
            f"{arena} ({BEST_OF_SWEEP[arena][0]})",
            *(f"{rates[flown_in]:.0f}" for flown_in in ARENAS),
        )
        for arena, rates in GENERALISATION.items()
    )
    notes = ("Section V.C, success by arena flown in.",)
    return TableView("the-paper", "The paper's generalisation table", columns, rows, notes)


def _in_words(config: GeneralisationConfig, flown: Mapping[str, Flown]) -> list[str]:
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
    change = compare(home.run.episodes, away.run.episodes).success_rate
    return with_range(change.difference, 1.0, 1, "+")


GENERALISATION_STUDY = Study(
    key="generalisation",
    model=GeneralisationConfig,
    cells=cells,
    sheet=sheet,
    quick={"episodes": 30},
)
