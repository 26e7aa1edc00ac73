"""How old the flown command was, by time: what percentiles over decisions leave out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.latency.coordinated_omission import CommandAges, command_ages
from airl_mav.latency.percentiles import Summary
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report import table
from airl_mav.report.tracking import TrackedFlight

ROWS = (
    ("position, seen from above", "aside_m", "m"),
    ("height", "height_m", "m"),
    ("velocity", "velocity_m_s", "m/s"),
    ("roll or pitch", "tilt_deg", "°"),
    ("heading", "heading_deg", "°"),
)


def estimation_table(flights: Sequence[TrackedFlight]) -> table.TableView | None:
    """Return the errors of the estimator in navigation; None where no flight recorded them."""
    known = [(f.time_s >= 0.0, f.errors) for f in flights if f.errors is not None]
    known = [(flies, errors) for flies, errors in known if flies.any()]
    if not known:
        return None
    rows = []
    for title, name, unit in ROWS:
        values = np.concatenate([getattr(errors, name)[flies] for flies, errors in known])
        figures = (np.median(values), np.percentile(values, 95.0), values.max())
        rows.append((title, unit, *(f"{figure:.2f}" for figure in figures)))
    columns = table.columns_of("<error of the estimate | <unit | median | p95 | greatest")
    notes = (
        f"Between what the flight controller believed and the true state, 50 times a second, "
        f"{len(known):,} flights from the start of navigation.",
    )
    return table.TableView("estimation", "Estimator", columns, tuple(rows), notes)


def run_ages(run: LoadedRun) -> CommandAges:
    """Return the ages of a run's commands, from frame until the next command moves the motors."""
    seen: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
    flown, flight = list(seen), list(seen)
    for number, stamps in sorted(run.latency.items()):
        frames, motors = _acted(stamps)
        seen.append(frames)
        flown.append(motors)
        flight.append(np.full(len(frames), number, np.int64))
    return command_ages(np.concatenate(seen), np.concatenate(flown), np.concatenate(flight))


def _acted(stamps: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return frame and motor time of the decisions of an episode that have both [µs]."""
    nothing: NDArray[np.int64] = np.zeros(0, np.int64)
    if "capture_us" not in stamps or "motor_us" not in stamps:
        return nothing, nothing
    frames, motors = stamps["capture_us"], stamps["motor_us"]
    both = (frames != NO_STAMP) & (motors != NO_STAMP)
    return frames[both].astype(np.int64), motors[both].astype(np.int64)


def ages_table(ages: CommandAges, end_to_end: Summary) -> table.TableView | None:
    """Return the age of the flown command beside its latency; None without consecutive commands."""
    n = ages.youngest_us.size
    if not n or not ages.time_us:
        return None
    columns = (
        table.Column("how old the flown command was", number=False),
        *table.DURATION_COLUMNS,
    )
    rows = (
        ("as it took effect, by decision", *table.duration_cells(end_to_end)),
        (
            "at any moment, by time",
            f"{n:,}",
            table.ms(ages.mean),
            *(table.percentile_cell(ages.percentile(p), n) for p in (50.0, 90.0, 99.0)),
            table.ms(float(ages.oldest_us.max())),
        ),
    )
    notes = (
        "A command ages until the next one moves the motors. By decision a stall is one sample, "
        "however long it lasts; by time it weighs what the vehicle flew of it (coordinated "
        "omission).",
    )
    return table.TableView("ages", "Age of the flown command", columns, rows, notes)
