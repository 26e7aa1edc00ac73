"""Python calls per tick of flight controller, MAVLink link and whole flight.

    python benchmarks/bench_calls.py [--top 40]

The result does not depend on the machine's load. The flights are from benchmarks/bench_stack.py:
(a) plant and flight controller in a hover, (b) with the onboard MAVLink link, (c) a whole flight in
lockstep with MAVSDK, camera and policy. Counts Python functions. Excludes C functions, compiled
kernels and MAVSDK's threads.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType

from bench_stack import Timed, hover, lockstep, whole
from rich.console import Console
from rich.table import Table

from airl_mav.core.constants import TICK_S
from airl_mav.lockstep.vehicle import lockstep_link
from airl_mav.profiles.vehicle import load_vehicle

ROOT = Path(__file__).parents[1]
HOVER_S = 10.0
SEED = 1


@dataclass
class Calls:
    """Python calls of a flight by function, in each of its two threads."""

    ticks: int = 0
    vehicle: Counter[CodeType] = field(default_factory=Counter)
    """Plant, flight controller, MAVLink link, camera and referee."""
    companion: Counter[CodeType] = field(default_factory=Counter)
    """Companion and policy; empty without a companion."""

    def profile_vehicle(self, frame: FrameType, event: str, _: object) -> None:
        """Count a call; for `sys.setprofile`."""
        if event == "call":
            self.vehicle[frame.f_code] += 1

    def profile_companion(self, frame: FrameType, event: str, _: object) -> None:
        """Count a call; for `threading.setprofile`."""
        if event == "call":
            self.companion[frame.f_code] += 1

    def begin(self) -> None:
        """Start counting, in this thread and in threads started later."""
        threading.setprofile(self.profile_companion)
        sys.setprofile(self.profile_vehicle)


def count_calls(flight: Callable[[Callable[[], None]], Timed]) -> Calls:
    """Return the calls of a flight, which receives a function to call when counting starts.

    The smaller count of two flights is used. The first flight also loads kernels. MAVSDK sends
    frames by the wall clock, such as heartbeats: they add up to 0.5 % on a loaded host.
    """
    flights = []
    for _ in range(2):
        calls = Calls()
        try:
            timed = flight(calls.begin)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
        calls.ticks = round(timed.simulated_s / TICK_S)
        flights.append(calls)
    return min(flights, key=lambda calls: calls.vehicle.total())


def hover_calls() -> Calls:
    """Return the calls of (a)."""
    return count_calls(lambda begin: hover(load_vehicle("quad"), (), begin, HOVER_S))


def onboard_link_calls() -> Calls:
    """Return the calls of (b)."""
    return count_calls(lambda begin: hover(load_vehicle("quad"), (lockstep_link,), begin, HOVER_S))


def lockstep_calls() -> Calls:
    """Return the calls of (c)."""
    resolved = lockstep("static-obstacles")

    def flight(begin: Callable[[], None]) -> Timed:
        begin()
        return whole(resolved, (SEED,))

    return count_calls(flight)


FLIGHTS: dict[str, Callable[[], Calls]] = {
    "hover": hover_calls,
    "onboard_link": onboard_link_calls,
    "lockstep": lockstep_calls,
}


def calls_per_tick(name: str, calls: Calls) -> dict[str, float]:
    """Return the calls per tick of a flight's threads, by the names of scripts/budgets.toml."""
    threads = {name: calls.vehicle, f"{name}_companion": calls.companion}
    return {thread: round(c.total() / calls.ticks, 1) for thread, c in threads.items() if c}


def module_of(code: CodeType) -> str:
    """Return the path of a function's module, within this repository or its package."""
    path = Path(code.co_filename)
    if path.is_relative_to(ROOT) and ".venv" not in path.parts:
        return str(path.relative_to(ROOT))
    return "/".join(path.parts[-2:])


def qualified_name(code: CodeType) -> str:
    """Return module and name of a function; the class is left out on Python 3.10."""
    return f"{module_of(code)}:{getattr(code, 'co_qualname', code.co_name)}"


def table_of(title: str, calls: Calls, label: Callable[[CodeType], str], rows: int) -> Table:
    """Return the labels with most calls of both threads."""
    sums: Counter[str] = Counter()
    for thread in (calls.vehicle, calls.companion):
        for code, count in thread.items():
            sums[label(code)] += count
    table = Table("calls per tick", title, title_justify="left")
    for name, count in sums.most_common(rows):
        table.add_row(f"{count / calls.ticks:.2f}", name)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description="Count Python calls per tick.")
    parser.add_argument("--top", type=int, default=20, help="modules and functions listed")
    options = parser.parse_args()
    console = Console(width=110)
    for name, flight in FLIGHTS.items():
        calls = flight()
        figures = (f"{key} {value}" for key, value in calls_per_tick(name, calls).items())
        console.print(f"calls per tick: {', '.join(figures)}", highlight=False)
        console.print(table_of(f"{name}: module", calls, module_of, options.top))
        console.print(table_of(f"{name}: function", calls, qualified_name, options.top))


if __name__ == "__main__":
    main()
