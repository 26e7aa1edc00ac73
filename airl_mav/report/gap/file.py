"""The file of a hardware gap: written for other programs, read to work the gap out again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from airl_mav.core.files import read_typed, write_json
from airl_mav.flight.gap import HardwareGap
from airl_mav.flight.paper import PaperFigures, PrintedGaps
from airl_mav.flight.statistics import Aggregate, Estimate
from airl_mav.report.gap.build import Flown, Gap, GapStudy, HeldArena, build_gap

SCHEMA = 1
"""Version of `gap.json`; docs/run-folder.md describes it."""

GAP_FILE = "gap.json"


@dataclass(frozen=True)
class _HeldStudy:
    """What `gap.json` is read for: everything else of it is worked out from the runs."""

    facts: dict[str, Any]
    arenas: tuple[HeldArena, ...]


_HELD = TypeAdapter(_HeldStudy)
_AGGREGATE = TypeAdapter(Aggregate)
_ESTIMATE = TypeAdapter(Estimate)
_GAP = TypeAdapter(HardwareGap)
_PAPER_FIGURES = TypeAdapter(PaperFigures | None)
_PAPER_GAPS = TypeAdapter(PrintedGaps | None)


def write_gap(study: GapStudy, answers: Sequence[str]) -> None:
    """Write `gap.json`, whole or not at all.

    Args:
        study: What was flown.
        answers: What it says in words, one sentence an arena.
    """
    data = {
        "schema": SCHEMA,
        "facts": study.facts,
        "answers": list(answers),
        "arenas": [
            {
                "arena": arena.arena,
                "paper_table": arena.paper_table,
                "columns": [_column_data(column) for column in arena.columns],
                "gaps": [_gap_data(gap) for gap in arena.gaps],
                "worst_seeds": list(arena.worst),
            }
            for arena in study.arenas
        ],
    }
    write_json(study.path / GAP_FILE, data)


def _column_data(column: Flown) -> dict[str, Any]:
    setup, t2 = column.setup, column.t2
    return {
        "letter": column.letter,
        "role": column.held.role,
        "title": column.held.title,
        "folder": column.held.folder,
        "planned": column.held.planned,
        "flown": len(column.episodes),
        "rules": column.held.rules,
        "policy": setup.policy.name,
        "computer": setup.computer.name,
        "computer_watts": setup.computer_watts,
        "latency": {"origin": setup.injection.origin, "label": setup.injection.label},
        "t2": {
            "n": t2.n,
            "mean_us": t2.mean,
            "p50_us": t2.p50,
            "p90_us": t2.p90,
            "p99_us": t2.p99,
            "max_us": t2.max,
        },
        **_AGGREGATE.dump_python(column.quality, mode="json"),
        "total_energy_j": _ESTIMATE.dump_python(column.total_energy_j, mode="json"),
        "paper": _PAPER_FIGURES.dump_python(column.paper, mode="json"),
    }


def _gap_data(gap: Gap) -> dict[str, Any]:
    return {
        "key": gap.key,
        "title": gap.title,
        "target": gap.target.letter,
        "reference": gap.reference.letter,
        "t2_percent": gap.t2_percent,
        **_GAP.dump_python(gap.gap, mode="json"),
        "paper": _PAPER_GAPS.dump_python(gap.paper, mode="json"),
    }


def read_gap(path: Path) -> GapStudy:
    """Work out the gaps again from their folder.

    Raises:
        UsageError: The folder holds none, or its runs cannot be read.
    """
    held = read_typed(path / GAP_FILE, _HELD, SCHEMA, "hardware gap")
    return build_gap(path, held.facts, held.arenas)
