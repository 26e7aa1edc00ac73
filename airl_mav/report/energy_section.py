"""Figure and tables of the energy by part: airframe and computer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import MaxNLocator

from airl_mav.flight import energy, episode_record, judge, trajectory
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report import theme
from airl_mav.report.document import NONE, Column, Section, TableView, columns_of, tables_section
from airl_mav.report.run_tables import MAX_FLIGHTS, failures_first

if TYPE_CHECKING:
    from airl_mav.report.run_report import ReportInput

COMPUTER_COLOUR = "#a35bb8"
"""Colour of medium lightness, legible on light and dark backgrounds."""

BARS = 60
"""Maximum number of flights drawn as bars; more flights are drawn as areas sorted by energy."""

RANKS = 160
"""Number of flights drawn if sorted, evenly spaced by rank."""

HIGH = 2.0
"""Upper limit of the axis as a multiple of the 95th percentile; keeps other flights visible."""

AIRFRAME = {"hover_j": "hovering", "motion_j": "speed", "manoeuvre_j": "manoeuvres"}
"""Parts of the airframe's energy in the order of the tables."""

PARTS = (
    ("hover_j", AIRFRAME["hover_j"], theme.SERIES),
    ("manoeuvre_j", AIRFRAME["manoeuvre_j"], theme.MARK),
    ("motion_j", AIRFRAME["motion_j"], theme.SERIES_SOFT),
    ("computer_j", "computer", COMPUTER_COLOUR),
)
"""Drawn parts of the energy, from bottom to top."""


def energy_section(page: ReportInput) -> tuple[Section, ...]:
    """Return the energy by part; empty without measured flights."""
    flights = flight_energies(page.run, page.vehicle)
    ground = page.run.info.setup.computer_on_ground
    if not flights:
        return ()
    return tables_section(
        energy_table(flights, on_ground=ground),
        energy_flights_table(flights, MAX_FLIGHTS),
        draw=lambda: [energy_figure(flights, on_ground=ground)],
        template="energy.html.j2",
    )


@dataclass(frozen=True)
class FlightEnergy:
    """Energy of a flight from the start of navigation."""

    record: episode_record.EpisodeRecord
    quality: trajectory.Quality
    airframe_j: float
    parts: energy.EnergySplit | None
    """Parts of the airframe's energy; None without the vehicle or the recording."""

    @property
    def total_j(self) -> float:
        """Energy of airframe and computer [J]."""
        return self.airframe_j + self.quality.computer_energy_j


def flight_energies(run: LoadedRun, vehicle: VehicleProfile | None) -> list[FlightEnergy]:
    """Return the measured energies of flights with navigation; without `vehicle`, undivided."""
    watts = run.info.setup.computer_watts
    flights = []
    for e in run.episodes:
        if e.quality is None or e.navigation_us is None or e.outcome is judge.Outcome.ABORTED:
            continue
        if e.quality.energy_j is None:
            continue
        path = run.trajectories.get(e.index)
        parts = (
            None
            if path is None or vehicle is None or len(path) < 2
            else energy.split_energy(path, e.navigation_us, e.ended_us, vehicle, watts)
        )
        flights.append(FlightEnergy(e, e.quality, e.quality.energy_j, parts))
    return flights


def energy_table(flights: Sequence[FlightEnergy], *, on_ground: bool = False) -> TableView:
    """Return the total energy of all flights by part; a computer `on_ground` has no row."""
    columns = columns_of("<part | all flights [kJ] | share [%] | mean power [W]")
    time_s = sum(f.quality.flight_time_s for f in flights)
    airframe = sum(f.airframe_j for f in flights)
    computer = sum(f.quality.computer_energy_j for f in flights)
    whole = airframe + computer
    splits = [f.parts for f in flights if f.parts is not None]
    lines = [("airframe", airframe)]
    notes = [
        f"{len(flights):,} flights, from the start of navigation, failed ones included. "
        + (
            "The computer is on the ground: not charged."
            if on_ground
            else "Computer: its watts times the flight time."
        )
    ]
    if splits and len(splits) == len(flights):
        split = energy.add_up(splits)
        lines += [(f"– {title}", getattr(split, name)) for name, title in AIRFRAME.items()]
        notes.append(
            "The airframe's parts follow its power model. Hovering: staying up, with the payload. "
            "Speed: what steady level flight at that speed adds; below 0 where it saves. "
            "Manoeuvres: what is left, of accelerating, braking, climbing and wind."
        )
    if not on_ground:
        lines += [("computer", computer), ("together", whole)]
    rows = tuple(
        (
            title,
            f"{joules / 1e3:,.2f}",
            f"{100.0 * joules / whole:.1f}" if whole else NONE,
            f"{joules / time_s:,.1f}" if time_s else NONE,
        )
        for title, joules in lines
    )
    return TableView("energy", "Energy", columns, rows, tuple(notes))


def energy_flights_table(flights: Sequence[FlightEnergy], most: int) -> TableView:
    """Return the energy of up to `most` flights, failed flights preferred."""
    columns = (
        Column("#"),
        *(Column(title, "kJ") for title in AIRFRAME.values()),
        Column("mean power", "W"),
    )
    shown = {r.index for r in failures_first([f.record for f in flights], most)}
    rows = tuple(_flight_row(f) for f in flights if f.record.index in shown)
    notes = ("The airframe's parts. Mean power: of airframe and computer together.",)
    return TableView("energy-flights", "Parts of each flight's energy", columns, rows, notes)


def _flight_row(flight: FlightEnergy) -> tuple[str, ...]:
    p = flight.parts
    parts = [NONE if p is None else f"{getattr(p, name) / 1e3:.2f}" for name in AIRFRAME]
    q = flight.quality
    return (
        f"{flight.record.index}",
        *parts,
        f"{flight.total_j / q.flight_time_s:,.1f}" if q.flight_time_s else NONE,
    )


def energy_figure(flights: Sequence[FlightEnergy], *, on_ground: bool = False) -> theme.FigureImage:
    """Draw the energy of each flight (at least one) with stacked parts."""
    figure = theme.new_figure(6.4, 3.4)
    ax = figure.subplots()
    many = len(flights) > BARS
    ranked = list(flights)
    kept = np.arange(len(ranked))
    if many:
        ranked.sort(key=lambda f: f.total_j)
        kept = np.unique(np.linspace(0, len(ranked) - 1, RANKS).round().astype(int))
        ranked = [ranked[k] for k in kept]
    whole = all(f.parts is not None for f in flights)
    x = kept
    above, below = np.zeros(len(ranked)), np.zeros(len(ranked))
    parts = PARTS if whole else (("", "airframe", theme.SERIES), PARTS[-1])
    for name, title, colour in parts[:-1] if on_ground else parts:
        values = np.array([_joules(f, name) for f in ranked]) / 1e3
        # Negative parts are stacked below the axis, so the upper bar exceeds the total energy.
        base = np.where(values < 0.0, below, above)
        if many:
            ax.fill_between(x, base, base + values, color=colour, lw=0, step="mid", label=title)
        else:
            ax.bar(x, values, 0.8, bottom=base, color=colour, lw=0, label=title)
        above, below = above + np.maximum(values, 0.0), below + np.minimum(values, 0.0)
    top = HIGH * float(np.percentile(above, 95.0))
    if above.max() > top > 0.0:
        ax.set_ylim(top=top)
        over = sum(f.total_j > 1e3 * top for f in flights)
        ax.set_title(
            f"{over} above, up to {above.max():,.0f} kJ",
            loc="right",
            fontsize=8.5,
            color=theme.MARK,
        )
    ax.axhline(0.0, color=theme.MUTED, lw=0.8)
    if many:
        label = "flights, sorted by their energy"
        ax.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        ax.set_xlim(-0.5, len(flights) - 0.5)
    else:
        label = "flight"
        step = -(-len(ranked) // 20)
        ax.set_xticks(x[::step], [f"{f.record.index}" for f in ranked[::step]])
    theme.label_axes(ax, label, "kJ")
    theme.plain_axes(ax)
    ax.grid(False, axis="x")
    figure.legend(
        loc="outside upper left", ncols=4, frameon=False, fontsize=8.5, labelcolor=theme.INK,
        handlelength=1.0, handletextpad=0.5, columnspacing=1.4,
    )  # fmt: skip
    titles = ", ".join(title for _, title, _ in PARTS) if whole else "airframe, computer"
    alt = f"Energy of each of {len(flights)} flights by part: {titles}"
    return theme.render(figure, "energy", alt)


def _joules(flight: FlightEnergy, name: str) -> float:
    """Return a part of a flight's energy [J]; an empty name selects the airframe."""
    if name == "computer_j":
        return flight.quality.computer_energy_j
    if not name or flight.parts is None:
        return flight.airframe_j
    return float(getattr(flight.parts, name))
