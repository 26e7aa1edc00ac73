"""Evaluation of several policies in several arenas, including arenas not used in training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.comparison.build import compare, comparison_document
from airl_mav.report.comparison.comparison_model import ComparedRun, Comparison, RunEntry
from airl_mav.report.comparison.tables import plain_facts
from airl_mav.report.document import Document, Section
from airl_mav.report.heatmap import Field, HeatMap, heat_picture
from airl_mav.report.measures import MEASURES, SUCCESS_RATE, QualityMeasure
from airl_mav.report.table import NONE, Column, TableView


def build_matrix(
    facts: Mapping[str, Any], entries: Sequence[RunEntry], runs: Mapping[str, LoadedRun]
) -> Comparison:
    """Compare policies (`label`) across arenas (`group`); see `show.build_comparison`."""
    title = "Policies by arenas"
    return compare(runs, (), kind="matrix", title=title, facts=facts, entries=entries)


def matrix_tables(runs: Sequence[ComparedRun]) -> list[TableView]:
    """Return a table per measure with policies in rows and arenas in columns."""
    policies = list(dict.fromkeys(run.label for run in runs))
    arenas = list(dict.fromkeys(run.entry.group for run in runs))
    at = {(run.label, run.entry.group): run for run in runs}
    views = []
    for measure in MEASURES:
        columns = (
            Column("policy", number=False),
            *(Column(arena, measure.unit) for arena in arenas),
        )
        rows = tuple(
            (policy, *(_cell(at.get((policy, arena)), measure) for arena in arenas))
            for policy in policies
        )
        title = measure.title.capitalize()
        views.append(TableView(measure.key, title, columns, rows, _notes(runs, measure)))
    return views


def _cell(run: ComparedRun | None, measure: QualityMeasure) -> str:
    if run is None:
        return NONE
    text = measure.with_interval(run.quality)
    return f"{text} *" if text != NONE and trained_here(run) else text


def trained_here(run: ComparedRun) -> bool:
    """Return True if a policy was trained in the arena of its run."""
    return run.entry.group == run.entry.trained_in


def _notes(runs: Sequence[ComparedRun], measure: QualityMeasure) -> tuple[str, ...]:
    if measure is not SUCCESS_RATE:
        return ("Means over the flights that reached the goal, 95 % bootstrap intervals.",)
    notes = ["Of all flights; 95 % intervals after Wilson. The same seeds in every cell."]
    if any(trained_here(run) for run in runs):
        notes.append("* the arena that the policy was trained in")
    rules = list(dict.fromkeys(run.entry.rules for run in runs))
    start = "Rules" if len(rules) == 1 else "Not all by the same rules"
    return (*notes, f"{start}: {'; '.join(rules)}.")


def success_map(runs: Sequence[ComparedRun]) -> HeatMap:
    """Return the success rates as a heat map with the first policy at the top."""
    policies = list(dict.fromkeys(run.label for run in runs))[::-1]
    return HeatMap(
        title="success; a star: trained there",
        rows=policies,
        row_title="",
        columns=list(dict.fromkeys(run.entry.group for run in runs)),
        column_title="",
        fields={
            (run.label, run.entry.group): Field(
                100.0 * rate, f"{100.0 * rate:.1f}{'*' if trained_here(run) else ''}"
            )
            for run in runs
            if (rate := run.quality.success_rate.value) is not None
        },
        unit="success [%]",
        limits=(0.0, 100.0),
    )


def document_of(comparison: Comparison, runs: Mapping[str, LoadedRun], folder: Path) -> Document:
    """Return the document of a table of policies x arenas."""
    alt = "Success rate of every policy in every arena"
    return comparison_document(
        comparison,
        runs,
        folder,
        kicker="Evaluation",
        sections=[
            *(Section(view.title, tables=(view,)) for view in matrix_tables(comparison.runs)),
            Section(
                "Success at a glance",
                draw=lambda: [heat_picture("matrix", alt, success_map(comparison.runs))],
                in_terminal=False,
            ),
        ],
        facts=plain_facts(comparison),
    )
