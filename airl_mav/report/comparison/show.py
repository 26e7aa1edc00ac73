"""Work a comparison out, write its files, print it: the same for every kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from airl_mav.core.errors import UsageError
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.comparison import degradation, gap, ladder, matrix, runs
from airl_mav.report.comparison.build import load_runs
from airl_mav.report.comparison.model import (
    KIND_NAMES,
    Comparison,
    Kind,
    RunEntry,
    kind_of,
    load_entries,
    save_comparison,
)
from airl_mav.report.document import Document, print_document, write_document

Runs = Mapping[str, LoadedRun]

_BUILD: dict[Kind, Callable[[Mapping[str, Any], Sequence[RunEntry], Runs], Comparison]] = {
    "compare": runs.build_runs,
    "gap": gap.build_gap,
    "ladder": ladder.build_ladder,
    "matrix": matrix.build_matrix,
    "degradation": degradation.build_degradation,
}

_DOCUMENT: dict[Kind, Callable[[Comparison, Runs, Path], Document]] = {
    "compare": runs.document_of,
    "gap": gap.document_of,
    "ladder": ladder.document_of,
    "matrix": matrix.document_of,
    "degradation": degradation.document_of,
}


def build_comparison(
    folder: Path, kind: Kind, facts: Mapping[str, Any], entries: Sequence[RunEntry]
) -> tuple[Comparison, dict[str, LoadedRun]]:
    """Read runs and compare them as a kind of comparison does.

    Args:
        folder: Of the comparison: the runs lie in it.
        kind: Which comparison; its module says what it asks of facts and entries.
        facts: What was asked for, and all runs share.
        entries: The runs, in the order of the tables.

    Returns:
        The comparison, and its runs by name.

    Raises:
        UsageError: There is no run, one cannot be read, or holds no flight.
    """
    loaded = load_runs(folder, entries)
    return _BUILD[kind](facts, entries, loaded), loaded


def rebuild_comparison(folder: Path) -> tuple[Comparison, dict[str, LoadedRun]]:
    """Work the comparison of a folder out again from its runs. Raises UsageError."""
    kind = kind_of(folder)
    if kind is None:
        accepted = ", ".join(KIND_NAMES.values())
        raise UsageError(f"{folder}: no comparison here; accepted: the folder of a {accepted}")
    return build_comparison(folder, kind, *load_entries(folder, kind))


def write_comparison(comparison: Comparison, loaded: Runs, folder: Path) -> Path:
    """Write `<kind>.json`, `.html`, `.md` and the PNG files, each whole or not at all.

    Args:
        comparison: What is written.
        loaded: Its runs by name, for the pictures.
        folder: Where to.

    Returns:
        The path of the page.

    Raises:
        UsageError: The folder cannot be written.
    """
    try:
        save_comparison(comparison, folder)
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}") from None
    return write_document(comparison_to_document(comparison, loaded, folder), folder)


def comparison_to_document(comparison: Comparison, loaded: Runs, folder: Path) -> Document:
    """Return everything that a comparison says; nothing is drawn yet."""
    return _DOCUMENT[comparison.kind](comparison, loaded, folder)


def print_comparison(comparison: Comparison, loaded: Runs, console: Console, page: Path) -> None:
    """Print the tables, the verdict and where the page lies."""
    print_document(comparison_to_document(comparison, loaded, page.parent), console, page)


def show_comparison(comparison: Comparison, loaded: Runs, folder: Path, console: Console) -> Path:
    """Write a comparison's files and print it; return the path of the page."""
    page = write_comparison(comparison, loaded, folder)
    print_comparison(comparison, loaded, console, page)
    return page
