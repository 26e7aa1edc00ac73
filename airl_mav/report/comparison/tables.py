"""Tables of a comparison as text cells, shared by terminal, page and Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from airl_mav.latency.stages import SETPOINT_TO_MOTOR, SHOWN_STAGES
from airl_mav.report import document
from airl_mav.report.comparison.comparison_model import ComparedRun, Comparison, Contrast
from airl_mav.report.document import Facts, Headline, estimate_headline, interval_of, with_interval
from airl_mav.report.measures import (
    COMPUTER_ENERGY,
    CONDUCT,
    CONDUCT_NOTE,
    MEASURES,
    QualityMeasure,
    count_successes,
)

SIDE_BY_SIDE = 4
"""Maximum number of runs in columns; more runs are listed in rows."""

STAGES = (*SHOWN_STAGES[:-1], SETPOINT_TO_MOTOR, SHOWN_STAGES[-1])
"""Stages of a decision in the order of the table."""

THE_PAPER = "the paper"

_PUBLISHED = {
    "success_rate": ("success_percent", "success"),
    "flight_time_s": ("flight_time_s", "flight_time_percent"),
    "distance_m": ("distance_m", "distance_percent"),
    "energy_j": ("energy_kj", "energy_percent"),
}
"""Fields of a published run (in the displayed unit) and a published gap, by measure key."""


def published_value(run: ComparedRun, measure: QualityMeasure) -> float | None:
    """Return the published value of a measure in the displayed unit."""
    if run.published is None or measure.key not in _PUBLISHED:
        return None
    value: float | None = getattr(run.published, _PUBLISHED[measure.key][0])
    return value


def published_change(contrast: Contrast, measure: QualityMeasure) -> float | None:
    """Return the published difference of a measure."""
    if contrast.published is None or measure.key not in _PUBLISHED:
        return None
    value: float = getattr(contrast.published, _PUBLISHED[measure.key][1])
    return value


def signed(value: float | None, digits: int = 1) -> str:
    """Return a difference with its sign, never as -0."""
    return document.NONE if value is None else f"{round(value, digits) + 0.0:+,.{digits}f}"


def versus(comparison: Comparison, contrast: Contrast) -> str:
    """Return the runs of a contrast as `target against reference`."""
    target, reference = comparison.pair(contrast)
    return f"{target.mark} against {reference.mark}"


def contrast_head(comparison: Comparison, contrast: Contrast) -> str:
    """Return the heading of a contrast; without role marks, it includes the short title."""
    target, reference = comparison.pair(contrast)
    if target.named:
        return f"{target.mark}\nagainst {reference.mark}"
    return f"{versus(comparison, contrast)}\n{contrast.entry.short}".rstrip()


# --- single runs


def runs_table(
    runs: Sequence[ComparedRun],
    *,
    title: str = "Quality of flight",
    head: str = "run",
    measures: Sequence[QualityMeasure] = (*MEASURES, COMPUTER_ENERGY),
) -> document.TableView:
    """Return the results of each run, one per row."""
    columns = (
        document.Column(head, number=False),
        document.Column("flights"),
        *(document.Column(measure.title, measure.unit) for measure in measures),
    )
    rows = tuple(
        (
            run.mark,
            f"{run.quality.success_rate.n:,}",
            *(measure.with_interval(run.quality) for measure in measures),
        )
        for run in runs
    )
    notes = [
        "Each run by itself, 95 % intervals in brackets; time, distance and energy: medians over "
        "the flights that reached the goal."
    ]
    if len({run.quality.success_rate.n for run in runs}) > 1:
        notes.append("Not the same number of flights in all runs: compare on the same seeds.")
    return document.TableView("quality", title, columns, rows, tuple(notes), in_terminal="stacked")


def conduct_table(runs: Sequence[ComparedRun]) -> tuple[document.TableView, ...]:
    """Return deadlines and smoothness of each run; empty if no run recorded them."""
    if not any(measure.of(run.quality).n for run in runs for measure in CONDUCT):
        return ()
    view = runs_table(runs, title="Deadlines and smoothness", measures=CONDUCT)
    return (replace(view, key="conduct", notes=(CONDUCT_NOTE,)),)


def facts_table(comparison: Comparison) -> document.TableView:
    """Return only the differences between the setups; many runs are listed in rows."""
    terms, runs = comparison.different, comparison.runs
    note = f"Only what differs. The reference: {runs[0].heading}."
    if len(runs) > SIDE_BY_SIDE:
        columns: tuple[document.Column, ...] = tuple(
            document.Column(title, number=False) for title in ("run", "what", "")
        )
        rows: tuple[tuple[str, ...], ...] = tuple(
            (run.heading if number == 0 else "", term, run.facts.get(term, document.NONE))
            for run in runs
            for number, term in enumerate(terms)
        )
    else:
        columns = (
            document.Column("", number=False),
            *(document.Column(r.heading, number=False) for r in runs),
        )
        rows = tuple((term, *(r.facts.get(term, document.NONE) for r in runs)) for term in terms)
    return document.TableView("facts", "What differs", columns, rows, (note,))


def stages_table(runs: Sequence[ComparedRun]) -> document.TableView:
    """Return the latencies of all runs, stage by stage."""
    columns = (
        document.Column("stage", number=False),
        document.Column("run", number=False),
        *document.DURATION_COLUMNS,
    )
    rows: list[tuple[str, ...]] = []
    mixed = any(run.modelled for run in runs)
    for stage in STAGES:
        # If one run has link and control in one stage, show that sum for all runs.
        joint = mixed and stage == SETPOINT_TO_MOTOR
        having = [r for r in runs if r.has_stage(stage) or (joint and r.stages[stage.key].n)]
        for number, run in enumerate(having):
            title = stage.title if number == 0 else ""
            rows.append((title, run.mark, *document.duration_cells(run.stages[stage.key])))
    notes = ["Milliseconds of simulated time."]
    labels = {run.mark: run.setup.injection.label for run in runs}
    if len(set(labels.values())) == 1:
        notes.append(f"t2: {next(iter(labels.values()))}.")
    else:
        notes += [f"t2 of {mark}: {label}." for mark, label in labels.items()]
    if modelled := [run.mark for run in runs if run.modelled]:
        listed = "all runs" if len(modelled) > SIDE_BY_SIDE else "; ".join(modelled)
        notes.append(
            f"Level gym measures no time: transport and link are constants of its model, t2 is "
            f"drawn ({listed})."
        )
    if any(document.TOO_FEW_CELL in row for row in rows):
        notes.append(document.TOO_FEW_NOTE)
    return document.TableView("latency", "Decision latency", columns, tuple(rows), tuple(notes))


# --- contrasts


def _intervals(comparison: Comparison) -> str:
    """Return the kinds of intervals of success and of the other measures."""
    rates = "by betting, valid at any stop," if comparison.stopped else "Tango's"
    return f"{rates} for the success, order statistics for the medians"


def contrast_table(
    comparison: Comparison, contrast: Contrast, measures: Sequence[QualityMeasure] = MEASURES
) -> document.TableView:
    """Return a contrast with one row per measure."""
    target, reference = comparison.pair(contrast)
    columns = [
        document.Column("same seeds", number=False),
        document.Column(reference.mark),
        document.Column(target.mark),
        document.Column("difference"),
        document.Column("95 % interval"),
        document.Column("pairs"),
    ]
    if contrast.published is not None:
        marks = (reference.mark, target.mark)
        columns += [document.Column(f"paper {mark}", page_only=True) for mark in marks]
        columns.append(document.Column("paper difference", page_only=True))
    rows = tuple(_contrast_row(contrast, m, reference, target) for m in measures)
    a = contrast.paired.agreement
    n = contrast.successes
    notes = [
        f"Of {a.n:,} seeds both reached the goal in {a.both:,}, only {reference.mark} in "
        f"{a.only_reference:,}, only {target.mark} in {a.only_other:,}, neither in {a.neither:,}.",
        f"Time, distance and energy: medians over {count_successes(n)}; the difference is the "
        f"median of the seeds' differences. Intervals: {_intervals(comparison)}.",
    ]
    title = versus(comparison, contrast)
    if contrast.entry.short:
        title += f": {contrast.entry.title}"
    key = f"{contrast.entry.target}-against-{contrast.entry.reference}"
    return document.TableView(key, title, tuple(columns), rows, tuple(notes))


def _contrast_row(
    contrast: Contrast, measure: QualityMeasure, reference: ComparedRun, target: ComparedRun
) -> tuple[str, ...]:
    change = measure.change(contrast.paired)
    d = change.difference
    unit = measure.difference_unit
    row = (
        measure.title,
        measure.plain(change.reference, unit=True),
        measure.plain(change.other, unit=True),
        document.NONE if d.value is None else f"{d.value:+.2f} {unit}",
        interval_of(d, 2, "+") or document.NONE,
        f"{d.n:,}",
    )
    if contrast.published is None:
        return row
    figures = (published_value(run, measure) for run in (reference, target))
    told = published_change(contrast, measure)
    return (
        *row,
        *(document.NONE if value is None else f"{value:.4g} {measure.unit}" for value in figures),
        document.NONE if told is None else f"{told:+.2f} {unit}",
    )


def contrasts_table(
    comparison: Comparison, contrasts: Sequence[Contrast], title: str, notes: Sequence[str] = ()
) -> document.TableView:
    """Return contrasts with intervals, one per row, each followed by the published values."""
    columns = (
        document.Column("", number=False),
        *(document.Column(measure.title, measure.difference_unit) for measure in MEASURES),
        document.Column("t2", "%", page_only=True),
        document.Column("pairs", page_only=True),
    )
    rows: list[tuple[str, ...]] = []
    for contrast in contrasts:
        changes = [measure.change(contrast.paired).difference for measure in MEASURES]
        head = contrast_head(comparison, contrast)
        told = [with_interval(d, 1, "+") for d in changes]
        rows.append((head, *told, signed(contrast.t2_percent, 0), f"{contrast.successes:,}"))
        if contrast.published is not None:
            figures = (signed(published_change(contrast, measure)) for measure in MEASURES)
            t2 = signed(contrast.published.latency_percent, 0)
            rows.append((f"  {THE_PAPER}", *figures, t2, document.NONE))
    notes = [
        *(
            f"{versus(comparison, c)}: {c.entry.title}, {c.successes:,} pairs."
            for c in contrasts
            if c.entry.title
        ),
        "Difference: the median over the pairs of 100 (target - reference) / reference, in "
        "percent; success: percentage points. The same seeds; time, distance and energy over the "
        "pairs of which both reached the goal. In brackets: 95 % intervals, "
        f"{_intervals(comparison)}.",
        *notes,
    ]
    return document.TableView(
        "contrasts", title, columns, tuple(rows), tuple(notes), in_terminal="stacked"
    )


def contrast_headlines(contrast: Contrast, digits: int = 2) -> tuple[Headline, ...]:
    """Return the differences of a contrast as headlines."""
    headlines = []
    for measure in MEASURES:
        d = measure.change(contrast.paired).difference
        told = published_change(contrast, measure)
        more = [] if told is None else [f"{THE_PAPER} {told:+.1f}"]
        headlines.append(
            estimate_headline(
                measure.headline, d, measure.difference_unit, digits=digits, sign="+", more=more
            )
        )
    return tuple(headlines)


def pair_sentences(comparison: Comparison) -> tuple[str, ...]:
    """Return sentences with the number of pairs of each contrast, and reasons for missing ones."""
    sentences = []
    for contrast in comparison.contrasts:
        target, reference = (run.mark for run in comparison.pair(contrast))
        unmatched = ""
        if contrast.unmatched:
            unmatched = (
                f" {contrast.unmatched:,} flights have a seed of {reference}, but another arena "
                "or goal: no pairs."
            )
        if contrast.pairs:
            sentences.append(f"{target} and {reference}: {contrast.pairs:,} pairs.{unmatched}")
        else:
            sentences.append(
                f"{target} and {reference} share no episode: their differences are those of the "
                f"runs by themselves, unpaired.{unmatched}"
            )
    return tuple(sentences)


def flights_fact(comparison: Comparison) -> Facts:
    """Return the number of flown and planned flights of each run."""
    counts = ", ".join(
        f"{run.flown:,} at {run.mark}"
        if run.flown == run.planned
        else f"{run.flown:,} of {run.planned:,} at {run.mark}"
        for run in comparison.runs
    )
    return (("flights", counts),)


def common_rules(comparison: Comparison) -> Facts:
    """Return the rules for judging the flights."""
    rules = dict.fromkeys(run.entry.rules for run in comparison.runs if run.entry.rules)
    return (("rules", "; ".join(rules)),) if rules else ()


def plain_facts(comparison: Comparison) -> Facts:
    """Return the settings of a comparison, except remarks, which are listed separately."""
    return tuple(
        (key.replace("_", " "), f"{value}")
        for key, value in comparison.facts.items()
        if value is not None and key != "remarks"
    )
