"""Fidelity levels: the same policy and seeds at several levels; the first is the reference."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from airl_mav.flight.judge import Outcome
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report import document
from airl_mav.report.comparison import tables
from airl_mav.report.comparison.build import compare, comparison_document, split_seeds, widest_seeds
from airl_mav.report.comparison.comparison_model import ComparedRun, Comparison, Contrast, RunEntry
from airl_mav.report.comparison.figures import contrast_pictures
from airl_mav.report.measures import MEASURES, count_successes

MAX_SPLIT = 50
"""Maximum number of seeds in the table of different outcomes."""


def build_compare_levels(
    facts: Mapping[str, Any], entries: Sequence[RunEntry], runs: Mapping[str, LoadedRun]
) -> Comparison:
    """Compare the levels with the first; see `show.build_comparison`."""
    title = f"{facts.get('policy')} in {facts.get('arena')}"
    comparison = compare(runs, kind="compare-levels", title=title, facts=facts, entries=entries)
    widest = {
        contrast.entry.target: widest_seeds(
            runs[contrast.entry.reference], runs[contrast.entry.target]
        )
        for contrast in comparison.contrasts
    }
    return replace(comparison, extra={"split": split_seeds(runs), "widest_percent": widest})


def start_table(comparison: Comparison) -> document.TableView:
    """Return the start of navigation and the position error at each level."""
    columns = document.columns_of(
        "<level | flights | take-off [s] | its energy [kJ] | "
        "aside [m] | height [m] | speed [m/s] | position error [m]"
    )
    notes = (
        "Means. Take-off: before navigation, in none of the figures above. Aside, height, speed: "
        "of the vehicle as navigation begins. Position error: of the estimate that the companion "
        "is told, during navigation, seen from above.",
    )
    rows = tuple(_start_row(run) for run in comparison.runs)
    return document.TableView("start", "Where navigation begins", columns, rows, notes)


def _start_row(run: ComparedRun) -> tuple[str, ...]:
    start, error = run.start, run.position_error_m
    told = document.NONE if error is None else f"{error:.2f}"
    if start is None:
        return (run.mark, "0", *(document.NONE,) * 5, told)
    energy_j = start.takeoff_energy_j
    energy = document.NONE if energy_j is None else f"{energy_j / 1e3:.2f}"
    takeoff = (f"{start.takeoff_s:.2f}", energy)
    if not start.takeoff_s:
        takeoff = ("none", document.NONE)
    place = (f"{start.aside_m:.2f}", f"{start.height_m:.2f}", f"{start.speed_m_s:.2f}")
    return (run.mark, f"{start.n:,}", *takeoff, *place, told)


def split_table(comparison: Comparison) -> document.TableView:
    """Return the flights with different outcomes, one seed per row."""
    columns = (
        document.Column("seed"),
        *(document.Column(run.mark, number=False) for run in comparison.runs),
    )
    split = comparison.extra["split"]
    rows = tuple(
        (
            f"{each['seed']}",
            *(
                document.OUTCOME_LABELS[Outcome(each["outcomes"][run.name])]
                if run.name in each["outcomes"]
                else document.NONE
                for run in comparison.runs
            ),
        )
        for each in split[:MAX_SPLIT]
    )
    notes = ["Seeds of which one flight reached the goal and another did not."]
    if len(rows) < len(split):
        notes.append(f"{len(rows)} of {len(split):,}; all: compare-levels.json.")
    title = "Flights that did not end alike"
    return document.TableView("split", title, columns, rows, tuple(notes), in_terminal="not")


def other_differences(comparison: Comparison) -> tuple[str, ...]:
    """Return sentences on other differences between the levels, from stamps and paths."""

    def across(what: str, text: Callable[[ComparedRun], str | None]) -> str:
        told = [(run.mark, text(run)) for run in comparison.runs]
        parts = [f"{text} at {mark}" for mark, text in told if text is not None]
        return f"{what}: {'; '.join(parts)}." if parts else ""

    def mean_of(stage: str) -> Callable[[ComparedRun], str | None]:
        def text(run: ComparedRun) -> str | None:
            mean = run.stages[stage].mean
            return None if mean is None else f"{document.ms(mean, 1)} ms"

        return text

    lines = [
        across("Decision period", mean_of("period")),
        across("Frame to motors", mean_of("end_to_end")),
        across("Start of navigation", _start_sentence),
        across(
            "Error of the estimated position",
            lambda run: None if run.position_error_m is None else f"{run.position_error_m:.2f} m",
        ),
    ]
    for contrast in comparison.contrasts:
        lines += [_pace_sentence(comparison, contrast), _widest_sentence(comparison, contrast)]
    lines += [
        f"The host could not keep pace at {run.mark}: {document.ms(run.slipped_us, 0)} ms of "
        f"simulated time given up over {run.flown:,} flights."
        for run in comparison.runs
        if run.slipped_us
    ]
    return tuple(line for line in lines if line)


def _start_sentence(run: ComparedRun) -> str | None:
    start = run.start
    if start is None:
        return None
    after = f"after {start.takeoff_s:.1f} s of take-off" if start.takeoff_s else "without take-off"
    return (
        f"{after}, {start.aside_m:.2f} m aside, {start.height_m:.2f} m high, "
        f"{start.speed_m_s:.2f} m/s"
    )


def _pace_sentence(comparison: Comparison, contrast: Contrast) -> str:
    """Return speed and power of both median flights on common successes; empty without any."""
    p = contrast.paired
    time, distance, energy = p.flight_time_s, p.distance_m, p.energy_j
    parts = [
        f"{metres / seconds:.2f} m/s and {joules / seconds:.0f} W at {comparison.run(name).mark}"
        for name, seconds, metres, joules in (
            (contrast.entry.reference, time.reference, distance.reference, energy.reference),
            (contrast.entry.target, time.other, distance.other, energy.other),
        )
        if seconds and metres is not None and joules is not None
    ]
    if not parts:
        return ""
    pairs = count_successes(contrast.successes)
    return f"Speed and power of the median flight on {pairs}: {'; '.join(parts)}."


def _widest_sentence(comparison: Comparison, contrast: Contrast) -> str:
    widest = comparison.extra["widest_percent"][contrast.entry.target]
    if widest is None:
        return ""
    told = ", ".join(f"{e['percent']:+.1f} % with seed {e['seed']}" for e in widest["seeds"])
    return (
        f"Flight time at {comparison.run(contrast.entry.target).mark} by pairs: median "
        f"{widest['median']:+.1f} %; widest {told}."
    )


def document_of(
    comparison: Comparison, runs: Mapping[str, LoadedRun], folder: Path
) -> document.Document:
    """Return the document of a comparison of levels."""
    reference = comparison.runs[0].mark
    contrasts = comparison.contrasts
    levels = tables.runs_table(comparison.runs, title="Levels", head="level", measures=MEASURES)
    split = split_table(comparison)
    sections = [
        *document.tables_section(levels),
        *(
            document.Section(
                view.title, headlines=tables.contrast_headlines(contrast), tables=(view,)
            )
            for contrast in contrasts
            for view in (tables.contrast_table(comparison, contrast),)
        ),
        document.Section(
            "Paired differences",
            draw=lambda: contrast_pictures("compare-levels", comparison, contrasts),
            sheet="compare-levels.png",
            note="Dots: differences on the same seeds. Bars: 95 % intervals. The line of zero: "
            f"{reference}.",
            in_terminal=False,
        ),
        *document.tables_section(tables.stages_table(comparison.runs)),
        *document.tables_section(start_table(comparison)),
        document.Section("What else differs", sentences=other_differences(comparison)),
        *document.tables_section(split if split.rows else None),
    ]
    hashes = [(f"sha256 at {run.mark}", run.sha256) for run in comparison.runs if run.sha256]
    return comparison_document(
        comparison,
        runs,
        folder,
        kicker="Fidelity levels",
        lead=f"The same policy and seeds at {', '.join(run.mark for run in comparison.runs)}; "
        f"differences are from {reference}.",
        sections=sections,
        facts=(*tables.plain_facts(comparison), *tables.flights_fact(comparison), *hashes),
    )
