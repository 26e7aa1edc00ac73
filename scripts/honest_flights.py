"""False alarm rate of the companion's limits in flights without faults.

    python scripts/honest_flights.py [--flights 1000] [--out DIR]

Flies honest flights in lockstep, with real MAVSDK, the full flight controller and the built-in
policy of each arena, in a steady wind of 6 m/s with a random direction per flight, and with the
latency of a Raspberry Pi 4 that runs the paper's network. There is no pilot takeover and no fault,
so any stop by `companion/limits.py` is a false alarm. Every flight is a line of flights.csv in
--out, and the same command resumes from there, also with more --flights. Writes table.json, which
results.py publishes.
"""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import tyro
from flown_lines import FlownLines
from plants_compared import PAIRS

from airl_mav.core.errors import EXIT_USAGE, UsageError
from airl_mav.core.machine import provenance
from airl_mav.core.progress import new_console
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import wilson
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.profiles.vehicle import WindSettings
from airl_mav.report.document import Column, TableView, print_table, write_table
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.training.config import check_seeds
from companion.limits import REASONS
from published.record import behaviour_today

WIND_M_S = 6.0
COMPUTER, WORKLOAD = "ras-pi-4", "template-5x32"
FLIGHTS_FILE = "flights.csv"


@dataclass(frozen=True)
class Command:
    """Fly the flights and count false alarms."""

    flights: int = 1000
    """Total number of flights, distributed over the arenas."""

    seed: int = 1
    """First seed."""

    out: Path = Path("runs/honest-flights")
    """Folder of flights.csv and table.json."""


@dataclass(frozen=True)
class Honest:
    """Result of a flight."""

    seed: int
    arena: str
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


def scenario_of(arena: str, policy: str, seed: int) -> Scenario:
    """Return the scenario of a flight: the seed determines the wind direction."""
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi)
    wind = WindSettings(north_m_s=WIND_M_S * math.cos(angle), east_m_s=WIND_M_S * math.sin(angle))
    return Scenario(
        level="lockstep",
        arena=arena,
        policy=policy,
        seed=seed,
        wind=wind,
        computer=COMPUTER,
        workload=WORKLOAD,
    )


def alarm_of(record: EpisodeRecord) -> str:
    """Return the violated limit of a flight, from its notes; empty: none."""
    return next((note for note in record.notes if note.split(":")[0] in REASONS), "")


def honest(arena: str, policy: str, seed: int, behaviour: str) -> Honest:
    """Fly one seed."""
    resolved = resolve(scenario_of(arena, policy, seed))
    flown = fly(resolved, resolved.fresh_policy(seed), 0, seed)
    record = flown.record
    begun_us = record.ended_us if record.navigation_us is None else record.navigation_us
    navigated_s = (record.ended_us - begun_us) / 1e6
    decisions = len(flown.latency["capture_us"])
    alarm = alarm_of(record)
    return Honest(seed, arena, record.outcome.value, navigated_s, decisions, alarm, behaviour)


def view_of(rows: Sequence[dict[str, str]]) -> TableView:
    """Return the counts by arena. Alarms after a collision do not count: the vehicle tumbles."""
    counted = []
    arenas = [arena for arena, _ in PAIRS]
    for arena in [*arenas, "all"]:
        mine = [row for row in rows if arena in ("all", row["arena"])]
        hit = Outcome.COLLISION.value
        false = sum(bool(row["alarm"]) and row["outcome"] != hit for row in mine)
        rate = wilson(false, len(mine))
        counted.append(
            (
                arena,
                str(len(mine)),
                str(sum(row["outcome"] == Outcome.SUCCESS.value for row in mine)),
                str(sum(row["outcome"] == hit for row in mine)),
                f"{sum(float(row['navigated_s']) for row in mine) / 60.0:.1f}",
                str(sum(int(row["decisions"]) for row in mine)),
                str(false),
                "" if rate.high is None else f"{100.0 * rate.high:.2g} %",
            )
        )
    columns = (
        Column("arena", number=False),
        Column("flights"),
        Column("goals reached"),
        Column("collisions"),
        Column("navigated", "min"),
        Column("decisions"),
        Column("false alarms"),
        Column("at most (95 %)"),
    )
    return TableView("honest", "Honest flights", columns, tuple(counted))


def main(words: Sequence[str] | None = None) -> int:
    """Fly missing flights, and count."""
    asked, console = tyro.cli(Command, args=words, description=__doc__), new_console()
    check_seeds(asked.seed, -(-asked.flights // len(PAIRS)))
    behaviour, deciding = behaviour_today(), dict(PAIRS)
    path = asked.out / FLIGHTS_FILE
    lines = FlownLines(path, COLUMNS)
    if {row["behaviour"] for row in lines.rows} - {behaviour}:
        raise UsageError(f"{path}: flown with another behaviour; accepted: {behaviour}")
    known = {(row["arena"], int(row["seed"])) for row in lines.rows}
    arenas = [arena for arena, _ in PAIRS]
    for number in range(asked.flights):
        arena, seed = arenas[number % len(arenas)], asked.seed + number // len(arenas)
        if (arena, seed) in known:
            continue
        flight = honest(arena, deciding[arena], seed, behaviour)
        lines.add(row_of(flight))
        if flight.alarm:
            console.print(f"{flight}", highlight=False)
    view = view_of(lines.rows)
    print_table(view, console)
    words = sys.argv[1:] if words is None else words
    command = shlex.join(["python", "scripts/honest_flights.py", *words])
    write_table(view, asked.out, provenance(command), sorted(set(deciding.values())))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UsageError as error:
        sys.stderr.write(f"honest_flights.py: {error}\n")
        sys.exit(EXIT_USAGE)
