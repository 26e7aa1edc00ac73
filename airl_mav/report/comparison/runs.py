"""Comparison of any runs with the first as the reference: `airl report RUN RUN`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from airl_mav.core.errors import UsageError
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report.comparison import figures, tables
from airl_mav.report.comparison.build import compare, comparison_document
from airl_mav.report.comparison.comparison_model import Comparison, RunEntry, kind_of, load_entries
from airl_mav.report.document import Document, Section
from airl_mav.report.flights_above import flight_pictures

NAMING = ("policy", "arena", "computer", "level", "vehicle")
"""Parts of a setup used to distinguish runs."""

LONGEST_NAME = 48
"""Maximum length of a name derived from differences; longer names are replaced by folders."""


def compare_folders(
    paths: Sequence[Path], names: Sequence[str] = ()
) -> tuple[Comparison, dict[str, LoadedRun]]:
    """Read runs and compare all others with the first.

    Args:
        paths: Run folders; the folder of a comparison selects its runs.
        names: Names of the runs in the same order; empty = derived from setups or folders.

    Raises:
        UsageError: A folder is no run or has no flights; fewer than two runs; a duplicate run;
            invalid names.
    """
    folders = [folder for path in paths for folder in run_folders(path)]
    if len(folders) < 2:
        raise UsageError(f"{len(folders)} run: accepted: two or more to compare")
    resolved = [folder.resolve() for folder in folders]
    if twice := [f for f, r in zip(folders, resolved, strict=True) if resolved.count(r) > 1]:
        raise UsageError(f"{twice[0]}: twice; accepted: each run once")
    loaded = [load(folder) for folder in folders]
    runs = dict(zip(_checked(names, loaded), loaded, strict=True))
    entries = [RunEntry(name, str(run.path.resolve())) for name, run in runs.items()]
    return build_runs({}, entries, runs), runs


def build_runs(
    facts: Mapping[str, Any], entries: Sequence[RunEntry], runs: Mapping[str, LoadedRun]
) -> Comparison:
    """Compare all other runs with the first; see `show.build_comparison`."""
    return compare(runs, title=f"{len(runs)} runs compared", facts=facts, entries=entries)


def run_folders(path: Path) -> list[Path]:
    """Return the run folders for a path: the folder itself, or its comparison's run folders."""
    kind = kind_of(path)
    if kind is None:
        return [path]
    return [path / entry.folder for entry in load_entries(path, kind)[1]]


def document_of(comparison: Comparison, runs: Mapping[str, LoadedRun], folder: Path) -> Document:
    """Return the document of a comparison of runs."""
    paired = [contrast for contrast in comparison.contrasts if contrast.pairs]
    reference = comparison.runs[0].mark
    facts = tables.facts_table(comparison)
    sections = [
        Section(facts.title, tables=(facts,))
        if comparison.different
        else Section(facts.title, sentences=("Nothing in what was flown on what.",)),
        Section(
            "Quality of flight",
            tables=(tables.runs_table(comparison.runs), *tables.conduct_table(comparison.runs)),
        ),
        Section(
            "Paired differences",
            sentences=tables.pair_sentences(comparison),
            tables=tuple(tables.contrast_table(comparison, contrast) for contrast in paired),
            draw=lambda: figures.contrast_pictures("compare", comparison, paired) if paired else [],
            sheet="compare-differences.png",
            note="Dots: differences on the same seeds. Bars: 95 % intervals. The line of zero: "
            f"{reference}.",
        ),
        Section(
            "Decision latency",
            tables=(tables.stages_table(comparison.runs),),
            draw=lambda: figures.latency_pictures(comparison, runs),
            sheet="compare-latency.png",
        ),
        Section(
            "Flights from above",
            draw=lambda: flight_pictures(
                "compare-flights", figures.flight_panels(comparison.runs, runs)
            ),
            sheet="compare-trajectories.png",
            note="All on the same axes. Triangle: start; stars: goals; crosses and squares: where "
            "flights failed.",
            in_terminal=False,
        ),
        Section(
            "Energy of airframe and computer",
            draw=lambda: [figures.energy_picture(comparison)],
            in_terminal=False,
        ),
    ]
    return comparison_document(
        comparison,
        runs,
        folder,
        kicker=f"Comparison of {len(comparison.runs)} runs",
        lead="; ".join(run.heading for run in comparison.runs) + f". The reference: {reference}.",
        sections=sections,
        facts=tuple(comparison.same.items()),
        facts_title="The same in all",
    )


def _checked(names: Sequence[str], runs: Sequence[LoadedRun]) -> list[str]:
    """Return the given names of runs, or names from their differences."""
    if not names:
        return _names(runs)
    if len(names) != len(runs):
        raise UsageError(f"--names: {len(names)} for {len(runs)} runs; accepted: one a run")
    for name in names:
        if not name.strip() or list(names).count(name) > 1:
            raise UsageError(f"--names {name!r}: accepted: not empty, each name once")
    return list(names)


def _names(runs: Sequence[LoadedRun]) -> list[str]:
    rows = [_traits(run) for run in runs]
    telling = [key for key in rows[0] if len({row[key] for row in rows}) > 1]
    names = [", ".join(row[key] for key in telling if row[key]) for row in rows]
    if len(set(names)) == len(runs) and all(0 < len(name) <= LONGEST_NAME for name in names):
        return names
    folders = [run.path.resolve().name for run in runs]
    return folders if len(set(folders)) == len(runs) else [str(run.path) for run in runs]


def _traits(run: LoadedRun) -> dict[str, str]:
    setup, config = run.info.setup, run.info.config
    parts = {kind: getattr(setup, kind) for kind in NAMING}
    traits = {
        k: part if isinstance(part, str) else Path(part.name).stem for k, part in parts.items()
    }
    traits["t2"] = ""
    if (latency := setup.injection.latency) is not None:
        samples = latency.samples_ms
        mean_ms = latency.mean_ms if samples is None else sum(samples) / len(samples)
        traits["t2"] = f"{mean_ms:.4g} ms" if samples is None else f"{mean_ms:.0f} ms"
    traits["ablate"] = f"no {config['ablate']}" if config.get("ablate") else ""
    return traits
