"""Page of a roofline: the curves, their points, and each computer's bottleneck."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from airl_mav.addons.roofline.points import Bound, Roofline, RooflinePoint
from airl_mav.latency.stages import f1_velocity
from airl_mav.report import theme
from airl_mav.report.document import (
    Document,
    Facts,
    Section,
    TableView,
    columns_of,
    provenance_facts,
)

BINDS: dict[Bound, str] = {
    "body": "body: beyond the knee, deciding sooner gains little",
    "sensor": "sensor: the wait for a frame is the longest part",
    "computer": "computer: its inference is the longest part",
    "hold": "hold: the policy's action is held for the longest part",
    "link": "link: the way of the setpoint is the longest part",
}

RATES = 200
"""Number of points of a curve."""


def roofline_document(found: Roofline, made: Mapping[str, Any]) -> Document:
    """Return the document of a roofline with one or more points; `made` is its provenance."""
    return Document(
        name="roofline",
        title=f"Roofline of {found.vehicle}",
        kicker=f"Safe velocity by reaction time · {found.policy} · {found.workload}",
        answers=tuple(_answer(point) for point in found.points)
        + tuple(f"{each.computer} left out: {each.why}." for each in found.left_out),
        sections=(
            Section(
                "Safe velocity",
                tables=(velocity_table(found), reaction_table(found), aircraft_table(found)),
                draw=lambda: [roofline_picture(found)],
            ),
        ),
        facts=_facts(found),
        provenance=(
            ("command", f"{made['command']}"),
            *provenance_facts(made["machine"], made["git"], made["versions"]),
        ),
        configurations=(("the roofline", json.dumps(found.model_dump(), indent=2)),),
        footer="Figures as data in roofline.json beside this page",
    )


def _answer(point: RooflinePoint) -> str:
    return (
        f"{point.computer}: {point.measured_m_s:.2f} m/s is safe, {point.flown_m_s:.2f} m/s was "
        f"flown without a touch; {BINDS[point.binds]}."
    )


def _facts(found: Roofline) -> Facts:
    distance = f"{found.sensing_distance_m:.1f} m"
    if found.noticed_m:
        depths = np.array(found.noticed_m)
        distance += (
            f", the least of {len(depths)} depths at which {found.policy} changed its action for a "
            f"box in its way (median {np.median(depths):.1f} m)"
        )
    return (
        ("vehicle", found.vehicle),
        ("camera", f"{found.frame_rate_hz:g} frames a second"),
        ("sensing distance", distance),
        ("policy", f"{found.policy}, holds an action for {found.hold_s:g} s"),
        ("latency", found.workload),
        ("knee", f"at {100.0 * found.knee_share:g} % of the roof"),
        ("flown", f"{found.draws:,} flights at each speed, seed {found.seed}"),
    )


def velocity_table(found: Roofline) -> TableView:
    """Return the safe velocity on each computer: model, measurement, flight and roofs."""
    columns = columns_of(
        "<computer | F-1 [m/s] | measured [m/s] | flown [m/s] | "
        "roof, F-1 [m/s] | roof [m/s] | <binds"
    )
    rows = tuple(
        (
            point.computer,
            f"{point.f1_m_s:.2f}",
            f"{point.measured_m_s:.2f}",
            f"{point.flown_m_s:.2f}",
            f"{point.f1_roof_m_s:.2f}",
            f"{point.roof_m_s:.2f}",
            point.binds,
        )
        for point in found.points
    )
    notes = (
        "F-1: the closed form, braking as hard as tilt limit and thrust permit. Measured: the "
        "vehicle's own way to a stand, with its computer on board. Flown: greatest speed at which "
        f"none of {found.draws:,} flights touched an obstacle that came up at the worst moment.",
    )
    return TableView("velocities", "Safe velocity", columns, rows, notes)


def aircraft_table(found: Roofline) -> TableView:
    """Return mass and power of each computer on board, and the missions per charge."""
    columns = columns_of(
        "<computer | on board [g] | draws [W] | take-off mass [kg] | power [W] | missions"
    )
    rows = tuple(
        (
            point.computer,
            f"{point.mass_g:g}",
            f"{point.watts:g}",
            f"{point.vehicle_kg:.3f}",
            f"{point.power_w:.0f}",
            f"{point.missions_per_charge:.1f}",
        )
        for point in found.points
    )
    notes = (
        f"Missions: {found.mission_m:g} m each, on a full charge, level at the measured safe "
        "velocity; take-off, landing and manoeuvres come on top.",
    )
    return TableView("aircraft", "With the computer on board", columns, rows, notes)


def reaction_table(found: Roofline) -> TableView:
    """Return the parts of each computer's reaction time, and the knee."""
    columns = columns_of(
        "<computer | sensor [s] | 2 x t2 [s] | hold [s] | link [s] | "
        "T [s] | 1 / T [Hz] | knee, F-1 [Hz] | knee [Hz]"
    )
    rows = tuple(
        (
            point.computer,
            *(f"{each:.3f}" for each in point.shares.model_dump().values()),
            f"{point.reaction_s:.3f}",
            f"{point.rate_hz:.2f}",
            f"{point.f1_knee_hz:.2f}",
            f"{point.knee_hz:.2f}",
        )
        for point in found.points
    )
    notes = (
        "T: from an obstacle's coming up to the motors' answer, at the worst moment: just after "
        "the frame of a decision, which then infers and holds before the next one sees it. t2 is "
        "the 99.9 % quantile, or the greatest sample.",
        *(f"{point.computer}: {point.latency}." for point in found.points),
    )
    return TableView("reaction", "Reaction time", columns, rows, notes)


def roofline_picture(found: Roofline) -> theme.FigureImage:
    """Draw safe velocity against 1 / T with the curves and points of each computer."""
    figure = theme.new_figure(7.2, 4.6)
    ax = figure.add_subplot()
    theme.plain_axes(ax)
    theme.logarithmic(ax, "x")
    known = [hz for p in found.points for hz in (p.rate_hz, p.knee_hz, p.f1_knee_hz)]
    rates = np.geomspace(0.4 * min(known), 4.0 * max(known), RATES)
    for index, point in enumerate(found.points):
        colour = theme.line_style(index).colour
        a, room = point.max_acceleration_m_s2, point.room_m
        model = [f1_velocity(1.0 / hz, room, a) for hz in rates]
        measured = [point.braking.safe_velocity(1.0 / hz, room) for hz in rates]
        ax.plot(rates, model, color=colour, linestyle="--", linewidth=1.0)
        ax.plot(rates, measured, color=colour, linewidth=1.6, label=point.computer)
        ax.axhline(point.roof_m_s, color=colour, linestyle=":", linewidth=0.8)
        knee = found.knee_share * point.roof_m_s
        ax.plot(point.knee_hz, knee, color=colour, marker="|", markersize=12)
        ax.plot(point.rate_hz, point.measured_m_s, color=colour, marker="o", markersize=6)
        ax.plot(point.rate_hz, point.flown_m_s, color=colour, marker="x", markersize=7)
    ax.set_ylim(bottom=0.0)
    ax.set_xlim(rates[0], rates[-1])
    theme.label_axes(ax, "reactions a second, 1 / T [Hz]", "safe velocity [m/s]", found.vehicle)
    ax.annotate(
        "solid, dot: measured braking   dashed: F-1   cross: flown   bar: knee   dotted: roof",
        (0.01, 0.985),
        xycoords="axes fraction",
        fontsize=7.5,
        color=theme.MUTED,
        va="top",
    )
    theme.legend_below(figure, columns=4)
    told = "; ".join(f"{p.computer} {p.measured_m_s:.2f} m/s" for p in found.points)
    return theme.render(figure, "roofline", f"Safe velocity against 1 / T: {told}")
