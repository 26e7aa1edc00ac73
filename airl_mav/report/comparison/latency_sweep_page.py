"""Latency sweep: the cost of injected latency for a policy, on the same seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from airl_mav.core.constants import US_PER_MS
from airl_mav.flight.statistics import Estimate
from airl_mav.profiles.loading import load_published, published_gap
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report import measures, theme
from airl_mav.report.comparison import build, comparison_model, tables
from airl_mav.report.document import Column, Document, Section, TableView, ms
from airl_mav.report.theme import FigureImage


@dataclass(frozen=True)
class FigureLine:
    """Line of a figure."""

    name: str
    points: Sequence[tuple[float, Estimate]]
    """Position on the x axis and estimate of each point; points without a value are skipped."""


def curves_picture(
    name: str,
    title: str,
    labels: tuple[str, str],
    series: Sequence[FigureLine],
    paper: Sequence[tuple[float, float]] = (),
) -> theme.FigureImage:
    """Draw series with their known intervals and the paper's points over a common axis."""
    figure = theme.new_figure(4.2, 3.0 + 0.2 * (len(series) + bool(paper)))
    ax: Axes = figure.subplots()
    for index, line in enumerate(series):
        colour, dashes = theme.line_style(index)
        known = [(x, e) for x, e in line.points if e.value is not None]
        x = [at for at, _ in known]
        y = [e.value or 0.0 for _, e in known]
        low = [y[i] - (y[i] if e.low is None else e.low) for i, (_, e) in enumerate(known)]
        high = [(y[i] if e.high is None else e.high) - y[i] for i, (_, e) in enumerate(known)]
        ax.errorbar(
            x,
            y,
            yerr=[low, high],
            color=colour,
            ls=dashes,
            marker="o",
            ms=4,
            lw=1.6,
            capsize=2.5,
            label=line.name,
        )
    if paper:
        at, values = zip(*paper, strict=True)
        ax.plot(
            at, values, ls="none", marker="D", ms=5, color=theme.MARK, mfc="none", label="the paper"
        )
    theme.label_axes(ax, *labels, title)
    ax.set_xlim(left=0.0)
    theme.plain_axes(ax)
    theme.legend_below(figure, 1)
    told = ", ".join(line.name for line in series)
    return theme.render(figure, name, f"{title} over {labels[0]}: {told}")


AGAINST_FIRST, STEP = "against-first", "step"
"""Keys of the contrasts with the first latency and with the previous latency."""

LOSSES = (measures.FLIGHT_TIME, measures.DISTANCE, measures.ENERGY)

FEWEST = 10
"""Minimum number of pairs for a conclusion about a step."""


def build_latency_sweep(
    facts: Mapping[str, Any],
    entries: Sequence[comparison_model.RunEntry],
    runs: Mapping[str, LoadedRun],
) -> comparison_model.Comparison:
    """Compare the latencies (`label`, increasing) of each policy (`group`)."""
    contrasts: list[comparison_model.ContrastEntry] = []
    for policy in dict.fromkeys(entry.group for entry in entries):
        line = [entry for entry in entries if entry.group == policy]
        first = line[0]
        for run in line[1:]:
            title = f"{run.label} against {first.label}"
            contrasts.append(
                comparison_model.ContrastEntry(run.name, first.name, AGAINST_FIRST, title)
            )
        for a, b in pairwise(line):
            contrasts.append(
                comparison_model.ContrastEntry(b.name, a.name, STEP, f"{a.label} → {b.label}")
            )
    title = "Latency sweep"
    comparison = build.compare(
        runs, contrasts, kind="latency-sweep", title=title, facts=facts, entries=entries
    )
    told = [line for policy in comparison.groups for line in _verdict(comparison, policy)]
    return replace(comparison, answers=tuple(told))


def contrasts_by_key(
    comparison: comparison_model.Comparison, policy: str, key: str
) -> list[comparison_model.Contrast]:
    """Return a policy's contrasts with the first or the previous latency, by `key`."""
    return [c for c in comparison.contrasts_of(policy) if c.entry.key == key]


# --- the verdict


def _verdict(comparison: comparison_model.Comparison, policy: str) -> list[str]:
    """Return sentences on the cost of each step and on its monotonicity."""
    steps = contrasts_by_key(comparison, policy, STEP)
    lines = [f"{policy}, {measure.title}: {_monotone(measure, steps)}" for measure in LOSSES]
    rates = [run.quality.success_rate.value or 0.0 for run in comparison.group(policy)]
    told = ", ".join(f"{100.0 * rate:.1f}" for rate in rates)
    return [*lines, f"{policy}, success {_success_trend(steps)}: {told} %."]


def _success_trend(steps: Sequence[comparison_model.Contrast]) -> str:
    rises = [(step.entry.title, step.paired.success_rate.difference) for step in steps]
    if sure := [title for title, d in rises if d.low is not None and d.low > 0.0]:
        return f"not monotone, it rises at {', '.join(sure)}"
    if any(d.value is not None and d.value > 0.0 for _, d in rises):
        return "rises nowhere beyond chance"
    return "never rises"


def _monotone(measure: measures.QualityMeasure, steps: Sequence[comparison_model.Contrast]) -> str:
    changes = [(step.entry.title, measure.change(step.paired).difference) for step in steps]
    known = [(title, d) for title, d in changes if d.value is not None and d.n >= FEWEST]
    if not known:
        return f"fewer than {FEWEST} pairs at every step."
    short = [title for title, d in changes if d.value is None or d.n < FEWEST]
    told = ", ".join(f"{d.value:+.1f} % ({title})" for title, d in known)
    if down := [title for title, d in known if (d.value or 0.0) <= 0.0]:
        verdict = f"not monotone, it falls at {', '.join(down)}"
    elif all(d.low is not None and d.low > 0.0 for _, d in known):
        verdict = "monotone, every step's interval above zero"
    else:
        verdict = "monotone"
    rest = f" Fewer than {FEWEST} pairs: {', '.join(short)}." if short else ""
    return f"{verdict}: {told}.{rest}"


# --- tables and figures


def latency_quality_table(comparison: comparison_model.Comparison, policy: str) -> TableView:
    """Return the results at each latency."""
    columns = (
        Column("latency", number=False),
        Column("t2", "ms"),
        *(Column(measure.title, measure.unit) for measure in measures.MEASURES),
    )
    rows = tuple(
        (
            run.label,
            ms(run.stages["t2"].mean, 0),
            *(measure.with_interval(run.quality) for measure in measures.MEASURES),
        )
        for run in comparison.group(policy)
    )
    notes = (
        "Medians over the flights that reached the goal at that latency, 95 % intervals in "
        "brackets.",
    )
    return TableView(f"{policy}-by-latency", f"{policy} by latency", columns, rows, notes)


def published_curve_table() -> TableView:
    """Return the published curve, with losses computed in the same way."""
    columns = (
        Column("the paper", number=False),
        *(Column(measure.title, measure.unit) for measure in LOSSES),
        *(Column(title, "%") for title in ("time", "distance", "energy")),
    )
    rows = tuple(
        (
            f"{each.latency_ms:g} ms",
            *(f"{v:.2f}" for v in (each.flight_time_s, each.distance_m, each.energy_kj)),
            *(tables.signed(loss) for loss in _published_losses(number)),
        )
        for number, each in enumerate(load_published().degradation)
    )
    notes = (
        "Section VI.C: its Static Obstacles policy on a Core i9 slowed by sleep; percent: against "
        "its base of 11 ms, worked out from its figures. It gives no success rates.",
    )
    return TableView("the-paper", "The paper's degradation table", columns, rows, notes)


def _published_losses(number: int) -> tuple[float, ...]:
    """Return the published loss of time, distance and energy at a latency [%]."""
    curve = load_published().degradation
    gap = published_gap(curve[0], curve[number])
    return gap.flight_time_percent, gap.distance_percent, gap.energy_percent


def curve_pictures(comparison: comparison_model.Comparison) -> list[FigureImage]:
    """Draw success rate and losses of time, distance and energy over the mean t2."""
    at_ms = {run.name: (run.stages["t2"].mean or 0.0) / US_PER_MS for run in comparison.runs}
    success = [
        FigureLine(
            policy,
            [
                (at_ms[run.name], run.quality.success_rate.scaled(100.0))
                for run in comparison.group(policy)
            ],
        )
        for policy in comparison.groups
    ]
    axis = "mean t2 [ms]"
    pictures = [curves_picture("latency-sweep-success", "success rate", (axis, "%"), success)]
    for number, measure in enumerate(LOSSES):
        losses = [
            FigureLine(
                policy,
                [
                    (at_ms[comparison.group(policy)[0].name], Estimate(0.0, None, None, 0)),
                    *(
                        (at_ms[c.entry.target], measure.change(c.paired).difference)
                        for c in contrasts_by_key(comparison, policy, AGAINST_FIRST)
                    ),
                ],
            )
            for policy in comparison.groups
        ]
        published = [
            (each.latency_ms, _published_losses(k)[number])
            for k, each in enumerate(load_published().degradation)
        ]
        name = f"latency-sweep-{measure.title.replace(', ', '-').replace(' ', '-')}"
        pictures.append(
            curves_picture(
                name, f"{measure.title}, against the first", (axis, "%"), losses, published
            )
        )
    return pictures


def policy_tables(comparison: comparison_model.Comparison, policy: str) -> tuple[TableView, ...]:
    """Return tables of each latency: results, contrasts with the first and the previous one."""
    return (
        latency_quality_table(comparison, policy),
        *(
            tables.contrasts_table(comparison, contrasts_by_key(comparison, policy, key), title)
            for key, title in (
                (AGAINST_FIRST, f"{policy}: against {comparison.group(policy)[0].label}"),
                (STEP, f"{policy}: step by step"),
            )
        ),
    )


def curves_section(comparison: comparison_model.Comparison) -> Section:
    """Return the section of the curves, including the published curve."""
    return Section(
        "Over latency",
        tables=(published_curve_table(),),
        draw=lambda: curve_pictures(comparison),
        note="Losses on the common successes with the first latency, 95 % intervals.",
    )


def document_of(
    comparison: comparison_model.Comparison, runs: Mapping[str, LoadedRun], folder: Path
) -> Document:
    """Return the document of a latency sweep."""
    return build.comparison_document(
        comparison,
        runs,
        folder,
        kicker="Latency sweep",
        lead="How much worse does a policy fly as its decisions come later?",
        sections=[
            curves_section(comparison),
            *(
                Section(policy, tables=policy_tables(comparison, policy))
                for policy in comparison.groups
            ),
        ],
        facts=(*tables.plain_facts(comparison), *tables.common_rules(comparison)),
    )
