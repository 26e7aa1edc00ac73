"""False alarm rate of the companion's limits in flights without faults.

    python scripts/honest_flights.py [--flights 1000] [--out DIR]

Flies honest flights in lockstep, with real MAVSDK, the full flight controller and policies of all
kinds of commands, in vehicles with and without GPS. Wind, 0 to 8 m/s with gusts and a random
direction, and latency, native to 950 ms, change with the seed. There is no pilot takeover and no
fault, so any stop by `companion/limits.py` is a false alarm. Every flight is a line of flights.csv
in --out, and the same command resumes from there, also with more --flights. Writes table.json,
which results.py publishes.
"""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from flown_lines import FlownLines

from airl_mav.core.errors import EXIT_USAGE, UsageError
from airl_mav.core.machine import provenance
from airl_mav.core.progress import new_console
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import wilson
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.profiles.vehicle import WindSettings
from airl_mav.rehearsal.observer import Observer
from airl_mav.report.document import Column, TableView, print_table, write_table
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.training.config import check_seeds
from companion.limits import REASONS
from published.record import behaviour_today

WINDS_M_S, GUST_M_S = (0.0, 3.0, 6.0, 8.0), 1.5

LATENCIES: Mapping[str, Mapping[str, str]] = {
    "native": {},
    "ras-pi-4": {"computer": "ras-pi-4", "workload": "template-5x32"},
    "300ms": {"latency": "300ms"},
    "950ms": {"latency": "950ms"},
}

FLIGHTS_FILE = "flights.csv"


class Setup(NamedTuple):
    """Policy, arena and vehicle."""

    policy: str
    arena: str
    vehicle: str = "quad"


SETUPS = (
    Setup("no-obstacles", "no-obstacles"),
    Setup("static-obstacles", "static-obstacles"),
    Setup("static-obstacles-fast", "static-obstacles"),
    Setup("static-obstacles-ppo", "static-obstacles"),
    Setup("static-obstacles-d435", "static-obstacles", "quad-d435"),
    Setup("dense-obstacles-fast", "dense-obstacles"),
    Setup("dynamic-obstacles-fast", "dynamic-obstacles"),
    Setup("crowded-fast", "crowded"),
    Setup("crowded-pipelined", "crowded"),
    Setup("crowded-panorama", "crowded", "quad-panorama"),
    Setup("gates", "gates"),
    Setup("body-rates", "static-obstacles"),
    Setup("body-rates-hall", "hall"),
    Setup("greedy", "static-obstacles"),
    Setup("greedy", "open-field"),
    Setup("greedy", "hills"),
    Setup("greedy", "static-obstacles", "quad-flow"),
    Setup("greedy", "static-obstacles", "quad-indoor"),
    Setup("greedy", "static-obstacles", "quad-vio"),
    Setup("greedy", "static-obstacles", "quad-lidar"),
)


@dataclass(frozen=True)
class Command:
    """Fly the flights and count false alarms."""

    flights: int = 1000
    """Total number of flights, distributed over the setups."""

    seed: int = 1
    """First seed."""

    out: Path = Path("runs/honest-flights")
    """Folder of flights.csv and table.json."""


@dataclass(frozen=True)
class Honest:
    """Result of a flight."""

    seed: int
    policy: str
    arena: str
    vehicle: str
    wind_m_s: float
    latency: str
    outcome: str
    navigated_s: float
    """Time from the start of navigation to the verdict."""
    decisions: int
    alarm: str
    """Violated limit, from the flight's notes; empty: none."""
    behaviour: str
    """Fingerprint of the flight behaviour."""


COLUMNS = tuple(field.name for field in fields(Honest))
"""Columns of flights.csv, one flight per line."""


def row_of(flight: Honest) -> dict[str, object]:
    """Return the line of a flight."""
    return asdict(flight)


class Phases(Observer):
    """Start of the landing."""

    landing_us: float = math.inf
    """Simulated time [µs]; inf = none."""

    def phase(self, name: str, time_us: int) -> None:
        """Store the first landing."""
        if name == "landing":
            self.landing_us = min(self.landing_us, time_us)


def conditions_of(setup: Setup, seed: int) -> tuple[float, str]:
    """Return wind [m/s] and latency of a seed: every pair once in 16 seeds.

    Policies of body rates fly with the native latency: with another one they leave the bounds.
    """
    wind_m_s = WINDS_M_S[seed % len(WINDS_M_S)]
    if setup.policy.startswith("body-rates"):
        return wind_m_s, "native"
    return wind_m_s, tuple(LATENCIES)[seed // len(WINDS_M_S) % len(LATENCIES)]


def scenario_of(setup: Setup, seed: int) -> Scenario:
    """Return the scenario of a flight: the seed determines wind and latency."""
    (speed, latency), angle = (
        conditions_of(setup, seed),
        np.random.default_rng(seed).uniform(0.0, math.tau),
    )
    north, east = speed * math.cos(angle), speed * math.sin(angle)
    wind = WindSettings(north_m_s=north, east_m_s=east, gust_m_s=GUST_M_S if speed else 0.0)
    return Scenario(level="lockstep", seed=seed, wind=wind, **setup._asdict(), **LATENCIES[latency])


def alarm_of(record: EpisodeRecord) -> str:
    """Return the violated limit of a flight, from its notes; empty: none."""
    return next((note for note in record.notes if note.split(":")[0] in REASONS), "")


def honest(setup: Setup, seed: int, behaviour: str) -> Honest:
    """Fly one seed."""
    resolved = resolve(scenario_of(setup, seed))
    phases = Phases()
    flown = fly(resolved, resolved.fresh_policy(seed), 0, seed, observer=phases)
    record = flown.record
    begun_us = record.ended_us if record.navigation_us is None else record.navigation_us
    navigated_s = (record.ended_us - begun_us) / 1e6
    decisions = len(flown.latency["capture_us"])
    # After the verdict, a vehicle may hit something behind the goal.
    alarm = alarm_of(record) if phases.landing_us < record.ended_us else ""
    wind_m_s, latency = conditions_of(setup, seed)
    outcome = record.outcome.value
    return Honest(
        seed, *setup, wind_m_s, latency, outcome, navigated_s, decisions, alarm, behaviour
    )


def setup_of(row: Mapping[str, str]) -> Setup:
    """Return the setup of a line."""
    return Setup(*(row[name] for name in Setup._fields))


def view_of(rows: Sequence[dict[str, str]]) -> TableView:
    """Return the counts by vehicle. Alarms after a collision do not count: the vehicle tumbles."""
    counted = []
    for vehicle in (*dict.fromkeys(setup.vehicle for setup in SETUPS), "all"):
        mine = [row for row in rows if vehicle in ("all", row["vehicle"])]
        hit = Outcome.COLLISION.value
        false = sum(bool(row["alarm"]) and row["outcome"] != hit for row in mine)
        rate = wilson(false, len(mine))
        counted.append(
            (
                vehicle,
                str(len(mine)),
                str(sum(row["outcome"] == hit for row in mine)),
                str(false),
                "" if rate.high is None else f"{100.0 * rate.high:.2g} %",
            )
        )
    columns = (
        Column("vehicle", number=False),
        Column("flights"),
        Column("collisions"),
        Column("false alarms"),
        Column("at most (95 %)"),
    )
    return TableView("honest", "Honest flights", columns, tuple(counted))


def main(words: Sequence[str] | None = None) -> int:
    """Fly missing flights, and count."""
    asked, console = tyro.cli(Command, args=words, description=__doc__), new_console()
    check_seeds(asked.seed, -(-asked.flights // len(SETUPS)))
    behaviour = behaviour_today()
    path = asked.out / FLIGHTS_FILE
    lines = FlownLines(path, COLUMNS)
    if {row["behaviour"] for row in lines.rows} - {behaviour}:
        raise UsageError(f"{path}: flown with another behaviour; accepted: {behaviour}")
    known = {(setup_of(row), int(row["seed"])) for row in lines.rows}
    for number in range(asked.flights):
        setup, seed = SETUPS[number % len(SETUPS)], asked.seed + number // len(SETUPS)
        if (setup, seed) in known:
            continue
        flight = honest(setup, seed, behaviour)
        lines.add(row_of(flight))
        if flight.alarm:
            console.print(f"{flight}", highlight=False)
    view = view_of(lines.rows)
    print_table(view, console)
    words = sys.argv[1:] if words is None else words
    command = shlex.join(["python", "scripts/honest_flights.py", *words])
    write_table(view, asked.out, provenance(command), sorted({setup.policy for setup in SETUPS}))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UsageError as error:
        sys.stderr.write(f"honest_flights.py: {error}\n")
        sys.exit(EXIT_USAGE)
