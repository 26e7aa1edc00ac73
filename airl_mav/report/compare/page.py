"""A comparison as one HTML file that opens offline, and its figures as PNG files."""

from __future__ import annotations

import json
import os
from pathlib import Path

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.compare.build import (
    COMPARE_FILE,
    Compared,
    Side,
    keyed,
    lettered,
    write_compared,
)
from airl_mav.report.compare.figures import cdf_pictures, cdf_sheet, energy_figure
from airl_mav.report.compare.tables import (
    flown_table,
    latency_table,
    paired,
    pairing_tables,
    pairs_in_words,
    quality_table,
)
from airl_mav.report.differences import Against, draw_differences, draw_sheet
from airl_mav.report.fan import Panel, fan_pictures, fan_sheet
from airl_mav.report.html import REPORT_FILE, environment, provenance
from airl_mav.report.ladder.tables import MEASURES
from airl_mav.report.tables import NONE, OUTCOME_WORDS, rate_digits

PAGE_FILE = "compare.html"
DIFFERENCES_FILE = "compare-differences.png"
LATENCY_FILE = "compare-latency.png"
TRAJECTORIES_FILE = "compare-trajectories.png"
ENERGY_FILE = "compare-energy.png"


def build_comparison(compared: Compared, folder: Path) -> Path:
    """Write `compare.html`, `compare.json` and the PNG files; return the page's path."""
    folder.mkdir(parents=True, exist_ok=True)
    write_compared(compared, folder)
    short, full = lettered(compared), keyed(compared)
    reference = short.reference.name
    others: list[Against] = [(each.name, each.comparison) for each in paired(short)]
    if others:
        replace_file(folder / DIFFERENCES_FILE, draw_sheet(reference, others))
    if (sheet := cdf_sheet(full)) is not None:
        replace_file(folder / LATENCY_FILE, sheet)
    panels = [panel_of(side) for side in full.sides]
    replace_file(folder / TRAJECTORIES_FILE, fan_sheet(panels))
    energy = energy_figure(full)
    replace_file(folder / ENERGY_FILE, energy.png)
    info = compared.reference.run.info
    page = (
        environment()
        .get_template("compare.html.j2")
        .render(
            compared=full,
            reference=reference,
            made=info,
            flown=flown_table(full),
            same=list(compared.same.items()),
            quality=quality_table(short),
            pairings=pairing_tables(short),
            pairs=pairs_in_words(short),
            pictures=[draw_differences("compare", reference, others, m) for m in MEASURES]
            if others
            else [],
            latency=latency_table(short),
            distributions=cdf_pictures(full),
            fans=fan_pictures("compare-flights", panels),
            energy=energy,
            links=[(side.name, *_link(side.run.path, folder)) for side in full.sides],
            outcome_keys={words: outcome.value for outcome, words in OUTCOME_WORDS.items()},
            provenance=provenance(info),
            configurations=[
                (side.name, json.dumps(side.run.info.config, indent=2, ensure_ascii=False))
                for side in full.sides
            ],
            data_file=COMPARE_FILE,
        )
    )
    path = folder / PAGE_FILE
    replace_file(path, page.encode())
    return path


def panel_of(side: Side) -> Panel:
    """Return a run's flights for a picture from above."""
    q = side.summary.quality
    rate = q.success_rate
    success = NONE if rate.value is None else f"{100.0 * rate.value:.{rate_digits(rate)}f} %"
    path = NONE if q.distance_m.value is None else f"{q.distance_m.value:.1f} m"
    return Panel(
        title=side.name,
        detail=f"{success} of {rate.n:,} reached the goal, mean path {path}",
        episodes=side.run.episodes,
        paths=side.run.trajectories,
        arena=first_arena(side.run),
    )


def first_arena(run: LoadedRun) -> Arena | None:
    """Make the arena of a run's first flight; None where its profile is not there any more."""
    first = run.episodes[0]
    try:
        vehicle = load_vehicle(run.info.setup.vehicle.name)
        spec = load_profile("arenas", first.arena, ArenaSpec)
        return generate(
            spec, first.arena_seed, name=first.arena, vehicle_width_m=vehicle.body.width_m
        )
    except UsageError:
        return None


def _link(path: Path, folder: Path) -> tuple[str, str | None]:
    """Return a run's folder as the page sees it, and its report if there is one."""
    there = Path(os.path.relpath(path, folder))
    report = there / REPORT_FILE if (path / REPORT_FILE).exists() else None
    return there.as_posix(), None if report is None else report.as_posix()
