"""Tables of a run's report, shared by the terminal and the page, and the report in the terminal."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from airl_mav.core import constants, machine, resource_use
from airl_mav.core.progress import DRAWING, Progress
from airl_mav.flight.episode_record import EpisodeRecord, Part, Setup, run_sha256
from airl_mav.flight.judge import Outcome
from airl_mav.latency.stages import CommandAges, Summary, command_ages, summarize
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.rehearsal.run_folder import EPISODES_FILE, TICK_LATENESS, LoadedRun
from airl_mav.report import document, run_verdict
from airl_mav.report.document import print_place, print_verdict
from airl_mav.report.measures import (
    COMPUTER_ENERGY,
    DISTANCE,
    ENERGY,
    FLIGHT_TIME,
    MEAN_SPEED,
    PACK,
    SUCCESS_RATE,
    RunSummary,
    conduct_table,
    rate_digits,
    summarize_run,
)

BYTES_PER_MIB = 1 << 20

MAX_FLIGHTS = 200
"""Maximum number of flights in a table of the page, failed flights preferred."""


def setup_rows(run: LoadedRun) -> tuple[tuple[str, str], ...]:
    """Return the setup of a run as (term, text)."""
    setup = run.info.setup
    injection = setup.injection
    latency = f"{injection.origin}: {injection.label}"
    pace = "not paced: as fast as it goes" if setup.speed is None else f"{setup.speed:g} x"
    rows = [
        ("vehicle", _part(setup.vehicle)),
        ("arena", _part(setup.arena)),
        ("conditions", setup.conditions),
        ("policy", _part(setup.policy)),
        ("computer", f"{_part(setup.computer)}, {computer_power(setup)}"),
        ("decision latency t2", latency),
        ("source of t2", injection.source),
        ("assumed of t2", injection.assumed),
        ("level", setup.level),
        ("firmware", setup.firmware),
        ("speed", pace),
        ("between commands", setup.between_commands),
        ("flown with", machine.flown_with(episode.code for episode in run.episodes)),
        ("sha256 of the flights", run_sha256(run.episodes) or ""),
    ]
    return tuple((term, text) for term, text in rows if text)


def computer_power(setup: Setup) -> str:
    """Return the text for a computer's power draw from the aircraft's pack."""
    return "on the ground" if setup.computer_on_ground else f"{setup.computer_watts:g} W"


def _part(part: Part) -> str:
    return f"{part.name} – {part.description}" if part.description else part.name


def latency_table(summary: RunSummary) -> document.TableView:
    """Return the latencies by stage."""
    head, last = document.columns_of("<stage | *<from → to")
    columns = (head, *document.DURATION_COLUMNS, last)
    rows, short = [], False
    for stage in summary.shown_stages:
        cells = document.duration_cells(summary.stages[stage.key])
        short = short or document.TOO_FEW_CELL in cells
        rows.append((stage.title, *cells, stage.meaning))
    notes = ["Milliseconds of simulated time."]
    if summary.modelled:
        notes.append(
            "Level gym measures no time: transport and link are constants of its model, t2 is "
            "drawn from the distribution named above."
        )
    if short:
        notes.append(document.TOO_FEW_NOTE)
    return document.TableView("latency", "Decision latency", columns, tuple(rows), tuple(notes))


def failures_first(episodes: Sequence[EpisodeRecord], most: int) -> list[EpisodeRecord]:
    """Return up to `most` episodes in flown order, failed episodes preferred."""
    ranked = sorted(episodes, key=lambda e: (e.outcome is Outcome.SUCCESS, e.index))
    return sorted(ranked[:most], key=lambda e: e.index)


def episodes_table(run: LoadedRun, most: int | None = None) -> document.TableView:
    """Return the quality of up to `most` flights, failed flights preferred."""
    feeds = not run.info.setup.computer_on_ground
    columns = document.columns_of(
        "# | seed | <outcome | time [s] | distance [m] | energy [kJ] | speed [m/s] | "
        f"*top speed [m/s]{' | *computer [J]' if feeds else ''} | *take-off [s, kJ] | "
        "*battery [%] | *<why"
    )
    total = len(run.episodes)
    shown = run.episodes if most is None else failures_first(run.episodes, most)
    rows = tuple(_episode_row(episode, computer=feeds) for episode in shown)
    notes = ["From the start of navigation; the take-off apart."]
    if feeds:
        notes[0] += " Energy without the computer's."
    if len(shown) < total:
        notes.append(
            f"{len(shown)} of {total:,} flights, those that failed first; all: {EPISODES_FILE}."
        )
    return document.TableView("episodes", "Flights", columns, rows, tuple(notes))


def _episode_row(episode: EpisodeRecord, *, computer: bool) -> tuple[str, ...]:
    q = episode.quality
    figures = (
        (document.NONE,) * (6 + computer)
        if q is None
        else (
            f"{q.flight_time_s:.2f}",
            f"{q.distance_m:.2f}",
            _kilojoules(q.energy_j),
            f"{q.mean_speed_m_s:.2f}",
            f"{q.max_speed_m_s:.2f}",
            *([f"{q.computer_energy_j:,.0f}"] if computer else []),
            f"{q.takeoff.time_s:.2f}, {_kilojoules(q.takeoff.energy_j)}",
        )
    )
    battery = episode.battery_remaining
    left = document.NONE if battery is None else f"{100.0 * battery:.1f}"
    why = "; ".join([episode.reason, *episode.notes])
    label = document.OUTCOME_LABELS[episode.outcome]
    return (f"{episode.index}", f"{episode.seed}", label, *figures, left, why)


def _kilojoules(joules: float | None) -> str:
    return document.NONE if joules is None else f"{joules / 1e3:.2f}"


def quality_table(summary: RunSummary, *, computer: bool = True) -> document.TableView:
    """Return the flight quality with intervals; `computer` adds the row of its energy."""
    columns = document.columns_of("<measure | value | 95 % interval | *mean | n")
    q = summary.quality
    rate = replace(SUCCESS_RATE, digits=rate_digits(q.success_rate))
    measures = [rate, FLIGHT_TIME, DISTANCE, ENERGY]
    if computer:
        measures.append(replace(COMPUTER_ENERGY, unit="J", scale=1.0, digits=0))
    measures.append(MEAN_SPEED)
    measures += [measure for measure in PACK if measure.of(q).n]
    rows = []
    for measure in measures:
        estimate, mean = measure.of(q), measure.plain(summary.means.get(measure.key))
        value, interval = measure.plain(estimate.value, unit=True), measure.interval(estimate)
        rows.append((measure.title, value, interval, mean, f"{estimate.n}"))
    notes = [
        "Medians over the flights that reached the goal; n is their number (for the success rate: "
        "all valid flights). Intervals: Wilson for the rate, order statistics for the medians."
    ]
    if q.endurance_s.n:
        notes.append(
            "Endurance, range and missions: the whole charge at the start, at the mean power and "
            "speed of each flight with its computer, take-off and landing left out."
        )
    return document.TableView("quality", "Quality of flight", columns, tuple(rows), tuple(notes))


def real_time_table(run: LoadedRun, summary: RunSummary) -> document.TableView | None:
    """Return real-time pace and the companion's resource use; None for runs in simulated time."""
    if not summary.timed:
        return None
    columns = document.columns_of("<measure | value | n")
    nothing: NDArray[np.int64] = np.zeros(0, np.int64)
    lateness = [stamps.get(TICK_LATENESS, nothing) for stamps in run.latency.values()]
    accepted = [stamps["accepted_us"] for stamps in run.latency.values() if "accepted_us" in stamps]
    unmatched = sum(int(np.count_nonzero(stamps == NO_STAMP)) for stamps in accepted)
    flights = f"{len(run.episodes)}"
    slipped_us = sum(episode.slipped_us for episode in run.episodes)
    uses = [e.companion_use for e in run.episodes if e.companion_use]
    if run.info.setup.level == "flight":
        return document.TableView("real-time", "Companion", columns, tuple(_use_rows(uses)))
    rows = [
        *_tail_rows("tick lateness", summarize(np.concatenate([nothing, *lateness]))),
        ("real-time factor", _real_time_factor(run), flights),
        ("simulated time given up", f"{document.ms(slipped_us)} ms", flights),
        *_tail_rows("setpoint → motor", summary.stages["setpoint_to_motor"]),
        ("setpoints never accepted", f"{unmatched:,}", f"{sum(map(len, accepted)):,}"),
        *_use_rows(uses),
    ]
    return document.TableView("real-time", "Real time", columns, tuple(rows))


def _use_rows(uses: Sequence[resource_use.ProcessUse]) -> list[tuple[str, ...]]:
    if not uses:
        return []
    n, wall_s = f"{len(uses)}", sum(use.wall_s for use in uses)
    cores = f"{sum(use.cpu_s for use in uses) / wall_s:.2f} cores" if wall_s else document.NONE
    mean_s = sum(use.cpu_s for use in uses) / len(uses)
    peaks = [use.peak_memory_bytes for use in uses if use.peak_memory_bytes is not None]
    begun = all(use.peak_since == "begin" for use in uses)
    since = "of any flight" if begun else "since the process began"
    powers = [use.power_w for use in uses if use.power_w is not None]
    watts = f"{np.mean(powers):.1f} W ({uses[-1].power_source})" if powers else document.NONE
    return [
        ("companion, processor time a flight", f"{mean_s:.2f} s, {cores}", n),
        (
            f"companion, greatest memory {since}",
            f"{max(peaks) / BYTES_PER_MIB:.0f} MiB" if peaks else document.NONE,
            f"{len(peaks)}",
        ),
        ("mean power of the machine", watts, f"{len(powers)}"),
    ]


def _tail_rows(title: str, summary: Summary) -> list[tuple[str, ...]]:
    n = summary.n
    if not n:
        return [(title, document.NONE, "0")]
    p99 = document.percentile_cell(summary.p99, n)
    return [
        (f"{title}, p50", f"{document.ms(summary.p50)} ms", f"{n:,}"),
        (f"{title}, p99", p99 if p99 == document.TOO_FEW_CELL else f"{p99} ms", f"{n:,}"),
        (f"{title}, max", f"{document.ms(summary.max)} ms", f"{n:,}"),
    ]


def _real_time_factor(run: LoadedRun) -> str:
    """Return simulated seconds per wall second and the requested factor."""
    # The wall time of an aborted flight includes the delay until its end is detected.
    paced = [e for e in run.episodes if e.wall_s and e.outcome is not Outcome.ABORTED]
    wall_s = sum(episode.wall_s or 0.0 for episode in paced)
    if not wall_s or run.info.setup.speed is None:
        return "not paced"
    flown_us = sum(episode.ended_us - episode.started_us for episode in paced)
    return f"{flown_us / constants.US_PER_S / wall_s:.3f} (asked {run.info.setup.speed:g})"


def run_ages(run: LoadedRun) -> CommandAges:
    """Return the ages of a run's commands, from frame to the motors' next command."""
    seen: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
    flown, flight = list(seen), list(seen)
    for number, stamps in sorted(run.latency.items()):
        frames, motors = _acted(stamps)
        seen.append(frames)
        flown.append(motors)
        flight.append(np.full(len(frames), number, np.int64))
    return command_ages(np.concatenate(seen), np.concatenate(flown), np.concatenate(flight))


def _acted(stamps: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return frame and motor times [µs] of an episode's decisions with both stamps."""
    nothing: NDArray[np.int64] = np.zeros(0, np.int64)
    if "capture_us" not in stamps or "motor_us" not in stamps:
        return nothing, nothing
    frames, motors = stamps["capture_us"], stamps["motor_us"]
    both = (frames != NO_STAMP) & (motors != NO_STAMP)
    return frames[both].astype(np.int64), motors[both].astype(np.int64)


def ages_table(ages: CommandAges, end_to_end: Summary) -> document.TableView | None:
    """Return age and latency of the flown command; None without consecutive commands."""
    n = ages.youngest_us.size
    if not n or not ages.time_us:
        return None
    columns = (*document.columns_of("<how old the flown command was"), *document.DURATION_COLUMNS)
    rows = (
        ("as it took effect, by decision", *document.duration_cells(end_to_end)),
        (
            "at any moment, by time",
            f"{n:,}",
            document.ms(ages.mean),
            *(document.percentile_cell(ages.percentile(p), n) for p in (50.0, 90.0, 99.0)),
            document.ms(float(ages.oldest_us.max())),
        ),
    )
    notes = (
        "A command ages until the next one moves the motors. By decision a stall is one sample, "
        "however long it lasts; by time it weighs what the vehicle flew of it (coordinated "
        "omission).",
    )
    return document.TableView("ages", "Age of the flown command", columns, rows, notes)


MAX_LISTED = 60


def faults_table(run: LoadedRun) -> document.TableView | None:
    """Return the active faults, one per line; None without faults."""
    lines = [
        (
            f"{e.index}",
            acted.fault,
            f"{from_s:.2f}",
            f"{to_s:.2f}",
            document.OUTCOME_LABELS[e.outcome],
        )
        for e in run.episodes
        for acted, (from_s, to_s) in zip(e.faults, e.fault_spans_s(), strict=True)
    ]
    if not lines:
        return None
    notes = ["Simulated time since the start of navigation; negative: before it."]
    if len(lines) > MAX_LISTED:
        notes.append(f"{MAX_LISTED} of {len(lines):,} lines; all: {EPISODES_FILE}.")
    columns = document.columns_of("# | <fault | from [s] | to [s] | <outcome of the flight")
    return document.TableView("faults", "Faults", columns, tuple(lines[:MAX_LISTED]), tuple(notes))


MAX_PRINTED = 25
"""Maximum number of flights listed in the terminal."""


def print_report(run: LoadedRun, console: Console) -> None:
    """Print the setup and the tables."""
    summary, feeds = summarize_run(run), not run.info.setup.computer_on_ground
    flights = document.count_flights(run.episodes)
    document.print_facts([*setup_rows(run), ("flights", flights)], console)
    for view in (
        latency_table(summary),
        episodes_table(run, MAX_PRINTED),
        quality_table(summary, computer=feeds),
        conduct_table(run, summary),
        faults_table(run),
        real_time_table(run, summary),
    ):
        if view is not None:
            console.print()
            document.print_table(view, console)


def show_report(
    run: LoadedRun,
    verdict: run_verdict.OverallVerdict,
    console: Console,
    progress: Progress | None = None,
    *,
    draw: bool = True,
    tables: bool = True,
    out: Path | None = None,
) -> Path | None:
    """Print `tables` of a run, `draw` and print its page, then print the verdict; save both.

    `out` is the folder of the files; None = the run's.
    """
    progress = progress or Progress()
    if run.episodes:
        run_verdict.save_verdict(verdict, out or run.path)
    if tables:
        print_report(run, console)
    page: Path | None = None
    if run.episodes and draw:
        # Imported here: pages need matplotlib, which takes longer to load than ten flights take.
        from airl_mav.report.run_report import write_report

        progress.status(DRAWING)
        progress.line(DRAWING)
        try:
            page = write_report(run, out, verdict=verdict)
        except KeyboardInterrupt:
            print_verdict(verdict.lines, console)
            raise
        progress.status(None)
    if run.episodes:
        place = page or f"airl report {shlex.quote(str(run.path))}"
        print_place("report", place, console)
    console.print()
    print_verdict(verdict.lines, console)
    return page
