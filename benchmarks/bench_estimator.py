"""Are the estimator's errors as large as it says? NIS and NEES over ten minutes of mixed flight.

    python benchmarks/bench_estimator.py

Ten flights of plant and flight controller in simulated time, each with a seed of its own: take-off,
hold, a minute of offboard velocities and headings as they come, landing. Of every measurement the
normalised innovation squared (NIS) is noted, of position, velocity and attitude the normalised
error squared (NEES), both divided by their degrees of freedom: 1 = as large as the filter says,
less = it says more. Beside the means stands what share of samples lies below the 95 % quantile of
chi-square, and within its two-sided 95 % bounds (Bar-Shalom, Li, Kirubarajan, Estimation with
Applications to Tracking and Navigation, ch. 5.4).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_S, US_PER_S
from airl_mav.core.frames import Vector, geodetic_to_local, local_to_geodetic, quat_wxyz_to_xyzw
from airl_mav.core.location import HOME
from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Mode, Result, Setpoint
from firmware_sim.autopilot.commander import Phase
from firmware_sim.simulation import EpisodeSetup, Simulation, builtin_autopilot

ALTITUDE_M = 8.0
HOLD_S = 5.0
REPEAT_TICKS = 13
"""Setpoints are repeated every so many ticks: some 20 Hz."""
NEES_TICKS = 50
"""The error is looked at every so many ticks: 5 Hz."""
LONGEST_LANDING_S = 60.0


@dataclass(frozen=True)
class Bench:
    """Which flights."""

    vehicle: str = "quad"
    """Profile name or path."""
    flights: int = 10
    """With the seeds 1, 2, ..."""
    seconds: float = 60.0
    """In offboard, each."""


class Noted:
    """Normalised squares, by what they are of; each with its degrees of freedom."""

    def __init__(self) -> None:
        self.values: dict[tuple[str, int], list[float]] = {}

    def take(self, name: str, error: Vector, covariance: Vector) -> None:
        """Note error' covariance^-1 error."""
        square = float(error @ np.linalg.solve(covariance, error))
        self.values.setdefault((name, len(error)), []).append(square)


def fly(vehicle: str, seed: int, seconds: float, nis: Noted, nees: Noted) -> float:
    """Fly once; return how long it was in the air [s]."""
    setup = EpisodeSetup(load_vehicle(vehicle), None, seed)
    autopilot = builtin_autopilot(setup)
    simulation = Simulation(
        setup, start_us=0, clock=SimClock(), recording=False, autopilot=autopilot
    )
    ticks = 0
    try:
        for _ in pilot(simulation, autopilot, np.random.default_rng(seed), seconds):
            truth = simulation.truth
            simulation.tick()
            flying = autopilot.flight.phase is Phase.AIR
            autopilot.estimator.innovations = nis.take if flying else None
            ticks += flying
            if flying and ticks % NEES_TICKS == 0:
                note_errors(nees, autopilot, truth.position, truth.velocity, truth.quaternion)
    finally:
        simulation.close()
    return ticks * TICK_S


def pilot(
    simulation: Simulation, autopilot: BuiltinAutopilot, rng: np.random.Generator, seconds: float
) -> Iterator[None]:
    """Say what a pilot does; yield for every tick to be flown. Raises SystemExit: it went wrong."""
    while autopilot.flight.phase is Phase.BOOT:
        yield
    if autopilot.arm(force=False) is not Result.ACCEPTED:
        raise SystemExit("the vehicle cannot be armed")
    autopilot.takeoff(ALTITUDE_M)
    while autopilot.flight.mode is not Mode.HOLD:
        yield
    for _ in range(round(HOLD_S / TICK_S)):
        yield
    left, wanted = 0, np.zeros(3)
    yaw = 0.0
    for tick in range(round(seconds / TICK_S)):
        if left == 0:
            left, yaw = round(rng.uniform(1.0, 3.0) / TICK_S), float(rng.uniform(-3.1, 3.1))
            here = autopilot.estimator.state[:3] - [0.0, 0.0, -ALTITUDE_M]
            wanted = rng.uniform([-4, -4, -1], [4, 4, 1]) - [0.05, 0.05, 0.3] * here
        left -= 1
        if tick % REPEAT_TICKS == 0:
            setpoint = Setpoint(np.full(3, math.nan), wanted, yaw, math.nan)
            autopilot.offer_setpoint(setpoint, simulation.time_us)
        if tick == 0:
            autopilot.set_mode(Mode.OFFBOARD)
        yield
    flight = autopilot.flight
    if flight.mode is not Mode.OFFBOARD:
        raise SystemExit(f"the flight ended in {flight.mode.name}")
    autopilot.set_mode(Mode.LAND)
    end_us = simulation.time_us + LONGEST_LANDING_S * US_PER_S
    while autopilot.flight.phase >= Phase.GROUND and simulation.time_us < end_us:
        yield


def note_errors(
    nees: Noted, autopilot: BuiltinAutopilot, position: Vector, velocity: Vector, quaternion: Vector
) -> None:
    """Note the errors of position, velocity and attitude by the true ones."""
    estimator, e = autopilot.estimator, autopilot.state().estimate
    if estimator.origin is None:
        return  # Not aligned yet: it says nothing.
    place = geodetic_to_local(local_to_geodetic(position, HOME), estimator.origin)
    known, true = (Rotation.from_quat(quat_wxyz_to_xyzw(q)) for q in (e.quaternion, quaternion))
    covariance = estimator.filter.covariance
    for first, name, error in (
        (0, "position", place - e.position),
        (3, "velocity", velocity - e.velocity),
        (6, "attitude", (known.inv() * true).as_rotvec()),
    ):
        nees.take(name, error, covariance[first : first + 3, first : first + 3])


def shown(title: str, noted: Noted) -> Table:
    """Return the table of what was noted."""
    table = Table(title=title)
    for column in ("of", "degrees of freedom", "samples", "mean", "below 95 %", "within 95 %"):
        table.add_column(column, justify="left" if column == "of" else "right")
    for (name, freedom), values in noted.values.items():
        squares = np.array(values)
        low, high = chi2.ppf(0.025, freedom), chi2.ppf(0.975, freedom)
        below = float((squares < chi2.ppf(0.95, freedom)).mean())
        within = float(((squares > low) & (squares < high)).mean())
        mean = float(squares.mean()) / freedom
        shares = f"{100 * below:.1f} %", f"{100 * within:.1f} %"
        table.add_row(name, str(freedom), f"{len(squares):,}", f"{mean:.2f}", *shares)
    return table


def main() -> None:
    """Fly and print."""
    bench = tyro.cli(Bench, description=__doc__)
    console = Console()
    nis, nees = Noted(), Noted()
    seeds = range(1, bench.flights + 1)
    airborne = sum(fly(bench.vehicle, seed, bench.seconds, nis, nees) for seed in seeds)
    console.print(f"{bench.flights} flights, {airborne:.0f} s in the air")
    console.print(shown("NIS: innovations", nis))
    console.print(shown("NEES: errors", nees))


if __name__ == "__main__":
    main()
