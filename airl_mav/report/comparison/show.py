"""Building, writing and printing of comparisons of every kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from airl_mav.core.errors import UsageError
from airl_mav.core.progress import DRAWING, Progress
from airl_mav.flight.requirements import Requirement, find, settle
from airl_mav.flight.statistics import reached_goals
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report.comparison import (
    comparison_model,
    degradation_page,
    gap_page,
    ladder_page,
    matrix_page,
    runs,
)
from airl_mav.report.document import Document, print_document, print_place, write_document
from airl_mav.report.run_verdict import (
    OverallVerdict,
    invalid_flights,
    join_verdicts,
    judge_run,
    requirements_of,
    save_verdict,
    unchecked,
)

Runs = Mapping[str, LoadedRun]

FLOWN_UNTIL = "flown_until"
"""Fact of a comparison with a sequential test, which stops once the success rate is decided. The
same test judges the rate."""

_BUILD: dict[
    comparison_model.Kind,
    Callable[
        [Mapping[str, Any], Sequence[comparison_model.RunEntry], Runs], comparison_model.Comparison
    ],
] = {
    "compare": runs.build_runs,
    "gap": gap_page.build_gap,
    "ladder": ladder_page.build_ladder,
    "matrix": matrix_page.build_matrix,
    "degradation": degradation_page.build_degradation,
}

_DOCUMENT: dict[
    comparison_model.Kind, Callable[[comparison_model.Comparison, Runs, Path], Document]
] = {
    "compare": runs.document_of,
    "gap": gap_page.document_of,
    "ladder": ladder_page.document_of,
    "matrix": matrix_page.document_of,
    "degradation": degradation_page.document_of,
}


def build_comparison(
    folder: Path,
    kind: comparison_model.Kind,
    facts: Mapping[str, Any],
    entries: Sequence[comparison_model.RunEntry],
) -> tuple[comparison_model.Comparison, dict[str, LoadedRun]]:
    """Read the runs of a folder and compare them; the kind's module documents its facts."""
    loaded = {entry.name: load(folder / entry.folder) for entry in entries}
    return _BUILD[kind](facts, entries, loaded), loaded


def rebuild_comparison(folder: Path) -> tuple[comparison_model.Comparison, dict[str, LoadedRun]]:
    """Recompute the comparison of a folder from its runs. Raises UsageError."""
    kind = comparison_model.kind_of(folder)
    if kind is None:
        accepted = ", ".join(comparison_model.KIND_NAMES.values())
        raise UsageError(f"{folder}: no comparison here; accepted: the folder of a {accepted}")
    return build_comparison(folder, kind, *comparison_model.load_entries(folder, kind))


def judge_comparison(
    comparison: comparison_model.Comparison, loaded: Runs, requirements: Sequence[Requirement] = ()
) -> OverallVerdict:
    """Return the verdict of a comparison; raise FieldError for a required gap without a reference.

    The verdict on a hardware gap judges the run to deploy: the mitigated policy on the onboard
    computer if flown, otherwise the policy. Other comparisons judge every run.
    """
    against = {c.entry.target: c for c in reversed(comparison.contrasts)}
    if not against and (gaps := [each for each in requirements if each.gap]):
        find(gaps[0], comparison.runs[0].quality, None)
    parts = []
    for run in _judged(comparison):
        contrast = against.get(run.name)
        reference = "" if contrast is None else comparison.run(contrast.entry.reference).label
        episodes = loaded[run.name].episodes
        part = judge_run(
            run.setup,
            run.quality,
            episodes,
            [each for each in requirements if contrast is not None or not each.gap],
            None if contrast is None else contrast.paired,
            reference,
        )
        if FLOWN_UNTIL in comparison.facts:
            reached = reached_goals(episodes)
            part = replace(part, findings=tuple(settle(each, reached) for each in part.findings))
        parts.append(part)
    verdict = join_verdicts(parts, f"{len(parts)} runs")
    # All compared runs must be valid, not only the judged runs.
    invalid = {name: invalid_flights(run.episodes) for name, run in loaded.items()}
    lines = tuple(f"{name}, {line}" for name, flights in invalid.items() for line in flights)
    sentences = comparison.answers or verdict.sentences
    sentences += unchecked([run.info for run in loaded.values()])
    return replace(verdict, sentences=sentences, invalid=lines)


def _judged(comparison: comparison_model.Comparison) -> tuple[comparison_model.ComparedRun, ...]:
    if comparison.kind != "gap":
        return comparison.runs
    judged = []
    for group in comparison.groups:
        roles = {run.entry.role: run for run in comparison.group(group)}
        deployed = roles.get("mitigated") or roles.get("target")
        judged += [] if deployed is None else [deployed]
    return tuple(judged)


def write_comparison(
    comparison: comparison_model.Comparison,
    loaded: Runs,
    folder: Path,
    verdict: OverallVerdict | None = None,
) -> Path:
    """Write `<kind>.json`, `verdict.json`, `.html`, `.md` and PNG files; return the page's path."""
    return write_document(_saved(comparison, loaded, folder, verdict), folder)


def _saved(
    comparison: comparison_model.Comparison,
    loaded: Runs,
    folder: Path,
    verdict: OverallVerdict | None,
) -> Document:
    """Write the data and the verdict of a comparison; return its document."""
    verdict = verdict or judge_comparison(comparison, loaded, requirements_of(folder))
    try:
        comparison_model.save_comparison(comparison, folder)
        save_verdict(verdict, folder)
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}") from None
    return comparison_to_document(comparison, loaded, folder, verdict)


def comparison_to_document(
    comparison: comparison_model.Comparison, loaded: Runs, folder: Path, verdict: OverallVerdict
) -> Document:
    """Return the document of a comparison without drawing its pictures."""
    document = _DOCUMENT[comparison.kind](comparison, loaded, folder)
    return replace(document, answers=verdict.lines, status=verdict.status)


def show_comparison(
    comparison: comparison_model.Comparison,
    loaded: Runs,
    folder: Path,
    console: Console,
    verdict: OverallVerdict | None = None,
    progress: Progress | None = None,
) -> Path:
    """Print a comparison, write its files as `write_comparison`, and print the page's path."""
    progress = progress or Progress()
    document = _saved(comparison, loaded, folder, verdict)
    print_document(document, console)
    progress.status(DRAWING)
    page = write_document(document, folder)
    progress.status(None)
    print_place(document.name, page, console)
    return page
