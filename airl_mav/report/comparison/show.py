"""Comparisons of every kind: building, writing, printing; of any runs, of policies x arenas."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from airl_mav.core.errors import UsageError, usage_errors
from airl_mav.core.machine import mixed_code
from airl_mav.core.progress import DRAWING, Progress
from airl_mav.flight.judge import Outcome
from airl_mav.flight.requirements import Requirement, find, settle
from airl_mav.flight.statistics import anytime_gap, anytime_mean, reached_goals
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report import heatmap, measures, run_figures, run_verdict
from airl_mav.report.comparison import (
    compare_levels_page,
    comparison_model,
    figures,
    hardware_gap_page,
    latency_sweep_page,
    tables,
)
from airl_mav.report.comparison.build import compare, comparison_document
from airl_mav.report.comparison.comparison_model import (
    ComparedRun,
    Comparison,
    RunEntry,
    kind_of,
    load_entries,
)
from airl_mav.report.comparison.tables import plain_facts
from airl_mav.report.document import (
    NONE,
    Column,
    Document,
    Section,
    TableView,
    print_document,
    print_place,
    write_document,
)

Runs = Mapping[str, LoadedRun]


def build_comparison(
    folder: Path,
    kind: comparison_model.Kind,
    facts: Mapping[str, Any],
    entries: Sequence[comparison_model.RunEntry],
) -> tuple[comparison_model.Comparison, dict[str, LoadedRun]]:
    """Read the runs of a folder and compare them; the kind's module documents its facts."""
    loaded = {entry.name: load(folder / entry.folder) for entry in entries}
    comparison = _KINDS[kind][0](facts, entries, loaded)
    return _stopped(comparison) if comparison.stopped else comparison, loaded


def _stopped(comparison: Comparison) -> Comparison:
    """Return a comparison with intervals of success that hold although a decision ended it."""
    runs, contrasts = [], []
    for run in comparison.runs:
        n = run.quality.success_rate.n
        reached = run.quality.outcomes[Outcome.SUCCESS]
        rate = anytime_mean([0.0, 1.0], [n - reached, reached])
        runs.append(replace(run, quality=replace(run.quality, success_rate=rate)))
    for contrast in comparison.contrasts:
        paired = contrast.paired
        change = replace(paired.success_rate, difference=anytime_gap(paired.agreement))
        contrasts.append(replace(contrast, paired=replace(paired, success_rate=change)))
    return replace(comparison, runs=tuple(runs), contrasts=tuple(contrasts))


def rebuild_comparison(folder: Path) -> tuple[comparison_model.Comparison, dict[str, LoadedRun]]:
    """Recompute the comparison of a folder from its runs. Raises UsageError."""
    kind = comparison_model.kind_of(folder)
    if kind is None:
        accepted = ", ".join(comparison_model.KIND_NAMES.values())
        raise UsageError(f"{folder}: no comparison here; accepted: the folder of a {accepted}")
    return build_comparison(folder, kind, *comparison_model.load_entries(folder, kind))


def judge_comparison(
    comparison: comparison_model.Comparison, loaded: Runs, requirements: Sequence[Requirement] = ()
) -> run_verdict.OverallVerdict:
    """Return the verdict of a comparison; raise FieldError for a required gap without a reference.

    The verdict on a hardware gap judges the run to deploy: the mitigated policy on the onboard
    computer if flown, otherwise the policy. A sequential comparison judges the other run than the
    reference. Other comparisons judge every run.
    """
    against = {c.entry.target: c for c in reversed(comparison.contrasts)}
    if not against and (gaps := [each for each in requirements if each.gap]):
        find(gaps[0], comparison.runs[0].quality, None)
    parts = []
    for run in _judged(comparison):
        contrast = against.get(run.name)
        reference = "" if contrast is None else comparison.run(contrast.entry.reference).label
        episodes = loaded[run.name].episodes
        part = run_verdict.judge_run(
            run.setup,
            run.quality,
            episodes,
            [each for each in requirements if contrast is not None or not each.gap],
            None if contrast is None else contrast.paired,
            reference,
        )
        if comparison.stopped:
            reached = reached_goals(episodes)
            part = replace(part, findings=tuple(settle(each, reached) for each in part.findings))
        parts.append(part)
    verdict = run_verdict.join_verdicts(parts, f"{len(parts)} runs")
    # All compared runs must be valid, not only the judged runs.
    invalid = {name: run_verdict.invalid_flights(run.episodes) for name, run in loaded.items()}
    lines = tuple(f"{name}, {line}" for name, flights in invalid.items() for line in flights)
    sentences = comparison.answers or verdict.sentences
    sentences += run_verdict.unchecked([run.info for run in loaded.values()])
    sentences += mixed_code(each.code for run in loaded.values() for each in run.episodes)
    return replace(verdict, sentences=sentences, invalid=lines)


def _judged(comparison: comparison_model.Comparison) -> tuple[comparison_model.ComparedRun, ...]:
    if comparison.kind != "hardware-gap":
        return comparison.runs[comparison.stopped :]
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
    verdict: run_verdict.OverallVerdict | None = None,
) -> Path:
    """Write `<kind>.json`, `verdict.json`, `.html`, `.md` and PNG files; return the page's path."""
    return write_document(_saved(comparison, loaded, folder, verdict), folder)


def _saved(
    comparison: comparison_model.Comparison,
    loaded: Runs,
    folder: Path,
    verdict: run_verdict.OverallVerdict | None,
) -> Document:
    """Write the data and the verdict of a comparison; return its document."""
    verdict = verdict or judge_comparison(comparison, loaded, run_verdict.requirements_of(folder))
    with usage_errors(folder):
        comparison_model.save_comparison(comparison, folder)
        run_verdict.save_verdict(verdict, folder)
    document = _KINDS[comparison.kind][1](comparison, loaded, folder)
    return replace(document, answers=verdict.lines, status=verdict.status)


def show_comparison(
    comparison: comparison_model.Comparison,
    loaded: Runs,
    folder: Path,
    console: Console,
    verdict: run_verdict.OverallVerdict | None = None,
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


def runs_document(comparison: Comparison, runs: Mapping[str, LoadedRun], folder: Path) -> Document:
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
            draw=lambda: run_figures.flight_pictures(
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
    for measure in measures.MEASURES:
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


def _cell(run: ComparedRun | None, measure: measures.QualityMeasure) -> str:
    if run is None:
        return NONE
    text = measure.with_interval(run.quality)
    return f"{text} *" if text != NONE and trained_here(run) else text


def trained_here(run: ComparedRun) -> bool:
    """Return True if a policy was trained in the arena of its run."""
    return run.entry.group == run.entry.trained_in


def _notes(runs: Sequence[ComparedRun], measure: measures.QualityMeasure) -> tuple[str, ...]:
    if measure is not measures.SUCCESS_RATE:
        return ("Medians over the flights that reached the goal, with 95 % intervals.",)
    notes = ["Of all flights; 95 % intervals after Wilson. The same seeds in every cell."]
    if any(trained_here(run) for run in runs):
        notes.append("* the arena that the policy was trained in")
    rules = list(dict.fromkeys(run.entry.rules for run in runs))
    start = "Rules" if len(rules) == 1 else "Not all by the same rules"
    return (*notes, f"{start}: {'; '.join(rules)}.")


def success_map(runs: Sequence[ComparedRun]) -> heatmap.HeatMap:
    """Return the success rates as a heat map with the first policy at the top."""
    policies = list(dict.fromkeys(run.label for run in runs))[::-1]
    return heatmap.HeatMap(
        title="success; a star: trained there",
        rows=policies,
        row_title="",
        columns=list(dict.fromkeys(run.entry.group for run in runs)),
        column_title="",
        fields={
            (run.label, run.entry.group): heatmap.Field(
                100.0 * rate, f"{100.0 * rate:.1f}{'*' if trained_here(run) else ''}"
            )
            for run in runs
            if (rate := run.quality.success_rate.value) is not None
        },
        unit="success [%]",
        limits=(0.0, 100.0),
    )


def matrix_document(
    comparison: Comparison, runs: Mapping[str, LoadedRun], folder: Path
) -> Document:
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
                draw=lambda: [heatmap.heat_picture("matrix", alt, success_map(comparison.runs))],
                in_terminal=False,
            ),
        ],
        facts=plain_facts(comparison),
    )


_KINDS: dict[
    comparison_model.Kind,
    tuple[
        Callable[
            [Mapping[str, Any], Sequence[comparison_model.RunEntry], Runs],
            comparison_model.Comparison,
        ],
        Callable[[comparison_model.Comparison, Runs, Path], Document],
    ],
] = {
    "compare": (build_runs, runs_document),
    "hardware-gap": (hardware_gap_page.build_hardware_gap, hardware_gap_page.document_of),
    "compare-levels": (compare_levels_page.build_compare_levels, compare_levels_page.document_of),
    "matrix": (build_matrix, matrix_document),
    "latency-sweep": (latency_sweep_page.build_latency_sweep, latency_sweep_page.document_of),
}
"""Functions that build the comparison and its document, by kind."""
