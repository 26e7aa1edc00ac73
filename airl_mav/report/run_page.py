"""The report of a run as one HTML file that opens offline, and its pictures as PNG files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from markupsafe import Markup

from airl_mav.arena.geometry import Arena
from airl_mav.core.files import replace_file
from airl_mav.flight.record import EpisodeRecord
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.ages import ages_table, run_ages
from airl_mav.report.conduct import conduct_table
from airl_mav.report.document import (
    REPORT_FILE,
    SHEET_COLUMNS,
    Headline,
    environment,
    estimate_headline,
    provenance_facts,
)
from airl_mav.report.energy import (
    energy_figure,
    energy_flights_table,
    energy_table,
    flight_energies,
)
from airl_mav.report.faults import faults_table
from airl_mav.report.flights_above import overview_picture
from airl_mav.report.forensics.evidence import Cause
from airl_mav.report.forensics.worst import (
    causes_table,
    examine_worst,
    flown_path,
    ranked,
    worst_table,
)
from airl_mav.report.measures import rate_digits
from airl_mav.report.run_figures import latency_figure, map_figure, time_figure
from airl_mav.report.run_summary import RunSummary, summarize_run
from airl_mav.report.run_tables import (
    episodes_table,
    latency_table,
    quality_table,
    real_time_table,
    setup_rows,
)
from airl_mav.report.scene import ALL_FLIGHTS, SceneFlight, plotly_script, scene_json, top_speed
from airl_mav.report.table import OUTCOME_LABELS, ms
from airl_mav.report.theme import Picture, montage
from airl_mav.report.timeline import OUTLIER_NOTE, slowest_table, timeline_figure, timeline_of
from airl_mav.report.verdict import OverallVerdict

MAX_PICTURED = 12
"""Flights with pictures: the worst."""

MAX_LISTED = 200
"""Flights in the table: those that failed first."""


@dataclass(frozen=True)
class PicturedFlight:
    """One flight that the page shows by itself."""

    record: EpisodeRecord
    cause: Cause | None
    pictures: tuple[Picture, ...]
    scene: int | None
    """Its number in the view in three dimensions; None where it has no path."""


def build_page(
    run: LoadedRun,
    arenas: Mapping[int, Arena],
    out: Path | None = None,
    *,
    vehicle: VehicleProfile | None = None,
    verdict: OverallVerdict | None = None,
) -> Path:
    """Write `report.html` and the PNG files, each one whole or not at all.

    Args:
        run: The run, as `run_folder.load` returns it.
        arenas: The arena of each episode, by episode index; a flight without one is drawn without.
        out: Folder to write into; None is the run's own.
        vehicle: What flew; without it the energy has fewer parts, and the causes say less.
        verdict: Heads the page.

    Returns:
        The path of the page.
    """
    folder = out or run.path
    folder.mkdir(parents=True, exist_ok=True)
    summary = summarize_run(run)
    measured = [stage for stage in summary.shown_stages if summary.stages[stage.key].n]
    samples = [(s, summary.samples[s.key], summary.stages[s.key]) for s in measured]
    latency_pictures = [latency_figure(*part) for part in samples]
    if latency_pictures:
        replace_file(folder / "latency.png", montage(latency_pictures, SHEET_COLUMNS))
    decisions = timeline_of(run)
    timeline = timeline_figure(decisions, measured) if measured and len(decisions) else None
    energies = flight_energies(run, vehicle)
    energy = energy_figure(energies) if energies else None
    overview = overview_picture(run, arenas) if needs_overview(run) else None
    judged = examine_worst(run, arenas, vehicle)
    shown = _shown(run, arenas)
    flights = _flights(run, arenas, shown, {j.record.index: j.cause for j in judged})
    alone = [overview, timeline, energy]
    pictures = [picture for flight in flights for picture in flight.pictures]
    for picture in [*pictures, *(picture for picture in alone if picture)]:
        replace_file(folder / f"{picture.name}.png", picture.png)
    everyone = ranked(run)[:ALL_FLIGHTS]
    fov = 0.0 if vehicle is None else vehicle.camera.horizontal_fov_deg
    page = (
        environment()
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
            headlines=_headlines(run, summary),
            origin=run.info.setup.injection.origin,
            setup=setup_rows(run),
            quality=quality_table(summary),
            conduct=conduct_table(run, summary),
            faults=faults_table(run),
            real_time=real_time_table(run, summary) if summary.timed else None,
            overview=overview,
            worst=worst_table(judged, len(run.episodes)) if judged else None,
            causes=causes_table(judged, run),
            scene_flights=[(k, flight) for k, flight in enumerate(shown)],
            scene_all=len(everyone),
            scene_data=Markup(scene_json(run, shown, everyone, fov)),  # noqa: S704 - escaped there
            scene_scripts=[Markup(text) for text in _scripts()] if shown else [],  # noqa: S704 - our own
            energy=energy,
            energy_table=energy_table(energies) if energies else None,
            energy_flights=energy_flights_table(energies, MAX_LISTED) if energies else None,
            latency=latency_table(summary),
            ages=ages_table(run_ages(run), summary.stages["end_to_end"]),
            latency_pictures=latency_pictures,
            timeline=timeline,
            timeline_rule=OUTLIER_NOTE,
            slowest=slowest_table(decisions, measured) if len(decisions) else None,
            episodes=episodes_table(run, MAX_LISTED),
            flights=flights,
            flown=len(run.episodes),
            configuration=json.dumps(run.info.config, indent=2, ensure_ascii=False),
            provenance=provenance_facts(run.info.machine, run.info.git, run.info.versions),
        )
    )
    path = folder / REPORT_FILE
    replace_file(path, page.encode())
    return path


def _kind(run: LoadedRun, summary: RunSummary) -> str:
    if run.info.setup.level == "flight":
        return "Flight"
    return "Evaluation" if summary.modelled or "command" in run.info.config else "Rehearsal"


def pictured(run: LoadedRun) -> list[EpisodeRecord]:
    """Return the episodes that get pictures, the worst first."""
    return ranked(run)[:MAX_PICTURED]


def needs_overview(run: LoadedRun) -> bool:
    """Return whether there are too many flights to be looked at one by one."""
    many = len(run.episodes) > MAX_PICTURED or run.info.setup.level == "gym"
    return many and bool(run.episodes)


def _scripts() -> list[str]:
    """Return the scripts of the page: the library, and what shows the views with it."""
    own = files("airl_mav.report") / "templates" / "scene.js"
    return [plotly_script(), own.read_text(encoding="utf-8")]


def _shown(run: LoadedRun, arenas: Mapping[int, Arena]) -> list[SceneFlight]:
    """Return the flights with pictures that have a path, the worst first."""
    paths = [(episode, flown_path(run, episode)) for episode in pictured(run)]
    return [
        SceneFlight(episode, path, arenas.get(episode.index))
        for episode, path in paths
        if path is not None and len(path) > 1
    ]


def _flights(
    run: LoadedRun,
    arenas: Mapping[int, Arena],
    shown: Sequence[SceneFlight],
    causes: Mapping[int, Cause],
) -> list[PicturedFlight]:
    """Draw the flights that get pictures, the worst first."""
    numbers = {flight.record.index: k for k, flight in enumerate(shown)}
    top = top_speed(shown)
    flights = []
    for episode in pictured(run):
        number = numbers.get(episode.index)
        path = None if number is None else shown[number].path
        pictures = [map_figure(episode, path, arenas.get(episode.index), top)]
        if path is not None:
            pictures.append(time_figure(episode, path))
        flights.append(PicturedFlight(episode, causes.get(episode.index), tuple(pictures), number))
    return flights


def _headlines(run: LoadedRun, summary: RunSummary) -> list[Headline]:
    """Return the figures that answer the question: how late, how well."""
    q = summary.quality
    end_to_end = summary.stages["end_to_end"]
    t2 = summary.stages["t2"]
    origin = "modelled" if summary.modelled else run.info.setup.injection.origin
    return [
        *(
            estimate_headline(title, estimate.scaled(scale), unit, digits=digits)
            for title, estimate, scale, unit, digits in (
                ("success rate", q.success_rate, 100.0, "%", rate_digits(q.success_rate)),
                ("flight time", q.flight_time_s, 1.0, "s", 1),
                ("distance", q.distance_m, 1.0, "m", 1),
                ("energy", q.energy_j, 1e-3, "kJ", 1),
            )
        ),
        Headline("t2, median", ms(t2.p50, 1), "ms", f"{origin}, n = {t2.n:,}"),
        Headline("end to end, median", ms(end_to_end.p50, 1), "ms", f"n = {end_to_end.n:,}"),
    ]
