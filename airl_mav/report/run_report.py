"""Report of a run on a page and in the terminal."""

from __future__ import annotations

import gc
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
from markupsafe import Markup
from rich.console import Console

from airl_mav.arena.geometry import Arena
from airl_mav.core.files import replace_file
from airl_mav.core.progress import DRAWING, Progress
from airl_mav.flight.requirements import Requirement
from airl_mav.flight.statistics import aggregate
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report import document, run_tables
from airl_mav.report.document import print_place, print_verdict
from airl_mav.report.energy_section import (
    energy_figure,
    energy_flights_table,
    energy_table,
    flight_energies,
)
from airl_mav.report.flights_above import overview_picture
from airl_mav.report.forensics.worst import causes_table, examine_worst, worst_table
from airl_mav.report.measures import RunSummary, conduct_table, rate_digits, summarize_run
from airl_mav.report.plotly_scene import ALL_FLIGHTS, plotly_script
from airl_mav.report.run_arenas import arenas_of, vehicle_of
from airl_mav.report.run_figures import latency_figure
from airl_mav.report.run_tables import ages_table, estimation_table, faults_table, run_ages
from airl_mav.report.run_verdict import (
    OverallVerdict,
    judge_run,
    requirements_of,
    save_verdict,
    unchecked,
)
from airl_mav.report.shown_flights import (
    BEST,
    ShownFlights,
    packed,
    page_data,
    pictured_flights,
    shown_flights,
)
from airl_mav.report.table import OUTCOME_LABELS, count_outcomes, ms, print_facts, print_table
from airl_mav.report.theme import montage
from airl_mav.report.timeline import (
    OUTLIER_NOTE,
    sawtooth_notes,
    slowest_table,
    timeline_figure,
    timeline_of,
)

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


MAX_PRINTED = 25
"""Maximum number of flights listed in the terminal."""


def verdict_of(run: LoadedRun, requirements: Sequence[Requirement] | None = None) -> OverallVerdict:
    """Return a run's verdict; `requirements` default to the requirements of `verdict.json`."""
    if requirements is None:
        requirements = requirements_of(run.path)
    verdict = judge_run(run.info.setup, aggregate(run.episodes), run.episodes, requirements)
    return replace(verdict, sentences=verdict.sentences + unchecked([run.info]))


@seldom_collected()
def write_report(
    run: LoadedRun | Path, out: Path | None = None, verdict: OverallVerdict | None = None
) -> Path:
    """Write a run's `report.html`, `verdict.json` and PNG files; return the page's path."""
    # Imported here: loading the figures takes as long as flying and judging ten flights.
    from airl_mav.report.forensics.evidence import ranked
    from airl_mav.report.forensics.worst import EXAMINED
    from airl_mav.report.run_report import build_page
    from airl_mav.report.shown_flights import shown

    if isinstance(run, Path):
        run = load(run)
    vehicle = vehicle_of(run.info)
    arenas = arenas_of([*ranked(run)[:EXAMINED], *shown(run)], vehicle)
    verdict = verdict or verdict_of(run)
    page = build_page(run, arenas, out, vehicle=vehicle, verdict=verdict)
    save_verdict(verdict, page.parent)
    return page


def print_report(run: LoadedRun, console: Console, verdict: OverallVerdict) -> None:
    """Print the verdict, the setup and the tables."""
    print_verdict(verdict.lines, console)
    console.print()
    summary, feeds = summarize_run(run), not run.info.setup.computer_on_ground
    flights = count_outcomes([episode.outcome for episode in run.episodes])
    print_facts([*run_tables.setup_rows(run), ("flights", flights)], console)
    views = [
        run_tables.latency_table(summary),
        run_tables.episodes_table(run, MAX_PRINTED),
        run_tables.quality_table(summary, computer=feeds),
    ]
    if (conduct := conduct_table(run, summary)) is not None:
        views.append(conduct)
    if (faults := faults_table(run)) is not None:
        views.append(faults)
    if summary.timed:
        views.append(run_tables.real_time_table(run, summary))
    for view in views:
        console.print()
        print_table(view, console)


def show_report(
    run: LoadedRun,
    verdict: OverallVerdict,
    console: Console,
    progress: Progress | None = None,
    *,
    draw: bool = True,
) -> Path | None:
    """Print the report of a run, then draw its page or print the command that draws it."""
    progress = progress or Progress()
    if run.episodes:
        save_verdict(verdict, run.path)
    print_report(run, console, verdict)
    if not run.episodes:
        return None
    if not draw:
        print_place("report", f"airl report {shlex.quote(str(run.path))}", console)
        return None
    progress.status(DRAWING)
    page = write_report(run, verdict=verdict)
    progress.status(None)
    print_place("report", page, console)
    return page


SCRIPTS = ("scene.js", "tracks.js", "seen.js", "page.js")
"""Scripts of the page in order of dependency."""

MAX_LISTED = 200
"""Maximum number of flights in the table, failed flights preferred."""


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
    summary = summarize_run(run)
    measured = [stage for stage in summary.shown_stages if summary.stages[stage.key].n]
    # Constant stages need no figure: the table already shows their value.
    drawn = [stage for stage in measured if np.ptp(summary.samples[stage.key])]
    samples = [(s, summary.samples[s.key], summary.stages[s.key]) for s in drawn]
    latency_pictures = [latency_figure(*part) for part in samples]
    if latency_pictures:
        replace_file(folder / "latency.png", montage(latency_pictures, document.SHEET_COLUMNS))
    decisions = timeline_of(run)
    timeline = timeline_figure(decisions, drawn) if drawn and len(decisions) else None
    energies, on_ground = flight_energies(run, vehicle), run.info.setup.computer_on_ground
    energy = energy_figure(energies, on_ground=on_ground) if energies else None
    judged = examine_worst(run, arenas, vehicle)
    view = shown_flights(run, arenas, vehicle)
    range_m = 0.0 if vehicle is None else vehicle.camera.range_m
    causes = {j.record.index: j.cause for j in judged}
    flights = pictured_flights(run, arenas, view, causes, range_m)
    overview = overview_picture(run, arenas) if run.episodes else None
    packed_pictures = [
        *(picture for flight in flights for picture in flight.pictures),
        *(picture for picture in (timeline, energy) if picture),
    ]
    for picture in [*packed_pictures, *([overview] if overview else [])]:
        replace_file(folder / f"{picture.name}.png", picture.png)
    data = page_data(run, view, [*packed_pictures, *latency_pictures], vehicle)
    slowest = slowest_table(decisions, measured) if len(decisions) else None
    page = (
        document.environment()
        .get_template("report.html.j2")
        .render(
            kind=_kind(run, summary),
            run=run.info,
            folder=run.path.name,
            badges=[
                (outcome.value, OUTCOME_LABELS[outcome], count)
                for outcome, count in summary.quality.outcomes.items()
                if count
            ],
            verdict=() if verdict is None else verdict.lines,
            status="" if verdict is None else verdict.status,
            headlines=run_headlines(run, summary),
            origin=run.info.setup.injection.origin,
            setup=run_tables.setup_rows(run),
            quality=run_tables.quality_table(summary, computer=not on_ground),
            conduct=conduct_table(run, summary),
            faults=faults_table(run),
            real_time=run_tables.real_time_table(run, summary) if summary.timed else None,
            overview=overview,
            worst=worst_table(judged, len(run.episodes)) if judged else None,
            worst_links=[_link(view, j.record.index) for j in judged],
            causes=causes_table(judged, run),
            scene_flights=[(k, flight.scene) for k, flight in enumerate(view.flights)],
            scene_all=min(len(run.episodes), ALL_FLIGHTS),
            scores_title=_scores_title(view),
            seen_note=view.note,
            estimation=estimation_table([flight.tracked for flight in view.flights]),
            page_data=packed(data),
            library=packed(plotly_script()) if view.flights else "",
            script=Markup(_script()),  # noqa: S704 - our own
            energy=energy,
            energy_table=energy_table(energies, on_ground=on_ground) if energies else None,
            energy_flights=energy_flights_table(energies, MAX_LISTED) if energies else None,
            latency=run_tables.latency_table(summary),
            ages=ages_table(run_ages(run), summary.stages["end_to_end"]),
            latency_pictures=latency_pictures,
            timeline=timeline,
            timeline_notes=[*sawtooth_notes(decisions, vehicle), OUTLIER_NOTE],
            slowest=None if slowest is None else slowest[0],
            slowest_links=[] if slowest is None else [_link(view, *each) for each in slowest[1]],
            episodes=run_tables.episodes_table(run, MAX_LISTED),
            flights=flights,
            flown=len(run.episodes),
            configuration=json.dumps(run.info.config, indent=2, ensure_ascii=False),
            provenance=document.provenance_facts(run.info.machine, run.info.git, run.info.versions),
        )
    )
    path = folder / document.REPORT_FILE
    replace_file(path, page.encode())
    return path


def _kind(run: LoadedRun, summary: RunSummary) -> str:
    if run.info.setup.level == "flight":
        return "Flight"
    return "Evaluation" if summary.modelled or "command" in run.info.config else "Rehearsal"


def _script() -> str:
    folder = files("airl_mav.report") / "templates"
    return "\n".join((folder / name).read_text(encoding="utf-8") for name in SCRIPTS)


def _link(
    view: ShownFlights, index: int, seconds: float | None = None
) -> tuple[int, float | None] | None:
    """Return the number of a flight in the view of single flights, and a time in it [s]."""
    number = view.numbers.get(index)
    return None if number is None else (number, None if seconds is None else round(seconds, 3))


def _scores_title(view: ShownFlights) -> str:
    """Return the heading of the list of actions and scores."""
    if view.policy is None:
        return ""
    return f"{BEST} best of {len(view.policy.actions)} actions and their {view.policy.scores_are}s"


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
