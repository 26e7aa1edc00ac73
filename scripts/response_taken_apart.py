"""Delays of the vehicle between a velocity setpoint and the velocity.

    python scripts/response_taken_apart.py [--flights 10] [--out DIR]

The built-in autopilot hovers on the built-in quad and accepts a step of its velocity setpoint, to
the north or upwards. There is no transport: time counts from the tick that accepts the setpoint,
and the truth is sampled at every tick of 4 ms. Prints the time until the vehicle tilts, moves, and
shows it in its estimate, mean over the flights. Writes table.json, which results.py publishes.
"""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_US, US_PER_MS, US_PER_S
from airl_mav.core.machine import provenance
from airl_mav.core.progress import new_console
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.report.document import NONE, Column, TableView, print_table, write_table
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Result, Setpoint
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.simulation import EpisodeSetup, Simulation

STEPS = {"north": np.array([2.0, 0.0, 0.0]), "up": np.array([0.0, 0.0, -2.0])}
"""Velocity setpoints NED [m/s], from a hover."""

ALTITUDE_M, SETTLE_S, WATCHED_S = 5.0, 6.0, 2.0
EVERY_US = 50_000
"""Period of MAVSDK's setpoints: 20 Hz [µs]."""
TILTED_DEG, MOVED_M_S = 1.0, 0.05
"""Reaction thresholds; the velocity is from `airl conformance`."""


@dataclass(frozen=True)
class Command:
    """Measure the response stages."""

    flights: int = 10
    """Flights of each step, by seed."""

    out: Path = Path("runs/response-taken-apart")
    """Folder of table.json."""


class Vehicle:
    """Simulated vehicle and its autopilot, stepped by ticks."""

    def __init__(self, seed: int) -> None:
        setup = EpisodeSetup(load_vehicle("quad"), None, seed)
        self.simulation = Simulation(setup, start_us=0, clock=SimClock())
        assert isinstance(self.simulation.autopilot, BuiltinAutopilot)
        self.autopilot = self.simulation.autopilot
        self._velocity: NDArray[np.float64] | None = None
        self._next_us = 0

    def close(self) -> None:
        self.simulation.close()

    def command(self, velocity: NDArray[np.float64]) -> None:
        """Send a velocity NED [m/s] with the next tick and at 20 Hz after."""
        self._velocity, self._next_us = velocity, self.simulation.time_us

    def tick(self) -> None:
        now_us = self.simulation.time_us
        if self._velocity is not None and now_us >= self._next_us:
            nowhere = np.full(3, math.nan)
            setpoint = Setpoint(nowhere, self._velocity, 0.0, math.nan)
            self.autopilot.offer_setpoint(setpoint, now_us)
            self._next_us += EVERY_US
        self.simulation.tick()

    def until(self, reached: Callable[[], bool], limit_s: float = 60.0) -> None:
        end_us = self.simulation.time_us + limit_s * US_PER_S
        while not reached():
            if self.simulation.time_us > end_us:
                raise RuntimeError(f"not within {limit_s:g} s of simulated time")
            self.tick()

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * US_PER_S / TICK_US)):
            self.tick()

    def hover(self) -> None:
        """Take off, and hover in Offboard."""
        self.until(lambda: self.autopilot.flight.phase > 0)
        accepted = [self.autopilot.arm(force=False), self.autopilot.takeoff(ALTITUDE_M)]
        self.until(lambda: self.autopilot.flight.mode is Mode.HOLD)
        self.command(np.zeros(3))
        self.tick()
        accepted.append(self.autopilot.set_mode(Mode.OFFBOARD))
        if any(each is not Result.ACCEPTED for each in accepted):
            raise RuntimeError(f"take-off, offboard: {accepted}")
        self.run(SETTLE_S)

    @property
    def tilt_deg(self) -> float:
        """Angle between the body's and the world's vertical."""
        _, x, y, _ = self.simulation.truth.quaternion
        return math.degrees(math.acos(max(-1.0, 1.0 - 2.0 * (x * x + y * y))))


def taken_apart(step: NDArray[np.float64], seed: int) -> list[float]:
    """Return the times of tilt, true velocity, its half and estimated velocity [ms]; NaN: never."""
    with closing(Vehicle(seed)) as vehicle:
        vehicle.hover()
        way, size = step / np.linalg.norm(step), float(np.linalg.norm(step))
        still = float(vehicle.simulation.truth.velocity @ way)
        told = float(vehicle.autopilot.state().estimate.velocity @ way)
        tilted = vehicle.tilt_deg
        vehicle.command(step)
        begun_us = vehicle.simulation.time_us
        reached = [math.nan] * 4
        while vehicle.simulation.time_us - begun_us < WATCHED_S * US_PER_S:
            vehicle.tick()
            velocity = float(vehicle.simulation.truth.velocity @ way) - still
            shown = float(vehicle.autopilot.state().estimate.velocity @ way) - told
            now = (
                abs(vehicle.tilt_deg - tilted) >= TILTED_DEG,
                velocity >= MOVED_M_S,
                velocity >= 0.5 * size,
                shown >= MOVED_M_S,
            )
            passed_ms = (vehicle.simulation.time_us - begun_us) / US_PER_MS
            for k, true in enumerate(now):
                if true and math.isnan(reached[k]):
                    reached[k] = passed_ms
    return reached


def main(asked: Command) -> None:
    means = {
        name: np.mean([taken_apart(step, seed) for seed in range(asked.flights)], axis=0)
        for name, step in STEPS.items()
    }
    stages = (
        f"{TILTED_DEG:g} deg of tilt",
        f"true velocity moved by {1e3 * MOVED_M_S:g} mm/s",
        "half of the step, true velocity",
        f"estimated velocity moved by {1e3 * MOVED_M_S:g} mm/s, as telemetry shows it",
    )
    rows = tuple(
        (stage, *(NONE if math.isnan(each[k]) else f"{each[k]:.0f}" for each in means.values()))
        for k, stage in enumerate(stages)
    )
    columns = (
        Column("from the setpoint's acceptance to", number=False),
        Column("0 to 2 m/s north", "ms"),
        Column("0 to 2 m/s up", "ms"),
    )
    view = TableView("response-taken-apart", "A response taken apart", columns, rows)
    print_table(view, new_console())
    command = shlex.join(["python", "scripts/response_taken_apart.py", *sys.argv[1:]])
    write_table(view, asked.out, provenance(command))


if __name__ == "__main__":
    main(tyro.cli(Command, description=__doc__))
