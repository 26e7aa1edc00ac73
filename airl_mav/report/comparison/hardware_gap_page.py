"""Hardware gap: loss of a policy's quality on a computer, with and without mitigation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from airl_mav.core.constants import US_PER_MS
from airl_mav.flight.statistics import Estimate
from airl_mav.profiles.loading import PublishedRun, load_published, published_gap
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report import measures
from airl_mav.report.comparison import comparison_model
from airl_mav.report.comparison.build import compare, comparison_document, worst_seeds
from airl_mav.report.comparison.figures import contrast_pictures, flight_panels, seed_picture
from airl_mav.report.comparison.tables import (
    THE_PAPER,
    common_rules,
    contrast_headlines,
    contrast_table,
    contrasts_table,
    plain_facts,
    published_value,
)
from airl_mav.report.document import NONE, Column, Document, Section, TableView, interval_of, ms
from airl_mav.report.run_figures import flight_pictures
from airl_mav.report.run_tables import computer_power

WITHOUT, WITH = "without-mitigation", "with-mitigation"
WITH_TRAINED, WITHOUT_TRAINED = "with-mitigation-trained", "without-mitigation-trained"
COMPENSATED, LATENCY_ALONE = "compensated", "latency-alone"


def hardware_gap_sentence(comparison: comparison_model.Comparison, arena: str) -> str:
    """Return a sentence on the gap of an arena; empty without reference or target."""
    gaps = {c.entry.key: c for c in reversed(comparison.contrasts_of(arena))}
    if (gap := gaps.get(WITHOUT)) is None:
        return ""
    target, reference = comparison.pair(gap)
    place = "" if len(comparison.groups) == 1 else f" in {Path(arena).stem}"
    sentence = (
        f"On {_computer(target)}{place} {target.setup.policy.name} flies {_longer(gap)} than on "
        f"{_computer(reference)} and reaches {_rate(target)} of its goals, not {_rate(reference)}."
    )
    if (alone := gaps.get(LATENCY_ALONE)) is not None:
        rate = _rate(comparison.run(alone.entry.target))
        sentence += (
            " With that latency alone, without mass and power, it flies"
            f" {_longer(alone)} and reaches {rate}."
        )
    if (compensated := gaps.get(COMPENSATED)) is not None:
        rate = _rate(comparison.run(compensated.entry.target))
        sentence += (
            f" With its latency compensated it flies {_longer(compensated)} there and reaches"
            f" {rate}."
        )
    if (mitigated := gaps.get(WITH)) is None:
        return sentence
    other = comparison.run(mitigated.entry.target)
    sentence += (
        f" {other.setup.policy.name} there flies {_longer(mitigated)} than that and reaches "
        f"{_rate(other)}"
    )
    if (trained := gaps.get(WITH_TRAINED)) is not None:
        difference = trained.paired.flight_time_s.difference
        told = "with no common success"
        if difference.value is not None:
            told = f"a median {difference.value:+.1f} %{_interval(difference)}"
        sentence += f"; against the conditions of its own training that is {told} of flight time"
    return f"{sentence}."


def _computer(run: comparison_model.ComparedRun) -> str:
    name, mean = Path(run.setup.computer.name).stem, run.stages["t2"].mean
    if mean is None:
        return name
    return f"{name} (t2 {mean / US_PER_MS:,.{0 if mean >= 10.0 * US_PER_MS else 1}f} ms)"


def _longer(contrast: comparison_model.Contrast) -> str:
    """Return a gap of the flight time as a comparative without `than`."""
    difference = measures.FLIGHT_TIME.change(contrast.paired).difference
    if difference.value is None:
        return "(no goal that both reached) longer"
    comparative = "shorter" if difference.value < 0.0 else "longer"
    return f"a median {abs(difference.value):.1f} % {comparative}{_interval(difference)}"


def _interval(difference: Estimate) -> str:
    text = interval_of(difference, 1, "+")
    return f" ({text})" if text else ""


def _rate(run: comparison_model.ComparedRun) -> str:
    rate = run.quality.success_rate
    return "none" if rate.value is None else f"{100.0 * rate.value:.1f} %"


OVERLAID = 100
"""Maximum number of flights drawn in one map, from the first seed on."""

WORST_ROLES = ("reference", "target", "mitigated")

COST, HELP = "cost-on-reference", "mitigation-on-target"

PARTS_OF_ENERGY = (measures.ENERGY, measures.COMPUTER_ENERGY)
"""Parts of the energy for the page; the terminal has room only for their sum."""

HEADLINED = (WITHOUT, LATENCY_ALONE, COMPENSATED, WITH, WITH_TRAINED)
"""Gaps shown as headlines of an arena."""


_UNDELAYED = "mitigation, reference undelayed"
_TRAINED = "mitigation, reference delay-trained (the paper's way)"
_NO_MITIGATION, _MITIGATED = "no mitigation", "mitigated"

GAP_KINDS = (
    comparison_model.ContrastEntry(
        "target", "reference", WITHOUT, f"without {_UNDELAYED}", _NO_MITIGATION
    ),
    comparison_model.ContrastEntry(
        LATENCY_ALONE,
        "reference",
        LATENCY_ALONE,
        "latency of the target without its mass and power, reference undelayed",
        "latency alone",
    ),
    comparison_model.ContrastEntry(
        "compensated",
        "reference",
        COMPENSATED,
        "compensated in flight, not retrained, reference undelayed",
        "compensated",
    ),
    comparison_model.ContrastEntry(
        "compensated-pipelined",
        "reference",
        "compensated-pipelined",
        "compensated in flight, pipelined decisions, reference undelayed",
        "compensated, pipelined",
    ),
    comparison_model.ContrastEntry(
        "mitigated", "reference", WITH, f"with {_UNDELAYED}", _MITIGATED
    ),
    comparison_model.ContrastEntry(
        "mitigated-compensated",
        "reference",
        "both",
        "retrained and compensated in flight, reference undelayed",
        "mitigated, compensated",
    ),
    comparison_model.ContrastEntry(
        "target", "training", WITHOUT_TRAINED, f"without {_TRAINED}", _NO_MITIGATION
    ),
    comparison_model.ContrastEntry(
        "mitigated", "training", WITH_TRAINED, f"with {_TRAINED}", _MITIGATED
    ),
    comparison_model.ContrastEntry(
        "mitigated", "target", HELP, "mitigation against none, both on the target", "mitigation"
    ),
    comparison_model.ContrastEntry(
        "mitigated-reference",
        "reference",
        COST,
        "mitigated policy where nothing is late, reference undelayed",
        "mitigated, undelayed",
    ),
)
"""Pairs of roles that form gaps; runs with these roles replace them. The role `training` may have
several runs, one per source of latency."""


def build_hardware_gap(
    facts: Mapping[str, Any],
    entries: Sequence[comparison_model.RunEntry],
    runs: Mapping[str, LoadedRun],
) -> comparison_model.Comparison:
    """Return the gaps by `role` and arena (`group`), with published gaps and the worst seeds."""
    contrasts = [
        replace(kind, target=target.name, reference=reference.name)
        for group in dict.fromkeys(entry.group for entry in entries)
        for kind in GAP_KINDS
        for target in entries
        for reference in entries
        if target.group == reference.group == group
        and (target.role, reference.role) == (kind.target, kind.reference)
    ]
    where = Path(str(facts.get("latency") or facts.get("computer"))).name
    title = f"{facts.get('policy')} on {where}"
    comparison = compare(
        runs, contrasts, kind="hardware-gap", title=title, facts=facts, entries=entries
    )
    tables: dict[str, str] = {}
    published: dict[str, PublishedRun] = {}
    worst: dict[str, list[int]] = {}
    for arena in comparison.groups:
        table, columns = _published_columns(comparison, arena)
        if table:
            tables[arena] = table
        published |= columns
        flown = {run.entry.role: runs[run.name] for run in reversed(comparison.group(arena))}
        if "reference" in flown and "target" in flown:
            worst[arena] = worst_seeds(flown["reference"].episodes, flown["target"].episodes)
    comparison = replace(
        comparison,
        runs=tuple(replace(r, published=published.get(r.name)) for r in comparison.runs),
        contrasts=tuple(
            replace(
                contrast,
                published=published_gap(
                    published[contrast.entry.reference], published[contrast.entry.target]
                ),
            )
            if {contrast.entry.reference, contrast.entry.target} <= set(published)
            else contrast
            for contrast in comparison.contrasts
        ),
        extra={"worst_seeds": worst, "published_tables": tables},
    )
    told = [hardware_gap_sentence(comparison, arena) for arena in comparison.groups]
    return replace(comparison, answers=tuple(sentence for sentence in told if sentence))


def _published_columns(
    comparison: comparison_model.Comparison, arena: str
) -> tuple[str, dict[str, PublishedRun]]:
    """Return title and columns, by run name, of the published table for the same setup."""
    facts = comparison.facts
    asked = facts.get("computer"), facts.get("reference"), facts.get("latency")
    if asked == ("ras-pi-4", "workstation", None):
        for table in load_published().tables:
            if table.arena != Path(arena).stem:
                continue
            found = {
                run.name: column
                for run in comparison.group(arena)
                if (column := table.columns.get(run.entry.role)) is not None
                and _as_late(run.stages["t2"].mean, column.latency_ms)
            }
            if any(comparison.run(name).entry.role == "target" for name in found):
                return table.title, found
    return "", {}


def _as_late(t2_us: float | None, published_ms: float) -> bool:
    """Return True if the latency is close enough to the published latency for a comparison."""
    if t2_us is None:
        return False
    return abs(t2_us / US_PER_MS - published_ms) <= max(0.2 * published_ms, 20.0)


# --- tables


def runs_table(comparison: comparison_model.Comparison, arena: str) -> TableView:
    """Return the results of an arena's runs, one per row, each followed by published values."""
    columns = (
        Column("", number=False),
        Column("t2, mean\n[ms]"),
        Column("flights"),
        *(
            Column(f"{each.title}\n[{each.unit}]", page_only=each in PARTS_OF_ENERGY)
            for each in measures.ALL_MEASURES
        ),
    )
    rows = []
    for run in comparison.group(arena):
        rows.append(
            (
                run.mark,
                ms(run.stages["t2"].mean, 1),
                f"{run.quality.success_rate.n:,}",
                *(measure.with_interval(run.quality) for measure in measures.ALL_MEASURES),
            )
        )
        if run.published is not None:
            figures = [published_value(run, measure) for measure in measures.ALL_MEASURES]
            told = (NONE if figure is None else f"{figure:.4g}" for figure in figures)
            rows.append(("  paper", f"{run.published.latency_ms:g}", NONE, *told))
    notes = (
        "Each by itself; time, distance and energy: medians over its own flights that reached the "
        "goal, not the same ones in every row: compare by the gaps. The paper prints means. t2: of "
        "every decision. In brackets: 95 % intervals.",
    )
    return TableView(
        f"flown-{Path(arena).stem}",
        "Each run by itself",
        columns,
        tuple(rows),
        notes,
        stacked=True,
        in_terminal="without intervals",
    )


def gaps_table(comparison: comparison_model.Comparison, arena: str) -> TableView:
    """Return all gaps of an arena with intervals, each followed by the published gap."""
    notes = []
    runs = comparison.group(arena)
    by_rules: dict[str, list[str]] = {}
    for run in runs:
        by_rules.setdefault(run.entry.rules, []).append(run.mark)
    if len(by_rules) > 1:
        told = "; ".join(f"{', '.join(marks)}: {rules}" for rules, marks in by_rules.items())
        notes.append(f"Not all fly by the same rules, which makes differences too. {told}.")
    roles = {run.entry.role for run in runs}
    if "training" in roles:
        notes.append(
            "As trained: the sources of latency of the policy's own training. Its latencies are "
            "other draws than the target's: with the same ones the comparison would be of a policy "
            "with itself."
        )
    if table := comparison.extra["published_tables"].get(arena):
        notes.append(
            f"{THE_PAPER}: Air Learning, {table}, its gaps worked out here from its columns by the "
            "definition above. Its own arena, vehicle, network and latencies."
        )
        published = next(each for each in load_published().tables if each.title == table)
        if published.note and "mitigated" in roles:
            notes.append(published.note)
    return contrasts_table(comparison, comparison.contrasts_of(arena), "Hardware gap", notes)


def document_of(
    comparison: comparison_model.Comparison, runs: Mapping[str, LoadedRun], folder: Path
) -> Document:
    """Return the document of a hardware gap."""
    sections = [
        section
        for arena in comparison.groups
        for section in _arena_sections(comparison, runs, arena)
    ]
    return comparison_document(
        comparison,
        runs,
        folder,
        kicker="Hardware gap",
        sections=sections,
        facts=(*plain_facts(comparison), *common_rules(comparison)),
    )


def _arena_sections(
    comparison: comparison_model.Comparison, runs: Mapping[str, LoadedRun], arena: str
) -> list[Section]:
    name = Path(arena).stem
    flown, contrasts = comparison.group(arena), comparison.contrasts_of(arena)
    legend = tuple(
        (
            run.mark,
            f"{run.label}; t2 {run.setup.injection.label}"
            + ("" if run.published is None else f"; {THE_PAPER}: {run.published.label}"),
        )
        for run in flown
    )
    watts = {Path(r.setup.computer.name).stem: computer_power(r.setup) for r in flown}
    told = ", ".join(f"{computer} {power}" for computer, power in watts.items())
    by_itself = runs_table(comparison, arena)
    by_key = {contrast.entry.key: contrast for contrast in reversed(contrasts)}
    sections = [
        Section(name),
        *(
            Section(
                by_key[key].entry.title,
                3,
                headlines=contrast_headlines(by_key[key], digits=1),
                in_terminal=False,
            )
            for key in HEADLINED
            if key in by_key
        ),
        Section(
            by_itself.title,
            3,
            facts=legend,
            tables=(by_itself,),
            note=f"Energy: of the vehicle; that of the computer apart ({told}, times the flight "
            "time), then both. A computer on the ground takes nothing from the pack.",
        ),
    ]
    if contrasts:
        crosses = f" Crosses: {THE_PAPER}." if any(c.published for c in contrasts) else ""
        sections.append(
            Section(
                "Hardware gap",
                3,
                tables=(gaps_table(comparison, arena),),
                draw=lambda: contrast_pictures(f"hardware-gap-{name}", comparison, contrasts),
                sheet=f"hardware-gap-{name}.png",
                note="Dots: gaps on the same seeds, bars: their 95 % intervals."
                f"{crosses} The line of zero: no gap.",
            )
        )
    sections.append(
        Section(
            "The flights from above",
            3,
            draw=lambda: flight_pictures(f"flights-{name}", flight_panels(flown, runs, OVERLAID)),
            sheet=f"flights-{name}.png",
            note="The same seeds in every picture, each with obstacles of its own.",
            in_terminal=False,
        )
    )
    if worst := comparison.extra["worst_seeds"].get(arena):
        drawn = [run for role in WORST_ROLES for run in flown if run.entry.role == role]
        key = "; ".join(run.heading for run in drawn)
        sections.append(
            Section(
                "Seeds that lost most",
                3,
                draw=lambda: [seed_picture(f"worst-{name}-{s}", drawn, runs, s) for s in worst],
                sheet=f"worst-{name}.png",
                note=f"{key}. Of the seeds with which the reference reached the goal: first ones "
                "that failed on the target, then those that took longest against the reference. "
                "Obstacles as they stood at the start.",
                in_terminal=False,
            )
        )
    sections += [
        Section(view.title, 3, tables=(view,), in_terminal=False)
        for view in (contrast_table(comparison, each, measures.ALL_MEASURES) for each in contrasts)
    ]
    return sections
