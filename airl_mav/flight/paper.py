"""What the Air Learning paper reports, as it prints it: to be shown beside our own figures.

Krishnan, Boroujerdian, Fu, Faust, Reddi: Air Learning: a deep reinforcement learning gym for
autonomous aerial robot visual navigation, Machine Learning 110, 2021,
https://doi.org/10.1007/s10994-021-06006-6. Section numbers are those of its arXiv version.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from airl_mav.flight.gap import relative_gap

Arena = Literal["no-obstacles", "static-obstacles", "dynamic-obstacles"]

I9, PI = "Core i9", "Ras-Pi 4"


@dataclass(frozen=True)
class PaperFigures:
    """A column of a table of the paper: means over the flights that reached the goal."""

    label: str
    """Computer and policy, in its words."""
    latency_ms: float
    flight_time_s: float
    distance_m: float
    energy_kj: float
    """Of the vehicle: the computer's energy is in none of its tables."""
    success_percent: float | None = None
    """None: not given."""


@dataclass(frozen=True)
class PrintedGaps:
    """Gaps as the paper prints them; how it works them out differs from table to table."""

    latency_percent: float | None
    success: float
    flight_time_percent: float
    distance_percent: float
    energy_percent: float


@dataclass(frozen=True)
class SystemEvaluation:
    """Section VI.B: the same policy on workstation and onboard computer, one arena."""

    table: str
    policy: str
    """Layers x filters of the best policy, as the text has it."""
    reference: PaperFigures
    target: PaperFigures
    printed: PrintedGaps
    """Success: percentage points."""


@dataclass(frozen=True)
class Mitigation:
    """Section VII.B: trained with the onboard computer's latency, Static Obstacles."""

    table: str
    undelayed: PaperFigures
    delay_trained: PaperFigures
    mitigated: PaperFigures
    unmitigated: PaperFigures
    printed_with: PrintedGaps
    """`mitigated` against `delay_trained`. Success: percent of the target's rate."""
    printed_without: PrintedGaps
    """`unmitigated` against `delay_trained`. Success: percent of the target's rate."""


def gap_of(reference: PaperFigures, target: PaperFigures) -> PrintedGaps:
    """Work out the gaps of two columns by the definition of `airl_mav.flight.gap`.

    Returns:
        Percent, signed; success in percentage points, 0 where the paper gives none.
    """
    first, second = reference.success_percent, target.success_percent
    return PrintedGaps(
        latency_percent=relative_gap(reference.latency_ms, target.latency_ms),
        success=0.0 if first is None or second is None else second - first,
        flight_time_percent=relative_gap(reference.flight_time_s, target.flight_time_s),
        distance_percent=relative_gap(reference.distance_m, target.distance_m),
        energy_percent=relative_gap(reference.energy_kj, target.energy_kj),
    )


SYSTEM_EVALUATION: dict[Arena, SystemEvaluation] = {
    "no-obstacles": SystemEvaluation(
        "system evaluation, No Obstacles (VI.B)",
        "5x32",
        PaperFigures(I9, 11.0, 25.29, 27.59, 19.68, 91.0),
        PaperFigures(PI, 396.0, 37.37, 33.06, 25.483, 80.0),
        PrintedGaps(3500.0, 11.0, 47.76, 19.82, 29.48),
    ),
    "static-obstacles": SystemEvaluation(
        "system evaluation, Static Obstacles (VI.B)",
        "4x48",
        PaperFigures(I9, 10.0, 30.258, 28.70, 19.2, 84.0),
        PaperFigures(PI, 542.28, 34.44, 32.57, 23.90, 71.0),
        PrintedGaps(5322.8, 13.0, 13.85, 13.4, 24.47),
    ),
    "dynamic-obstacles": SystemEvaluation(
        "system evaluation, Dynamic Obstacles (VI.B)",
        "7x32",
        PaperFigures(I9, 9.3, 21.48, 23.51, 18.76, 61.0),
        PaperFigures(PI, 948.92, 35.36, 32.86, 24.31, 55.0),
        PrintedGaps(10103.4, 6.0, 64.61, 39.77, 29.58),
    ),
}
"""By our arena of the same name."""

MITIGATION = Mitigation(
    "mitigation, Static Obstacles (VII.B)",
    undelayed=PaperFigures(f"{I9}, no mitigation", 11.0, 24.08, 25.64, 19.09, 85.0),
    delay_trained=PaperFigures(f"{I9}, trained with delay", 400.0, 32.62, 29.43, 24.59, 85.0),
    mitigated=PaperFigures(f"{PI}, with mitigation", 396.0, 32.44, 29.031, 24.57, 83.0),
    unmitigated=PaperFigures(f"{PI}, without mitigation", 396.0, 44.93, 34.15, 28.40, 73.0),
    printed_with=PrintedGaps(1.0, 2.4, 0.5, 1.37, 0.1),
    printed_without=PrintedGaps(1.0, 16.43, 37.73, 16.03, 15.49),
)

DEGRADATION: tuple[PaperFigures, ...] = (
    PaperFigures(I9, 11.0, 24.08, 25.64, 19.09),
    PaperFigures(f"{I9}, slowed to 150 ms", 150.0, 32.38, 28.27, 23.18),
    PaperFigures(f"{I9}, slowed to 300 ms", 300.0, 47.59, 31.11, 27.28),
)
"""Section VI.C: the Static Obstacles policy slowed by sleep; no success rates."""

ARENAS: tuple[Arena, ...] = ("no-obstacles", "static-obstacles", "dynamic-obstacles")

GENERALISATION: dict[Arena, dict[Arena, float]] = {
    "no-obstacles": dict(zip(ARENAS, (91.0, 53.0, 32.0), strict=True)),
    "dynamic-obstacles": dict(zip(ARENAS, (89.0, 74.0, 61.0), strict=True)),
}
"""Section V.C: success [%] by the arena trained in (5x32 and 7x32), then the arena flown in."""

BEST_OF_SWEEP: dict[Arena, tuple[str, float]] = {
    "no-obstacles": ("5x32", 91.0),
    "static-obstacles": ("4x48", 84.0),
    "dynamic-obstacles": ("7x32", 61.0),
}
"""Section V.B: layers x filters of the best of fifteen networks, and its success [%]."""

ABLATION: dict[Arena, dict[Literal["none", "velocity", "goal", "depth"], float]] = {
    "no-obstacles": {"none": 91.0, "velocity": 53.0, "goal": 42.0, "depth": 7.0},
    "static-obstacles": {"none": 84.0, "velocity": 33.0, "goal": 33.0, "depth": 0.0},
    "dynamic-obstacles": {"none": 61.0, "depth": 0.0},
}
"""Section V.D: success [%] without one of the inputs. For Static Obstacles the text has one figure
("down to 33 %") for velocity and position together; for Dynamic Obstacles depth alone."""
