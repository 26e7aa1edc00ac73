"""Page of a run: its sections in order."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from airl_mav.arena.geometry import Arena
from airl_mav.core.files import replace_file
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report import document, run_tables
from airl_mav.report.document import Section, tables_section
from airl_mav.report.energy_section import energy_section
from airl_mav.report.flights_above import overview_picture
from airl_mav.report.forensics.evidence import ranked
from airl_mav.report.forensics.worst import EXAMINED, causes_table, worst_table
from airl_mav.report.measures import RunSummary, conduct_table, rate_digits
from airl_mav.report.plotly_scene import plotly_script
from airl_mav.report.run_arenas import arenas_of, vehicle_of
from airl_mav.report.run_verdict import OverallVerdict, save_verdict, verdict_of
from airl_mav.report.shown_flights import (
    ReportInput,
    by_flight_section,
    flights_section,
    packed,
    page_data,
    report_input,
    shown,
)
from airl_mav.report.table import ms
from airl_mav.report.timeline import latency_section

YOUNG_OBJECTS = 50_000
"""Number of new containers that trigger a collection, instead of Python's 700."""


@contextmanager
def seldom_collected() -> Iterator[None]:
    """Reduce garbage collection during work that creates many long-lived objects.

    matplotlib builds figures from hundreds of thousands of objects. With Python's thresholds,
    garbage collection takes a fifth of a report's time; with these, almost no time, for a few MB
    more of memory. The previous thresholds are restored afterwards.
    """
    before = gc.get_threshold()
    gc.set_threshold(max(YOUNG_OBJECTS, before[0]) if before[0] else 0, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


@seldom_collected()
def write_report(
    run: LoadedRun | Path, out: Path | None = None, verdict: OverallVerdict | None = None
) -> Path:
    """Write a run's `report.html`, `verdict.json` and PNG files; return the page's path."""
    run = load(run) if isinstance(run, Path) else run
    vehicle = vehicle_of(run.info)
    arenas = arenas_of([*ranked(run)[:EXAMINED], *shown(run)], vehicle)
    verdict = verdict or verdict_of(run)
    page = build_page(run, arenas, out, vehicle=vehicle, verdict=verdict)
    save_verdict(verdict, page.parent)
    return page


def _setup(page: ReportInput) -> list[Section]:
    return [Section("What flew", facts=run_tables.setup_rows(page.run))]


def _quality(page: ReportInput) -> tuple[Section, ...]:
    feeds = not page.run.info.setup.computer_on_ground
    quality = run_tables.quality_table(page.summary, computer=feeds)
    return tables_section(quality, conduct_table(page.run, page.summary))


def _real_time(page: ReportInput) -> tuple[Section, ...]:
    return tables_section(run_tables.real_time_table(page.run, page.summary))


def _worst(page: ReportInput) -> tuple[Section, ...]:
    causes = tables_section(causes_table(page.worst, page.run))
    return causes + tables_section(worst_table(page.worst, len(page.run.episodes)))


def _estimator(page: ReportInput) -> tuple[Section, ...]:
    return tables_section(run_tables.estimation_table([flight.tracked for flight in page.view]))


def _provenance(page: ReportInput) -> list[Section]:
    info = page.run.info
    text = json.dumps(info.config, indent=2, ensure_ascii=False)
    facts = document.provenance_facts(info.machine, info.git, info.versions)
    return [Section("How it was made", facts=facts, template="provenance.html.j2", data=text)]


class PageSection(NamedTuple):
    """Section of a run's page."""

    anchor: str
    """Name in links to the section; empty = not in the contents list."""
    title: str
    """Entry in the contents list."""
    contents: Callable[[ReportInput], Sequence[Section]]
    """Function that returns the headings with their contents; empty = not on the page."""


SECTIONS = (
    PageSection("setup", "What flew", _setup),
    PageSection("quality", "Quality of flight", _quality),
    PageSection("", "Faults", lambda page: tables_section(run_tables.faults_table(page.run))),
    PageSection("", "Real time", _real_time),
    PageSection("worst", "Worst flights", _worst),
    PageSection("by-flight", "Flight by flight", by_flight_section),
    PageSection("estimator", "Estimator", _estimator),
    PageSection("latency", "Decision latency", latency_section),
    PageSection("energy", "Energy", energy_section),
    PageSection("flights", "Flights", flights_section),
    PageSection("made", "How it was made", _provenance),
)
"""Sections of a run's page, in order. To add one, write its function in a file, and a line here."""


def build_page(
    run: LoadedRun,
    arenas: Mapping[int, Arena],
    out: Path | None = None,
    *,
    vehicle: VehicleProfile | None = None,
    verdict: OverallVerdict | None = None,
) -> Path:
    """Write `report.html` and its PNG files, each atomically; return the page's path."""
    folder = out or run.path
    folder.mkdir(parents=True, exist_ok=True)
    page = report_input(run, arenas, vehicle)
    sections = [
        (entry, [document.draw_section(section, folder) for section in contents])
        for entry in SECTIONS
        if (contents := entry.contents(page))
    ]
    drawn = [picture for _, contents in sections for _, found in contents for picture in found]
    overview = overview_picture(run, arenas) if run.episodes else None
    if overview is not None:
        replace_file(folder / f"{overview.name}.png", overview.png)
    template = document.environment().get_template("report.html.j2")
    html = template.render(
        page=page,
        verdict=verdict,
        key_figures=run_headlines(run, page.summary),
        overview=overview,
        sections=sections,
        page_data=packed(page_data(page, drawn)),
        library=packed(plotly_script()) if page.view else "",
    )
    path = folder / document.REPORT_FILE
    replace_file(path, html.encode())
    return path


def run_headlines(run: LoadedRun, summary: RunSummary) -> list[document.Headline]:
    """Return the key figures of flight quality and latency."""
    q = summary.quality
    end_to_end = summary.stages["end_to_end"]
    t2 = summary.stages["t2"]
    origin = "modelled" if summary.modelled else run.info.setup.injection.origin
    return [
        *(
            document.estimate_headline(title, estimate.scaled(scale), unit, digits=digits)
            for title, estimate, scale, unit, digits in (
                ("success rate", q.success_rate, 100.0, "%", rate_digits(q.success_rate)),
                ("flight time", q.flight_time_s, 1.0, "s", 1),
                ("distance", q.distance_m, 1.0, "m", 1),
                ("energy", q.energy_j, 1e-3, "kJ", 1),
            )
        ),
        document.Headline("t2, median", ms(t2.p50, 1), "ms", f"{origin}, n = {t2.n:,}"),
        document.Headline(
            "end to end, median", ms(end_to_end.p50, 1), "ms", f"n = {end_to_end.n:,}"
        ),
    ]
