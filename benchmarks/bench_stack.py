"""How fast the flight controller and its vehicle run when nothing waits for the wall clock.

    python benchmarks/bench_stack.py

One core, no camera, no companion: a hover with 20 Hz setpoints, (a) plant and autopilot, (b) with
the MAVLink streams of both links packed as well. Prints multiples of real time and where the time
of a tick goes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table

from airl_mav.clock import SimClock
from airl_mav.constants import TICK_S, US_PER_S
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from firmware_sim.autopilot.state import Mode, Setpoint
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.link import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.plant.wind import WindSettings
from firmware_sim.simulation import EpisodeSetup, Simulation

FLIGHT_S = 30.0
REPEATS = 3


class Stopwatch:
    """Adds up the wall time of calls."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def wrap(self, call: Callable) -> Callable:
        def timed(*arguments):
            start = time.perf_counter()
            try:
                return call(*arguments)
            finally:
                self.seconds += time.perf_counter() - start

        return timed


def airborne(vehicle: VehicleProfile) -> Simulation:
    simulation = Simulation(
        EpisodeSetup(vehicle, None, 1, WindSettings()), start_us=0, clock=SimClock()
    )
    pilot = simulation.autopilot
    ticks(simulation, 2.0)
    pilot.arm(force=False)
    pilot.takeoff(2.5)
    ticks(simulation, 8.0)
    command(simulation)
    pilot.set_mode(Mode.OFFBOARD)
    return simulation


def ticks(simulation: Simulation, seconds: float) -> None:
    for _ in range(round(seconds / TICK_S)):
        simulation.tick()


def command(simulation: Simulation) -> None:
    free = np.full(3, math.nan)
    setpoint = Setpoint(free, np.array([1.0, 0.0, 0.0]), math.nan, 0.2)
    simulation.autopilot.offer_setpoint(setpoint, simulation.time_us)


def fly(simulation: Simulation, server: MavlinkServer | None) -> float:
    """Return simulated seconds per wall second."""
    every = round(0.05 / TICK_S)
    n = round(FLIGHT_S / TICK_S)
    start = time.perf_counter()
    for i in range(n):
        if i % every == 0:
            command(simulation)
        simulation.tick()
        if server is not None:
            server.receive(simulation.time_us)
            server.send(simulation.time_us)
    return FLIGHT_S / (time.perf_counter() - start)


def main() -> None:
    vehicle = load_profile("vehicles", "quad", VehicleProfile)
    console = Console()
    table = Table("stack", "x real time (best of 3)", "tick [µs]")
    for name, with_mavlink in (("(a) plant + autopilot", False), ("(b) + MAVLink streams", True)):
        best = 0.0
        for _ in range(REPEATS):
            simulation = airborne(vehicle)
            server = None
            if with_mavlink:
                links = [onboard_link(MemoryEndpoint()), gcs_link(MemoryEndpoint())]
                server = MavlinkServer(links, simulation.autopilot, boot_unix_us=0)
            best = max(best, fly(simulation, server))
            simulation.close()
        table.add_row(name, f"{best:.1f}", f"{TICK_S / best * US_PER_S:.0f}")
    console.print(table)
    shares(vehicle, console)


def shares(vehicle: VehicleProfile, console: Console) -> None:
    """Print where the time of a tick goes, by timing each part of the same flight."""
    simulation = airborne(vehicle)
    plant, pilot = simulation.plant, simulation.autopilot
    watches = {name: Stopwatch() for name in ("plant", "sensors", "estimator", "autopilot, rest")}
    plant.sense = watches["sensors"].wrap(plant.sense)
    plant.step = watches["plant"].wrap(plant.step)
    estimator = pilot.estimator
    estimator.step = watches["estimator"].wrap(estimator.step)
    pilot.step = watches["autopilot, rest"].wrap(pilot.step)
    start = time.perf_counter()
    ticks(simulation, FLIGHT_S)
    whole = time.perf_counter() - start
    simulation.close()
    seconds = {name: watch.seconds for name, watch in watches.items()}
    seconds["plant"] -= seconds["sensors"]
    seconds["autopilot, rest"] -= seconds["estimator"]
    seconds["recording"] = whole - sum(seconds.values())
    table = Table("part of a tick", "µs", "share")
    for name, spent in seconds.items():
        table.add_row(
            name, f"{1e6 * spent * TICK_S / FLIGHT_S:.1f}", f"{100 * spent / whole:.0f} %"
        )
    console.print(table)


if __name__ == "__main__":
    main()
