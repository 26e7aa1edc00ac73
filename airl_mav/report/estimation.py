"""How well the estimator knew where the vehicle was, over all flights, as a table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from airl_mav.report.table import Column, TableView
from airl_mav.report.tracking import TrackedFlight

ROWS = (
    ("position, seen from above", "aside_m", "m"),
    ("height", "height_m", "m"),
    ("velocity", "velocity_m_s", "m/s"),
    ("roll or pitch", "tilt_deg", "°"),
    ("heading", "heading_deg", "°"),
)


def estimation_table(flights: Sequence[TrackedFlight]) -> TableView | None:
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
    columns = (
        Column("error of the estimate", number=False),
        Column("unit", number=False),
        Column("median"),
        Column("p95"),
        Column("greatest"),
    )
    notes = (
        f"Between what the flight controller believed and the true state, 50 times a second, "
        f"{len(known):,} flights from the start of navigation.",
    )
    return TableView("estimation", "Estimator", columns, tuple(rows), notes)
