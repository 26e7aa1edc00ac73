"""The report as one HTML file that opens offline, and its pictures as PNG files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from airl_mav.arena.geometry import Arena
from airl_mav.core.files import replace_file
from airl_mav.flight.evidence import Cause
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.statistics import Estimate
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun, RunInfo
from airl_mav.report.ages import ages_table, run_ages
from airl_mav.report.energy import (
    energy_figure,
    energy_flights_table,
    energy_table,
    flight_energies,
)
from airl_mav.report.figures import latency_figure, latency_overview, map_figure, time_figure
from airl_mav.report.overview import overview_figure
from airl_mav.report.scene import ALL_FLIGHTS, SceneFlight, scene_json
from airl_mav.report.scene_figure import scene_figure
from airl_mav.report.summary import RunSummary, summarize_run
from airl_mav.report.tables import (
    NONE,
    ORIGIN_WORDS,
    OUTCOME_WORDS,
    episodes_table,
    latency_table,
    ms,
    quality_table,
    rate_digits,
    real_time_table,
    setup_rows,
)
from airl_mav.report.theme import Picture
from airl_mav.report.timeline import RULE_WORDS, slowest_table, timeline_figure, timeline_of
from airl_mav.report.worst import causes_table, flown_path, judge_worst, ranked, worst_table

REPORT_FILE = "report.html"

MAX_PICTURED = 12
"""Flights with pictures: the worst."""

MAX_LISTED = 200
"""Flights in the table: those that failed first."""


@dataclass(frozen=True)
class Flight:
    """One flight as the page shows it."""

    index: int
    seed: int
    outcome: str
    words: str
    reason: str
    cause: Cause | None
    notes: tuple[str, ...]
    pictures: tuple[Picture, ...]
    scene: int | None
    """Its number in the view in three dimensions; None where it has no path."""


@dataclass(frozen=True)
class Headline:
    """One figure at the top of the page."""

    title: str
    value: str
    unit: str
    detail: str


def build_report(
    run: LoadedRun,
    arenas: Mapping[int, Arena],
    out: Path | None = None,
    *,
    vehicle: VehicleProfile | None = None,
) -> Path:
    """Write `report.html` and the PNG files, each one whole or not at all.

    Args:
        run: The run, as `run_folder.load` returns it.
        arenas: The arena of each episode, by episode index; a flight without one is drawn without.
        out: Folder to write into; None is the run's own.
        vehicle: What flew; without it the energy has fewer parts, and the causes say less.

    Returns:
        The path of the page.
    """
    folder = out or run.path
    folder.mkdir(parents=True, exist_ok=True)
    summary = summarize_run(run)
    measured = [stage for stage in summary.shown_stages if summary.stages[stage.key].n]
    samples = [(s, summary.samples[s.key], summary.stages[s.key]) for s in measured]
    if samples:
        replace_file(folder / "latency.png", latency_overview(samples))
    decisions = timeline_of(run)
    timeline = timeline_figure(decisions, measured) if measured and len(decisions) else None
    energies = flight_energies(run, None if vehicle is None else vehicle.power)
    energy = energy_figure(energies) if energies else None
    overview = overview_figure(run, arenas) if needs_overview(run) else None
    judged = judge_worst(run, arenas, vehicle)
    shown = _shown(run, arenas)
    flights = _flights(run, arenas, shown, {j.record.index: j.cause for j in judged})
    solid = scene_figure(shown[0], _top_speed(shown)) if shown else None
    alone = [overview, timeline, energy, solid]
    pictures = [picture for flight in flights for picture in flight.pictures]
    for picture in [*pictures, *(picture for picture in alone if picture)]:
        replace_file(folder / f"{picture.name}.png", picture.png)
    everyone = ranked(run)[:ALL_FLIGHTS]
    fov = 0.0 if vehicle is None else vehicle.camera.horizontal_fov_deg
    page = (
        environment()
        .get_template("report.html.j2")
        .render(
            kind="Evaluation" if summary.modelled or "command" in run.info.config else "Rehearsal",
            run=run.info,
            folder=run.path.name,
            badges=[
                (outcome.value, OUTCOME_WORDS[outcome], count)
                for outcome, count in summary.quality.outcomes.items()
                if count
            ],
            headlines=_headlines(run, summary),
            origin=ORIGIN_WORDS[run.info.setup.injection.origin],
            setup=setup_rows(run),
            quality=quality_table(summary),
            real_time=real_time_table(run, summary) if summary.timed else None,
            overview=overview,
            worst=worst_table(judged, len(run.episodes)) if judged else None,
            causes=causes_table(judged, run),
            scene_picture=solid,
            scene_flights=[(k, flight) for k, flight in enumerate(shown)],
            scene_all=len(everyone),
            scene_data=Markup(scene_json(run, shown, everyone, fov)),  # noqa: S704 - escaped there
            scene_script=Markup(_script("scene.js")),  # noqa: S704 - our own
            energy=energy,
            energy_table=energy_table(energies) if energies else None,
            energy_flights=energy_flights_table(energies, MAX_LISTED) if energies else None,
            latency=latency_table(summary),
            ages=ages_table(run_ages(run), summary.stages["end_to_end"]),
            latency_pictures=[latency_figure(*part) for part in samples],
            timeline=timeline,
            timeline_rule=RULE_WORDS,
            slowest=slowest_table(decisions, measured) if len(decisions) else None,
            episodes=episodes_table(run, MAX_LISTED),
            flights=flights,
            flown=len(run.episodes),
            outcome_words=OUTCOME_WORDS,
            outcome_keys={words: outcome.value for outcome, words in OUTCOME_WORDS.items()},
            configuration=json.dumps(run.info.config, indent=2, ensure_ascii=False),
            provenance=provenance(run.info),
        )
    )
    path = folder / REPORT_FILE
    replace_file(path, page.encode())
    return path


def pictured(run: LoadedRun) -> list[EpisodeRecord]:
    """Return the episodes that get pictures, the worst first."""
    return ranked(run)[:MAX_PICTURED]


def needs_overview(run: LoadedRun) -> bool:
    """Return whether there are too many flights to be looked at one by one."""
    many = len(run.episodes) > MAX_PICTURED or run.info.setup.level == "gym"
    return many and bool(run.episodes)


def environment() -> Environment:
    """Return the template engine: everything escaped, nothing undefined passed over."""
    return Environment(
        loader=PackageLoader("airl_mav.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _script(name: str) -> str:
    """Return a script of the page, which travels with the templates."""
    return (files("airl_mav.report") / "templates" / name).read_text(encoding="utf-8")


def _shown(run: LoadedRun, arenas: Mapping[int, Arena]) -> list[SceneFlight]:
    """Return the flights with pictures that have a path, the worst first."""
    paths = [(episode, flown_path(run, episode)) for episode in pictured(run)]
    return [
        SceneFlight(episode, path, arenas.get(episode.index))
        for episode, path in paths
        if path is not None and len(path) > 1
    ]


def _top_speed(shown: Sequence[SceneFlight]) -> float:
    """Return the upper end of the colour scale of all paths [m/s]."""
    return max((float(flight.path.speed().max()) for flight in shown), default=0.0) or 1.0


def _flights(
    run: LoadedRun,
    arenas: Mapping[int, Arena],
    shown: Sequence[SceneFlight],
    causes: Mapping[int, Cause],
) -> list[Flight]:
    """Draw the flights that get pictures, the worst first."""
    numbers = {flight.record.index: k for k, flight in enumerate(shown)}
    top_speed = _top_speed(shown)
    flights = []
    for episode in pictured(run):
        number = numbers.get(episode.index)
        path = None if number is None else shown[number].path
        pictures = [map_figure(episode, path, arenas.get(episode.index), top_speed)]
        if path is not None:
            pictures.append(time_figure(episode, path))
        flights.append(
            Flight(
                index=episode.index,
                seed=episode.seed,
                outcome=episode.outcome.value,
                words=OUTCOME_WORDS[episode.outcome],
                reason=episode.reason,
                cause=causes.get(episode.index),
                notes=episode.notes,
                pictures=tuple(pictures),
                scene=number,
            )
        )
    return flights


def _headlines(run: LoadedRun, summary: RunSummary) -> list[Headline]:
    """Return the figures that answer the question: how late, how well."""
    q = summary.quality
    end_to_end = summary.stages["end_to_end"]
    t2 = summary.stages["t2"]
    origin = "modelled" if summary.modelled else run.info.setup.injection.origin
    return [
        _headline("success rate", q.success_rate, 100.0, rate_digits(q.success_rate), "%"),
        _headline("flight time", q.flight_time_s, 1.0, 1, "s"),
        _headline("distance", q.distance_m, 1.0, 1, "m"),
        _headline("energy", q.energy_j, 1e-3, 1, "kJ"),
        Headline("t2, median", ms(t2.p50, 1), "ms", f"{origin}, n = {t2.n:,}"),
        Headline("end to end, median", ms(end_to_end.p50, 1), "ms", f"n = {end_to_end.n:,}"),
    ]


def _headline(title: str, estimate: Estimate, scale: float, digits: int, unit: str) -> Headline:
    """Return an estimate as a headline."""
    if estimate.value is None:
        return Headline(title, NONE, "", f"n = {estimate.n}")
    detail = f"n = {estimate.n}"
    if estimate.low is not None and estimate.high is not None:
        low, high = scale * estimate.low, scale * estimate.high
        detail = f"{low:.{digits}f} … {high:.{digits}f}, n = {estimate.n}"
    return Headline(title, f"{scale * estimate.value:.{digits}f}", unit, detail)


def provenance(info: RunInfo) -> list[tuple[str, str]]:
    """Return machine, commit and versions, as (term, text)."""
    machine = dict(info.machine)
    if memory := machine.pop("memory_bytes", None):
        machine["memory"] = f"{memory / 1e9:.1f} GB"
    rows = [(name.replace("_", " "), f"{value}") for name, value in machine.items()]
    if info.git is not None:
        changed = " (with changes)" if info.git.get("changed") else ""
        rows.append(("commit", f"{info.git.get('commit')}{changed}"))
    return [*rows, *sorted(info.versions.items())]
