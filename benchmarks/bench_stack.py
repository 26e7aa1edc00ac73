"""Speed of vehicle, flight controller and companion without waiting for the wall clock.

    python benchmarks/bench_stack.py

On one core. (a) plant and flight controller in a hover with 20 Hz setpoints, (b) with the MAVLink
streams of the onboard link, and of both links, packed as well, (c) whole flights in lockstep: real
MAVSDK, depth camera, `static-obstacles` at two decisions a second. Prints multiples of real time,
the best of three, and the parts of a tick's time.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_S, TICK_US, US_PER_S
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.lockstep.stage import ThreadPartner
from airl_mav.lockstep.turns import FlightDigest
from airl_mav.lockstep.vehicle import lockstep_link
from airl_mav.policy.registry import LearnedPolicy
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import ResolvedScenario, resolve
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Setpoint
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import LinkConfig, gcs_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.plant.plant import Plant
from firmware_sim.plant.sensors import SensorSuite
from firmware_sim.simulation import EpisodeSetup, Simulation, builtin_autopilot

FLIGHT_S = 30.0
REPEATS = 3
SEEDS = (1, 2, 3, 4, 5)
SETPOINT_US = 50_000


class Stopwatches:
    """Wall time by part; a part's time does not hold that of parts called from it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._nested = [0.0]

    def measured(self, part: str, owner: type, name: str) -> Callable[[], None]:
        """Time a method from now on; return what ends that."""
        call = getattr(owner, name)
        self.seconds.setdefault(part, 0.0)

        def timed(*arguments: Any, **named: Any) -> Any:
            self._nested.append(0.0)
            start = time.perf_counter()
            try:
                return call(*arguments, **named)
            finally:
                spent = time.perf_counter() - start
                self.seconds[part] += spent - self._nested.pop()
                self._nested[-1] += spent

        setattr(owner, name, timed)
        return lambda: setattr(owner, name, call)

    def reset(self) -> None:
        """Reset all times to zero."""
        self.seconds = dict.fromkeys(self.seconds, 0.0)


PARTS = (
    ("plant", Plant, "step"),
    ("sensors", SensorSuite, "sample"),
    ("EKF", Estimator, "step"),
    ("control, commander", BuiltinAutopilot, "step"),
    ("MAVLink", MavlinkServer, "send"),
    ("MAVLink", MavlinkServer, "receive"),
    ("camera", Simulation, "capture_due"),
    ("policy", LearnedPolicy, "act"),
    ("MAVSDK: barrier and turns", ThreadPartner, "turn"),
    ("MAVSDK: feeding", ThreadPartner, "send"),
    ("fingerprint", FlightDigest, "add"),
)


@dataclass(frozen=True)
class Timed:
    simulated_s: float
    wall_s: float
    cpu_s: float
    """Processor time of all threads of this process; less than the wall time on a shared core."""


class Timer:
    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def timed(self, simulated_s: float) -> Timed:
        return Timed(simulated_s, time.perf_counter() - self._wall, time.process_time() - self._cpu)


def main() -> None:
    console = Console()
    console.print(f"core {pinned()}", highlight=False)
    vehicle = load_vehicle("quad")
    resolved = lockstep("static-obstacles")
    flights: dict[str, Callable[[], Timed]] = {
        "(a) plant + flight controller": lambda: hover(vehicle, ()),
        "(b) + MAVLink, onboard link": lambda: hover(vehicle, (lockstep_link,)),
        "(b') + MAVLink, both links": lambda: hover(vehicle, (lockstep_link, gcs_link)),
        "(c) + MAVSDK, camera, policy": lambda: whole(resolved),
    }
    table = Table("stack", "x real time (best of 3)", "tick [µs]", "simulated s per CPU second")
    for name, flight in flights.items():
        flight()
        runs = [flight() for _ in range(REPEATS)]
        best = max(run.simulated_s / run.wall_s for run in runs)
        per_cpu_s = max(run.simulated_s / run.cpu_s for run in runs)
        tick_us = f"{TICK_S / best * US_PER_S:.1f}"
        table.add_row(name, f"{best:.1f}", tick_us, f"{per_cpu_s:.1f}")
    console.print(table)
    shares("(b)", lambda begins: hover(vehicle, (lockstep_link,), begins), console)
    shares("(c)", lambda _: whole(resolved), console)


def pinned() -> int:
    """Keep to one core from now on, MAVSDK's threads too; return its number."""
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return core


class Repeats:
    """A setpoint at 20 Hz, as lockstep repeats it between two ticks. Implements `Arrivals`."""

    def __init__(self, autopilot: BuiltinAutopilot, setpoint: Setpoint, start_us: int) -> None:
        self._autopilot, self._setpoint, self.next_us = autopilot, setpoint, float(start_us)

    def arrive(self, tick_us: int) -> None:
        while self.next_us <= tick_us:
            self._autopilot.offer_setpoint(self._setpoint, tick_us)
            self.next_us += SETPOINT_US


def hover(
    vehicle: VehicleProfile,
    links: Sequence[Callable[[MemoryEndpoint], LinkConfig]],
    begins: Callable[[], None] = lambda: None,
    flight_s: float = FLIGHT_S,
) -> Timed:
    """Fly slowly by setpoints; the links' frames are packed and thrown away."""
    setup = EpisodeSetup(vehicle, None, 1)
    autopilot = builtin_autopilot(setup)
    simulation = Simulation(setup, start_us=0, clock=SimClock(), autopilot=autopilot)
    for _ in range(round(2.0 / TICK_S)):
        simulation.tick()
    autopilot.arm(force=False)
    autopilot.takeoff(2.5)
    for _ in range(round(8.0 / TICK_S)):
        simulation.tick()
    while (simulation.time_us - TICK_US) % SETPOINT_US:
        simulation.tick()  # setpoints come where stretches end
    free = np.full(3, math.nan)
    setpoint = Setpoint(free, np.array([1.0, 0.0, 0.0]), math.nan, 0.2)
    autopilot.offer_setpoint(setpoint, simulation.time_us)
    autopilot.set_mode(Mode.OFFBOARD)
    endpoints = [MemoryEndpoint() for _ in links]
    server = None
    if links:
        opened = [link(endpoint) for link, endpoint in zip(links, endpoints, strict=True)]
        server = MavlinkServer(opened, autopilot, boot_unix_us=0)
    repeats = Repeats(autopilot, setpoint, simulation.time_us)
    begins()
    timer = Timer()
    end_us = simulation.time_us + round(flight_s * US_PER_S)
    while simulation.time_us < end_us:
        repeats.arrive(simulation.time_us)
        until_us: float = end_us
        if server is not None:
            server.receive(simulation.time_us)
            until_us = min(end_us, server.next_send_us())
        simulation.advance(until_us, repeats)
        if server is not None:
            server.send(simulation.time_us, simulation.flown)
            for endpoint in endpoints:
                endpoint.take()
    timed = timer.timed(flight_s)
    simulation.close()
    return timed


def lockstep(policy: str) -> ResolvedScenario:
    return resolve(Scenario(policy=policy, level="lockstep"))


def whole(resolved: ResolvedScenario, seeds: Sequence[int] = SEEDS) -> Timed:
    """Fly some episodes from boot to disarming, all that belongs to them included."""
    simulated_us = 0
    timer = Timer()
    for seed in seeds:
        flown = fly(resolved, resolved.fresh_policy(seed), 0, seed)
        path = flown.trajectory.time_us
        simulated_us += int(path[-1] - path[0]) + TICK_US
    return timer.timed(simulated_us / US_PER_S)


def shares(title: str, flight: Callable[[Callable[[], None]], Timed], console: Console) -> None:
    """Print where the time of a tick goes, by timing each part of the same flight.

    Each call that is timed costs a fraction of a microsecond more than in the table above.
    """
    watches = Stopwatches()
    ends = [watches.measured(*part) for part in PARTS]
    try:
        run = flight(watches.reset)
    finally:
        for end in reversed(ends):
            end()
    seconds = watches.seconds
    seconds["the rest"] = run.wall_s - sum(seconds.values())
    table = Table(f"{title}: part of a tick", "µs", "share")
    for name, spent in seconds.items():
        if spent > 0.0:
            micros = US_PER_S * spent * TICK_S / run.simulated_s
            table.add_row(name, f"{micros:.2f}", f"{100 * spent / run.wall_s:.0f} %")
    console.print(table)


if __name__ == "__main__":
    main()
