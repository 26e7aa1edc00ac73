"""Cost of a flight of PX4 and companion in lockstep: processor time by process and thread.

    python benchmarks/bench_px4_lockstep.py --px4-dir PX4-Autopilot [--seeds 3] [--threads 12]
    python benchmarks/bench_px4_lockstep.py

Flies static-obstacles in its arena (without --px4-dir: the tests' stand-in, which flies our own
autopilot). All figures are per simulated second of flight. Processor time does not depend on the
host's load. The multiple of real time, and the time that runnable threads waited for a core, depend
on it. Linux only: reads /proc.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import psutil
from rich.console import Console
from rich.table import Table

from airl_mav.core.constants import US_PER_S
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.rehearsal.channel import State
from airl_mav.rehearsal.observer import Observer
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from tests.support.px4_peer import write_build

NS_PER_S = 1e9

LOOK_US = 4 * US_PER_S
"""Between two readings [µs of simulated time]."""


class Spent(NamedTuple):
    """Scheduling times of one thread since its start. Source: /proc/PID/task/TID/schedstat."""

    ran_ns: int
    waited_ns: int
    """Time in which the thread was runnable, but no core was free."""
    slices: int
    """Number of time slices."""


Threads = dict[tuple[str, str, int], Spent]
"""Scheduling times by process name, thread name and thread id."""


def threads() -> Threads:
    """Return the threads of this process and of all that it has started."""
    found: Threads = {}
    this = psutil.Process()
    for process in (this, *this.children(recursive=True)):
        program = "this process" if process.pid == os.getpid() else process.name()
        for task in Path(f"/proc/{process.pid}/task").iterdir():
            try:
                name = (task / "comm").read_text().strip()
                spent = Spent(*map(int, (task / "schedstat").read_text().split()))
            except OSError:  # The thread has ended.
                continue
            found[program, name, int(task.name)] = spent
    return found


@dataclass
class Look:
    """At one moment of a flight."""

    time_us: int
    wall_s: float
    threads: Threads


class Meter(Observer):
    """Reads the clocks as a flight begins, and then every few seconds: reading takes time, too."""

    def __init__(self) -> None:
        self.looks: list[Look] = []

    def state(self, state: State, started_us: int) -> None:
        """Read them."""
        del started_us
        if not self.looks or state.time_us - self.looks[-1].time_us >= LOOK_US:
            self.looks.append(Look(state.time_us, time.perf_counter(), threads()))


Spending = dict[tuple[str, str], float]
"""Seconds by process name and thread name."""


class Flight(NamedTuple):
    """Times of one flight for each simulated second."""

    speed: float
    """Multiple of real time."""
    ran_s: Spending
    waited_s: Spending
    slices: Spending


def measured(first: Look, last: Look) -> Flight:
    """Return what was spent between two looks."""
    simulated_s = (last.time_us - first.time_us) / US_PER_S
    ran: Spending = defaultdict(float)
    waited: Spending = defaultdict(float)
    slices: Spending = defaultdict(float)
    for key, after in last.threads.items():
        before, name = first.threads.get(key, Spent(0, 0, 0)), key[:2]
        ran[name] += (after.ran_ns - before.ran_ns) / NS_PER_S / simulated_s
        waited[name] += (after.waited_ns - before.waited_ns) / NS_PER_S / simulated_s
        slices[name] += (after.slices - before.slices) / simulated_s
    return Flight(simulated_s / (last.wall_s - first.wall_s), ran, waited, slices)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--px4-dir", type=Path, help="PX4's build, source tree or package")
    parser.add_argument("--instance", type=int, default=7, help="moves all ports")
    parser.add_argument("--seeds", type=int, default=3, help="flights")
    parser.add_argument("--threads", type=int, default=0, help="also show this number of threads")
    options = parser.parse_args()
    flights = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        px4 = options.px4_dir or write_build(folder / "px4")
        scenario = Scenario(
            firmware="px4",
            level="lockstep",
            policy="static-obstacles",
            arena="static-obstacles",
            real={"px4_dir": str(px4), "instance": options.instance},
        )
        resolved = resolve(scenario)
        for seed in range(1, options.seeds + 1):
            meter = Meter()
            fly(resolved, resolved.fresh_policy(seed), 0, seed, log=folder / "log", observer=meter)
            flights.append(measured(meter.looks[0], meter.looks[-1]))
    show(flights, options.threads)


def show(flights: list[Flight], threads_shown: int) -> None:
    """Print the medians."""
    console = Console()
    speed = statistics.median(flight.speed for flight in flights)
    console.print(f"{len(flights)} flights, {speed:.2f} times real time (median)")
    table = Table("for a simulated second", "processor [ms]", "waited [ms]", "times on a core")
    names = sorted(
        {name for flight in flights for name in flight.ran_s},
        key=lambda name: -statistics.median(flight.ran_s.get(name, 0.0) for flight in flights),
    )
    for program in dict.fromkeys(program for program, _ in names):
        of_it = [name for name in names if name[0] == program]
        table.add_row(program, *_cells(flights, of_it))
    for name in names[:threads_shown]:
        table.add_row("  " + ", ".join(name), *_cells(flights, [name]))
    console.print(table)


def _cells(flights: list[Flight], names: list[tuple[str, str]]) -> list[str]:
    ran, waited, slices = (
        statistics.median(sum(spent.get(name, 0.0) for name in names) for spent in by_flight)
        for by_flight in (
            [flight.ran_s for flight in flights],
            [flight.waited_s for flight in flights],
            [flight.slices for flight in flights],
        )
    )
    return [f"{ran * 1e3:.1f}", f"{waited * 1e3:.1f}", f"{slices:.0f}"]


if __name__ == "__main__":
    main()
