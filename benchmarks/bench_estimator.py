"""Consistency of the estimator: NIS and NEES over ten minutes of mixed flight.

    python benchmarks/bench_estimator.py

Ten flights of plant and flight controller in simulated time, each with a different seed: take-off,
hold, a minute of random offboard velocities and headings, landing. Records the normalised
innovation squared (NIS) of every measurement, and the normalised error squared (NEES) of position,
velocity and attitude. Both are divided by their degrees of freedom: 1 = consistent, less = the
filter overstates its errors. The table has the means with the two-sided 95 % bounds of a consistent
filter's mean. The bounds assume that innovations are independent, and errors only between flights.
Further columns have the share of samples below the 95 % quantile of chi-square, and within its
two-sided 95 % bounds (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
Navigation, ch. 5.4).

The vehicle's parameters overstate the noises, as PX4's defaults do, so the means lie below 1. With
`--matched` the filter uses the sensors' true noises. The GPS does not drift then, as the filter has
no state for drift: the means show whether the filter is consistent.
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
from airl_mav.core.frames import (
    HOME,
    MAGNETIC_FIELD_NED,
    Vector,
    geodetic_to_local,
    local_to_geodetic,
    quat_wxyz_to_xyzw,
)
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.vehicle.atmosphere import altitude_m, pressure_hpa
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Result, Setpoint
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.estimator import BIAS_STEP_S
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.engine.ticks import PA_PER_HPA
from firmware_sim.simulation import EpisodeSetup, Simulation, builtin_autopilot

ALTITUDE_M = 8.0
HOLD_S = 5.0
REPEAT_TICKS = 13
"""Ticks between repetitions of a setpoint: about 20 Hz."""
NEES_TICKS = 50
"""Ticks between samples of the error: 5 Hz."""
LONGEST_LANDING_S = 60.0


@dataclass(frozen=True)
class Bench:
    """Flights of the benchmark."""

    vehicle: str = "quad"
    """Profile name or path."""
    flights: int = 10
    """With the seeds 1, 2, ..."""
    seconds: float = 60.0
    """In offboard, each."""
    matched: bool = False
    """Configure the filter with the sensors' true noises; the GPS does not drift."""


class Noted:
    """Normalised squares by quantity and degrees of freedom."""

    def __init__(self) -> None:
        self.values: dict[tuple[str, int], list[float]] = {}

    def take(self, name: str, error: Vector, covariance: Vector) -> None:
        """Note error' covariance^-1 error."""
        square = float(error @ np.linalg.solve(covariance, error))
        self.values.setdefault((name, len(error)), []).append(square)


def told_its_noises(vehicle: VehicleProfile) -> VehicleProfile:
    """Return the vehicle with a filter configured for the noises of its sensors."""
    imu, gps = vehicle.sensors.imu, vehicle.sensors.gps.model_copy(update={"drift_m_sqrt_s": 0.0})
    step_s = math.sqrt(BIAS_STEP_S)
    horizontal = math.hypot(*MAGNETIC_FIELD_NED[:2])
    noises = {
        "EKF2_ACC_NOISE": imu.accel_noise_m_s2,
        "EKF2_GYR_NOISE": imu.gyro_noise_rad_s,
        "EKF2_ACC_B_NOISE": imu.accel_walk_m_s2_sqrt_s / step_s,
        "EKF2_GYR_B_NOISE": imu.gyro_walk_rad_s_sqrt_s / step_s,
        "EKF2_GPS_P_NOISE": gps.horizontal_noise_m,
        "EKF2_GPS_V_NOISE": gps.velocity_noise_m_s,
        "EKF2_BARO_NOISE": pressure_noise_m(vehicle),
        "EKF2_HEAD_NOISE": vehicle.sensors.magnetometer.noise_gauss / horizontal,
    }
    sensors = vehicle.sensors.model_copy(update={"gps": gps})
    parameters = {**vehicle.parameters, **noises}
    return vehicle.model_copy(update={"sensors": sensors, "parameters": parameters})


def pressure_noise_m(vehicle: VehicleProfile) -> float:
    """Return what the barometer's noise is in height, at the place of the flights [m]."""
    noise_hpa = vehicle.sensors.barometer.noise_pa / PA_PER_HPA
    here = pressure_hpa(HOME.altitude_m)
    return altitude_m(here - noise_hpa) - altitude_m(here)


def fly(vehicle: VehicleProfile, seed: int, seconds: float, nis: Noted, nees: Noted) -> float:
    """Fly once; return how long it was in the air [s]."""
    setup = EpisodeSetup(vehicle, None, seed)
    autopilot = builtin_autopilot(setup)
    simulation = Simulation(
        setup, start_us=0, clock=SimClock(), recording=False, autopilot=autopilot
    )
    ticks = 0
    try:
        for _ in pilot(simulation, autopilot, np.random.default_rng(seed), seconds):
            simulation.tick()
            truth = simulation.truth  # of the same time as the estimate
            flying = autopilot.flight.phase is FlightPhase.AIR
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
    """Command the vehicle; yield for every tick. Raises SystemExit if the flight fails."""
    while autopilot.flight.phase is FlightPhase.BOOT:
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
    while autopilot.flight.phase >= FlightPhase.GROUND and simulation.time_us < end_us:
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


def shown(title: str, noted: Noted, independent: int | None = None) -> Table:
    """Return the table of recorded values, `independent` of them independent (None = all)."""
    table = Table(title=title)
    for column in ("of", "freedom", "samples", "mean", "bounds", "< 95 %", "within"):
        table.add_column(column, justify="left" if column == "of" else "right")
    for (name, freedom), values in noted.values.items():
        degrees = freedom * (independent or len(values))
        lowest, highest = (chi2.ppf(share, degrees) / degrees for share in (0.025, 0.975))
        squares = np.array(values)
        low, high = chi2.ppf(0.025, freedom), chi2.ppf(0.975, freedom)
        below = float((squares < chi2.ppf(0.95, freedom)).mean())
        within = float(((squares > low) & (squares < high)).mean())
        mean = float(squares.mean()) / freedom
        shares = f"{100 * below:.1f} %", f"{100 * within:.1f} %"
        bounds = f"{lowest:.2f}-{highest:.2f}"
        samples = f"{len(squares):,}"
        table.add_row(name, str(freedom), samples, f"{mean:.2f}", bounds, *shares)
    return table


def main() -> None:
    """Fly and print."""
    bench = tyro.cli(Bench, description=__doc__)
    console = Console()
    nis, nees = Noted(), Noted()
    vehicle = load_vehicle(bench.vehicle)
    if bench.matched:
        vehicle = told_its_noises(vehicle)
    seeds = range(1, bench.flights + 1)
    airborne = sum(fly(vehicle, seed, bench.seconds, nis, nees) for seed in seeds)
    console.print(f"{bench.flights} flights, {airborne:.0f} s in the air")
    console.print(shown("NIS: innovations", nis))
    console.print(shown("NEES: errors", nees, independent=bench.flights))


if __name__ == "__main__":
    main()
