"""Page of a run: its sections in order, single flights, and the data of its script."""

from __future__ import annotations

import base64
import gc
import gzip
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import rgb_of
from airl_mav.core import addons, constants, files
from airl_mav.flight.episode_record import EpisodeRecord, ranked
from airl_mav.latency.stages import STAGES, decision_series
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun, arenas_of, flown_path, load, vehicle_of
from airl_mav.report import document, plotly_scene, run_tables, tracking
from airl_mav.report.document import Section, ms, tables_section
from airl_mav.report.measures import RunSummary, conduct_table, rate_digits, summarize_run
from airl_mav.report.policy_view import PolicyAgain, SeenDecision, policy_again, seen_decisions
from airl_mav.report.run_figures import map_figure, overview_picture
from airl_mav.report.run_verdict import OverallVerdict, save_verdict, verdict_of
from airl_mav.report.theme import FigureImage, palette, shades
from airl_mav.report.timeline import latency_section


class Steps(TypedDict):
    """Sequence of numbers stored as integer differences, which compress well."""

    unit: float
    """Value of a step of 1."""
    steps: list[int]
    """Differences from 0 to the first number and from each number to the next."""


LEVEL = 7
"""Compression level of gzip, 1 to 9; level 9 takes three times longer for 1 % smaller data."""


def packed(text: str) -> str:
    """Return a text as base64 of gzip; the output is reproducible."""
    return base64.b64encode(gzip.compress(text.encode(), compresslevel=LEVEL, mtime=0)).decode()


def steps_of(values: NDArray[np.float64] | Sequence[float], unit: float) -> Steps:
    """Encode finite numbers (n,) as steps of a unit, accurate to half a unit."""
    whole = np.round(np.asarray(values, np.float64) / unit).astype(np.int64)
    return {"unit": unit, "steps": np.diff(whole, prepend=0).tolist()}


TIME_POINTS = 1000
"""Maximum number of points of a line: 20 s at the recorded rate; longer flights are thinned."""

UNITS = {"_m_s": 0.01, "_m": 0.01, "_deg": 0.1, "_deg_s": 0.1, "thrust": 0.001}
"""Resolution of stored numbers by the suffix of their name."""

MAX_IMAGES = 24
"""Maximum number of decisions with an image: first, last and evenly spaced ones."""

LAST = 8
"""Number of these images from the last decisions, which led to the outcome."""

BEST = 5
"""Number of scores shown per decision, best first."""


def chosen(count: int, most: int = MAX_IMAGES, last: int = LAST) -> list[int]:
    """Return the indices of up to `most` of `count` decisions, increasing."""
    if count <= most:
        return list(range(count))
    before = np.linspace(0, count - last - 1, most - last).round().astype(int)
    return [*np.unique(before).tolist(), *range(count - last, count)]


def flight_data(
    flight: tracking.TrackedFlight,
    stamps: files.Arrays,
    seen: Sequence[SeenDecision],
    range_m: float,
    again: PolicyAgain | None,
) -> dict[str, Any]:
    """Return a flight as plain data, with depth up to `range_m` [m] and the policy's scores."""
    count = len(flight.time_s)
    keep = np.unique(np.linspace(0, count - 1, min(count, TIME_POINTS)).round().astype(int))
    commands = flight.commands
    return {
        "time": steps_of(flight.time_s[keep], 0.001),
        "flown": _lines(flight.flown, keep),
        "estimated": None if flight.estimated is None else _lines(flight.estimated, keep),
        "errors": None if flight.errors is None else _lines(flight.errors, keep),
        "power": None if flight.power_w is None else steps_of(flight.power_w[keep], 1.0),
        "motors": None
        if flight.motors is None
        else [steps_of(column, 0.002) for column in flight.motors[keep].T],
        "altitude": flight.altitude_m,
        "commands": {
            "sent": steps_of(commands.sent_s, 0.001),
            **{name: steps_of(values, _unit(name)) for name, values in commands.values.items()},
        },
        "stages": _stages(stamps),
        "seen": [_seen(seen[k], range_m, again) for k in chosen(len(seen))],
    }


def _lines(
    of: tracking.TrackedMotion | tracking.EstimateErrors, keep: NDArray[np.int64]
) -> dict[str, Steps]:
    known = {name: values for name, values in vars(of).items() if values is not None}
    return {name: steps_of(values[keep], _unit(name)) for name, values in known.items()}


def _unit(name: str) -> float:
    ends = [end for end in UNITS if name.endswith(end)]
    return UNITS[max(ends, key=len)]


def _stages(stamps: files.Arrays) -> dict[str, list[float | None]]:
    """Return the durations of the sent decisions by stage [ms]; None = unknown."""
    series = decision_series(stamps)
    sent = np.asarray(stamps.get("sent_us", np.zeros(0, np.int64)))
    there = sent != NO_STAMP
    found = {}
    for stage in STAGES:
        values = series.get(stage.key)
        if values is None or len(values) != len(sent) or (values[there] == NO_STAMP).all():
            continue
        found[stage.key] = [
            None if us == NO_STAMP else round(float(us) / constants.US_PER_MS, 2)
            for us in values[there]
        ]
    return found


def _seen(decision: SeenDecision, range_m: float, again: PolicyAgain | None) -> Mapping[str, Any]:
    """Return a decision: its image as base64, and its best actions."""
    seen = decision.image
    height, width = seen.shape[:2]
    # One palette byte per depth pixel, three bytes per colour pixel.
    pixels = rgb_of(seen) if seen.ndim == 3 else shades(seen, range_m)
    image = base64.b64encode(pixels.tobytes()).decode()
    told: dict[str, Any] = {"number": decision.number, "size": [width, height], "image": image}
    if decision.scores is not None and again is not None:
        best = np.argsort(-decision.scores, kind="stable")[:BEST]
        told["best"] = [
            [round(float(decision.scores[k]), 3), *np.round(again.actions[k], 3).tolist()]
            for k in best
        ]
        told["again"] = decision.again
    return told


MAX_PICTURED = 6
"""Maximum number of flights with still pictures, worst first."""

MAX_SHOWN = 24
"""Maximum number of flights in the view of single flights, worst first."""


@dataclass(frozen=True)
class ShownFlight:
    """Flight in the view of single flights."""

    scene: plotly_scene.SceneFlight
    tracked: tracking.TrackedFlight
    seen: tuple[SeenDecision, ...]
    """Recomputed decisions; empty if the arena or the vehicle is unknown."""


@dataclass(frozen=True)
class Cause:
    """Cause of a failed or long flight."""

    kind: str
    """Short name of the cause, equal for all flights with this cause."""
    sentences: tuple[str, ...]
    """Sentences with the supporting numbers."""


EXAMINED = 100
"""Maximum number of flights with a derived cause, worst first."""


@dataclass(frozen=True)
class ExaminedFlight:
    """Flight and its cause."""

    record: EpisodeRecord
    cause: Cause
    lost_s: float | None
    """Time lost relative to the run's median pace over the same straight line [s]."""
    excess: float | None
    """Excess of the flown distance over the straight line, as a fraction."""


@dataclass(frozen=True)
class ReportInput:
    """Run and data derived from it, for the sections of its page."""

    run: LoadedRun
    arenas: Mapping[int, Arena]
    """Arenas by episode index; flights without pictures and cause may be missing."""
    vehicle: VehicleProfile | None
    summary: RunSummary
    worst: Sequence[ExaminedFlight]
    """Causes of the worst flights; empty without the add-on forensics."""
    view: Sequence[ShownFlight]
    """Flights in the view of single flights, worst first."""
    policy: PolicyAgain | None

    @cached_property
    def numbers(self) -> dict[int, int]:
        """Number of each flight in the view, by episode index."""
        return {flight.scene.record.index: k for k, flight in enumerate(self.view)}


def pictured(run: LoadedRun) -> list[EpisodeRecord]:
    """Return the episodes with still pictures, worst first."""
    return ranked(run.episodes)[:MAX_PICTURED]


def shown(run: LoadedRun) -> list[EpisodeRecord]:
    """Return the episodes for the view of single flights, worst first."""
    return ranked(run.episodes)[:MAX_SHOWN]


def report_input(
    run: LoadedRun, arenas: Mapping[int, Arena], vehicle: VehicleProfile | None
) -> ReportInput:
    """Return the input of a run's page; the view skips flights without a path."""
    again = None if vehicle is None else policy_again(run.info)
    flights = []
    for record in shown(run):
        path, tracked, arena = (
            flown_path(run, record),
            tracking.track(run, record),
            arenas.get(record.index),
        )
        if path is None or tracked is None:
            continue
        seen: tuple[SeenDecision, ...] = ()
        if arena is not None and vehicle is not None:
            seen = tuple(seen_decisions(run, record, arena, vehicle, again))
        flights.append(ShownFlight(plotly_scene.SceneFlight(record, path, arena), tracked, seen))
    examine = addons.entries("airl_mav", "FORENSICS").get("examine")
    worst = addons.load(examine)(run, arenas, vehicle) if examine else []
    return ReportInput(run, arenas, vehicle, summarize_run(run), worst, flights, again)


def by_flight_section(page: ReportInput) -> tuple[Section, ...]:
    """Return the view of single flights; empty without recorded paths."""
    note = "Rendered again from the recorded path, without the camera's noise."
    asked = [d.again for flight in page.view for d in flight.seen if d.again is not None]
    if asked:
        chosen_again = f"{sum(asked):,} of {len(asked):,} decisions"
        note += f" The policy, asked again, chose the flown action in {chosen_again}."
    section = Section("Flight by flight", note=note, template="by_flight.html.j2", data=BEST)
    return (section,) if page.view else ()


def flights_section(page: ReportInput) -> tuple[Section, ...]:
    """Return the table of flights, and still pictures of the worst."""
    causes = {each.record.index: each.cause for each in page.worst}
    drawn: list[tuple[EpisodeRecord, Cause | None, list[FigureImage]]] = []
    for record in pictured(page.run):
        number = page.numbers.get(record.index)
        flight = None if number is None else page.view[number]
        path = None if flight is None else flight.scene.path
        pictures = [map_figure(record, path, page.arenas.get(record.index))]
        drawn.append((record, causes.get(record.index), pictures))
    return tables_section(
        run_tables.episodes_table(page.run, run_tables.MAX_FLIGHTS),
        draw=lambda: [picture for *_, pictures in drawn for picture in pictures],
        template="flights.html.j2",
        data=drawn,
    )


def page_data(page: ReportInput, pictures: Iterable[FigureImage]) -> str:
    """Return the data of the page's script as JSON: pictures, views and flights."""
    run, vehicle = page.run, page.vehicle
    fov, range_m = (0.0, 0.0) if vehicle is None else (
        vehicle.camera.horizontal_fov_deg, vehicle.camera.range_m,
    )  # fmt: skip
    data: dict[str, Any] = {
        "pictures": {picture.name: picture.svg for picture in pictures},
        "flights": [
            {
                **flight_data(
                    flight.tracked,
                    run.latency.get(flight.scene.record.index, {}),
                    flight.seen,
                    range_m,
                    page.policy,
                ),
                "faults": flight.scene.record.fault_spans_s(),
            }
            for flight in page.view
        ],
        "palette": palette(),
    }
    views = plotly_scene.scene_json([flight.scene for flight in page.view], fov)
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return f'{text[:-1]},"views":{views}}}'


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
    arenas = arenas_of([*ranked(run.episodes)[:EXAMINED], *shown(run)], vehicle)
    verdict = verdict or verdict_of(run)
    page = build_page(run, arenas, out, vehicle=vehicle, verdict=verdict)
    save_verdict(verdict, page.parent)
    return page


def _quality(page: ReportInput) -> tuple[Section, ...]:
    feeds = not page.run.info.setup.computer_on_ground
    quality = run_tables.quality_table(page.summary, computer=feeds)
    return tables_section(quality, conduct_table(page.run, page.summary))


def _worst(page: ReportInput) -> tuple[Section, ...]:
    section = addons.entries("airl_mav", "FORENSICS").get("section")
    return tuple(addons.load(section)(page)) if section else ()


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
    PageSection(
        "setup",
        "What flew",
        lambda page: [Section("What flew", facts=run_tables.setup_rows(page.run))],
    ),
    PageSection("quality", "Quality of flight", _quality),
    PageSection("", "Faults", lambda page: tables_section(run_tables.faults_table(page.run))),
    PageSection(
        "",
        "Real time",
        lambda page: tables_section(run_tables.real_time_table(page.run, page.summary)),
    ),
    PageSection("worst", "Worst flights", _worst),
    PageSection("by-flight", "Flight by flight", by_flight_section),
    PageSection("latency", "Decision latency", latency_section),
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
        files.replace_file(folder / f"{overview.name}.png", overview.png)
    template = document.environment().get_template("report.html.j2")
    html = template.render(
        page=page,
        verdict=verdict,
        key_figures=run_headlines(run, page.summary),
        overview=overview,
        sections=sections,
        page_data=packed(page_data(page, drawn)),
        library=packed(plotly_scene.plotly_script()) if page.view else "",
    )
    path = folder / document.REPORT_FILE
    files.replace_file(path, html.encode())
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
                ("flight time, median", q.flight_time_s, 1.0, "s", 1),
                ("distance, median", q.distance_m, 1.0, "m", 1),
                ("energy, median", q.energy_j, 1e-3, "kJ", 1),
            )
        ),
        document.Headline("t2, median", ms(t2.p50, 1), "ms", f"{origin}, n = {t2.n:,}"),
        document.Headline(
            "end to end, median", ms(end_to_end.p50, 1), "ms", f"n = {end_to_end.n:,}"
        ),
    ]
