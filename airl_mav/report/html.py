"""The report as one HTML file that opens offline, and its pictures as PNG files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from airl_mav.arena.geometry import Arena
from airl_mav.atomic import replace_file
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.statistics import Estimate
from airl_mav.flight.trajectory import Trajectory
from airl_mav.harness.run_folder import LoadedRun, RunInfo
from airl_mav.report.figures import latency_figure, latency_overview, map_figure, time_figure
from airl_mav.report.overview import overview_figure
from airl_mav.report.summary import RunSummary, summarize_run
from airl_mav.report.tables import (
    NONE,
    ORIGIN_WORDS,
    OUTCOME_WORDS,
    episodes_table,
    failures_first,
    latency_table,
    ms,
    quality_table,
    rate_digits,
    real_time_table,
    setup_rows,
)
from airl_mav.report.theme import Picture

REPORT_FILE = "report.html"

MAX_PICTURED = 12
"""Flights with pictures: those that failed first."""

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
    notes: tuple[str, ...]
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class Headline:
    """One figure at the top of the page."""

    title: str
    value: str
    unit: str
    detail: str


def build_report(run: LoadedRun, arenas: Mapping[int, Arena], out: Path | None = None) -> Path:
    """Write `report.html` and the PNG files, each one whole or not at all.

    Args:
        run: The run, as `run_folder.load` returns it.
        arenas: The arena of each episode, by episode index; a flight without one is drawn without.
        out: Folder to write into; None is the run's own.

    Returns:
        The path of the page.
    """
    folder = out or run.path
    folder.mkdir(parents=True, exist_ok=True)
    summary = summarize_run(run)
    measured = [
        (stage, summary.samples[stage.key], summary.stages[stage.key])
        for stage in summary.shown_stages
        if summary.stages[stage.key].n
    ]
    latency_pictures = [latency_figure(*part) for part in measured]
    if measured:
        replace_file(folder / "latency.png", latency_overview(measured))
    overview = overview_figure(run, arenas) if needs_overview(run) else None
    flights = _flights(run, arenas)
    pictures = [picture for flight in flights for picture in flight.pictures]
    for picture in [*pictures, *([overview] if overview else [])]:
        replace_file(folder / f"{picture.name}.png", picture.png)
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
            latency=latency_table(summary),
            quality=quality_table(summary),
            episodes=episodes_table(run, MAX_LISTED),
            real_time=real_time_table(run, summary) if summary.timed else None,
            latency_pictures=latency_pictures,
            overview=overview,
            flights=flights,
            flown=len(run.episodes),
            outcome_keys={words: outcome.value for outcome, words in OUTCOME_WORDS.items()},
            configuration=json.dumps(run.info.config, indent=2, ensure_ascii=False),
            provenance=provenance(run.info),
        )
    )
    path = folder / REPORT_FILE
    replace_file(path, page.encode())
    return path


def pictured(run: LoadedRun) -> list[EpisodeRecord]:
    """Return the episodes that get pictures, in the order they were flown."""
    return failures_first(run.episodes, MAX_PICTURED)


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


def _flights(run: LoadedRun, arenas: Mapping[int, Arena]) -> list[Flight]:
    """Draw the flights that get pictures, in the order they were flown."""
    chosen = pictured(run)
    # Up to the verdict: what is recorded after it is the landing.
    paths = {
        episode.index: path.between(int(path.time_us[0]), episode.ended_us)
        for episode in chosen
        if (path := run.trajectories.get(episode.index)) is not None and len(path)
    }
    top_speed = max((float(path.speed().max(initial=0.0)) for path in paths.values()), default=0.0)
    return [
        _flight(episode, paths.get(episode.index), arenas.get(episode.index), top_speed or 1.0)
        for episode in chosen
    ]


def _flight(
    episode: EpisodeRecord, path: Trajectory | None, arena: Arena | None, top_speed: float
) -> Flight:
    """Draw one flight."""
    pictures = [map_figure(episode, path, arena, top_speed)]
    if path is not None and len(path) > 1:
        pictures.append(time_figure(episode, path))
    return Flight(
        index=episode.index,
        seed=episode.seed,
        outcome=episode.outcome.value,
        words=OUTCOME_WORDS[episode.outcome],
        reason=episode.reason,
        notes=episode.notes,
        pictures=tuple(pictures),
    )


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
