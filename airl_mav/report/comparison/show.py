"""Work a comparison out, write its files, print it: the same for every kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from airl_mav.core.errors import UsageError
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.comparison import degradation, gap, ladder, matrix, runs
from airl_mav.report.comparison.build import from_recipe, load_runs
from airl_mav.report.comparison.model import (
    KIND_NAMES,
    Comparison,
    ComparisonRecipe,
    Kind,
    kind_of,
    load_recipe,
    save_comparison,
)
from airl_mav.report.document import Document, print_document, write_document

Runs = Mapping[str, LoadedRun]


@dataclass(frozen=True)
class _Presentation:
    """How a kind of comparison is worked out and shown."""

    build: Callable[[ComparisonRecipe, Runs], Comparison]
    document: Callable[[Comparison, Runs, Path], Document]


_PRESENTATIONS: dict[Kind, _Presentation] = {
    "compare": _Presentation(
        lambda recipe, loaded: from_recipe("compare", recipe, loaded), runs.document_of
    ),
    "gap": _Presentation(gap.build_gap, gap.document_of),
    "ladder": _Presentation(ladder.build_ladder, ladder.document_of),
    "matrix": _Presentation(matrix.build_matrix, matrix.document_of),
    "degradation": _Presentation(degradation.build_degradation, degradation.document_of),
}


def build_comparison(
    folder: Path, kind: Kind, recipe: ComparisonRecipe
) -> tuple[Comparison, dict[str, LoadedRun]]:
    """Read the runs of a recipe and work the comparison out.

    Args:
        folder: Of the comparison: the runs lie in it.
        kind: Which comparison.
        recipe: Its runs and contrasts; `gap_recipe`, `ladder_recipe`, `matrix_recipe` and
            `degradation_recipe` make one.

    Returns:
        The comparison, and its runs by name.

    Raises:
        UsageError: A run cannot be read, or holds no flight.
    """
    loaded = load_runs(folder, recipe.entries)
    return _PRESENTATIONS[kind].build(recipe, loaded), loaded


def rebuild_comparison(folder: Path) -> tuple[Comparison, dict[str, LoadedRun]]:
    """Work the comparison of a folder out again from its runs. Raises UsageError."""
    kind = kind_of(folder)
    if kind is None:
        accepted = ", ".join(KIND_NAMES.values())
        raise UsageError(f"{folder}: no comparison here; accepted: the folder of a {accepted}")
    return build_comparison(folder, kind, load_recipe(folder, kind))


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
    return _PRESENTATIONS[comparison.kind].document(comparison, loaded, folder)


def print_comparison(comparison: Comparison, loaded: Runs, console: Console, page: Path) -> None:
    """Print the tables, the verdict and where the page lies."""
    print_document(comparison_to_document(comparison, loaded, page.parent), console, page)


def show_comparison(comparison: Comparison, loaded: Runs, folder: Path, console: Console) -> Path:
    """Write a comparison's files and print it; return the path of the page."""
    page = write_comparison(comparison, loaded, folder)
    print_comparison(comparison, loaded, console, page)
    return page
