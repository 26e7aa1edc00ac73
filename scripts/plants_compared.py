"""Comparison of the same episodes in lockstep on both plants, pybullet and kernel.

    python scripts/plants_compared.py --flights 100 --out runs/plants.csv

Every flight is flown twice, from the same seeds, by real MAVSDK and the built-in policy of the
arena. Positions are compared at 50 Hz until the verdict. Prints a row for each arena, and each
deviating pair. With --out every pair is a line of that file, and the same command resumes from
there. Exit status 0: every pair has equal outcomes, within the limit.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from flown_lines import FlownLines
from numpy.typing import NDArray
from rich.table import Table

from airl_mav.core.errors import EXIT_USAGE, UsageError
from airl_mav.core.progress import new_console
from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.rehearsal.run_folder import FlownEpisode
from airl_mav.scenario.aircraft import PlantName
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve

PAIRS = (
    ("no-obstacles", "no-obstacles"),
    ("static-obstacles", "static-obstacles"),
    ("dense-obstacles", "dense-obstacles"),
    ("dynamic-obstacles", "dynamic-obstacles"),
    ("crowded", "crowded"),
)
"""Arenas and their policies."""


@dataclass(frozen=True)
class Comparison:
    """Compare the plants, flight by flight."""

    flights: int = 100
    """Seeds in each arena."""

    seed: int = 1
    """First seed."""

    arenas: tuple[str, ...] = field(default_factory=lambda: tuple(name for name, _ in PAIRS))
    """Arenas."""

    limit_mm: float = 1.0
    """Maximum position difference [mm]."""

    out: Path | None = None
    """CSV file with a line per pair; an existing file is resumed."""


@dataclass(frozen=True)
class Pair:
    """Result of a pair of flights."""

    arena: str
    seed: int
    outcomes: tuple[str, str]
    samples: tuple[int, int]
    """Samples of the trajectories, 50 a second."""
    apart_mm: float
    """Maximum distance between the two positions until the verdict."""
    landed_mm: float
    """Maximum distance to the end of the recording: moving obstacles may hit a landing vehicle."""


def compared(arena: str, policy: str, seed: int) -> Pair:
    """Fly a seed on both plants."""
    plants: tuple[PlantName, PlantName] = ("pybullet", "kernel")
    one, other = (flown(arena, policy, seed, plant) for plant in plants)
    here, there = until_judged(one), until_judged(other)
    outcomes = one.record.outcome.value, other.record.outcome.value
    samples = len(one.trajectory), len(other.trajectory)
    whole = farthest_mm(one.trajectory.position, other.trajectory.position)
    return Pair(arena, seed, outcomes, samples, farthest_mm(here, there), whole)


def farthest_mm(here: NDArray[np.float64], there: NDArray[np.float64]) -> float:
    """Return the maximum distance between two paths (n, 3) [m] at the same time, in mm."""
    common = min(len(here), len(there))
    apart = np.linalg.norm(here[:common] - there[:common], axis=1)
    return 1e3 * float(apart.max(initial=0.0))


def flown(arena: str, policy: str, seed: int, plant: PlantName) -> FlownEpisode:
    """Fly a seed on a plant."""
    asked = Scenario(level="lockstep", arena=arena, policy=policy, seed=seed, plant=plant)
    resolved = resolve(asked)
    return fly(resolved, resolved.fresh_policy(seed), 0, seed)


def until_judged(flight: FlownEpisode) -> NDArray[np.float64]:
    """Return the true positions NED (n, 3) [m] at 50 Hz, until the verdict."""
    path = flight.trajectory
    before: NDArray[np.float64] = path.position[path.time_us < flight.record.ended_us]
    return before


def main(words: Sequence[str] | None = None) -> int:
    """Compare, and print the results."""
    asked, console = tyro.cli(Comparison, args=words), new_console()
    deciding = dict(PAIRS)
    lines = None if asked.out is None else FlownLines(asked.out, COLUMNS)
    known = {} if lines is None else {(p.arena, p.seed): p for p in map(pair_of, lines.rows)}
    pairs: list[Pair] = []
    for seed in range(asked.seed, asked.seed + asked.flights):
        for arena in asked.arenas:
            pair = known.get((arena, seed))
            if pair is None:
                pair = compared(arena, deciding[arena], seed)
                if lines is not None:
                    lines.add(row_of(pair))
            pairs.append(pair)
            if parted(pair, asked.limit_mm):
                console.print(f"parted: {pair}", highlight=False)
    table = Table("arena", "pairs", "alike", "successes", "farthest apart")
    for arena in asked.arenas:
        mine = [pair for pair in pairs if pair.arena == arena]
        alike = sum(not parted(pair, asked.limit_mm) for pair in mine)
        reached = sum(pair.outcomes[1] == Outcome.SUCCESS.value for pair in mine)
        most = max((pair.apart_mm for pair in mine), default=0.0)
        table.add_row(arena, str(len(mine)), str(alike), str(reached), f"{most:.2g} mm")
    console.print(table)
    return int(any(parted(pair, asked.limit_mm) for pair in pairs))


def parted(pair: Pair, limit_mm: float) -> bool:
    """Return True if two flights ended differently, or deviated by more than the limit [mm]."""
    return pair.outcomes[0] != pair.outcomes[1] or pair.apart_mm > limit_mm


COLUMNS = (
    *("arena", "seed", "pybullet", "kernel", "samples_pybullet", "samples_kernel"),
    *("apart_mm", "landed_mm"),
)
"""Columns of the file, one pair per line."""


def row_of(pair: Pair) -> dict[str, object]:
    """Return the line of a pair."""
    apart = f"{pair.apart_mm:.6g}", f"{pair.landed_mm:.6g}"
    cells = (pair.arena, pair.seed, *pair.outcomes, *pair.samples, *apart)
    return dict(zip(COLUMNS, cells, strict=True))


def pair_of(row: Mapping[str, str]) -> Pair:
    """Return the pair of a line."""
    return Pair(
        row["arena"],
        int(row["seed"]),
        (row["pybullet"], row["kernel"]),
        (int(row["samples_pybullet"]), int(row["samples_kernel"])),
        float(row["apart_mm"]),
        float(row["landed_mm"]),
    )


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UsageError as error:
        sys.stderr.write(f"plants_compared.py: {error}\n")
        sys.exit(EXIT_USAGE)
