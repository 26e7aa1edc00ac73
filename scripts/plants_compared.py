"""Fly the same episodes in lockstep on both plants, pybullet and kernel, and compare them.

    python scripts/plants_compared.py --flights 100

Every flight is flown twice, from the same seeds, by real MAVSDK and the shipped policy of the
arena. Positions are compared at 50 Hz until the flight is judged. Prints a row for each
arena, and each pair that parts. Exit status 0: every pair ends alike, and within the limit.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.flight import fly
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
"""Arenas, and who decides in them."""


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
    """How far positions may part, mm."""

    out: Path | None = None
    """Write a line for each pair to this file (.csv)."""


@dataclass(frozen=True)
class Pair:
    """What a pair of flights showed."""

    arena: str
    seed: int
    outcomes: tuple[str, str]
    samples: tuple[int, int]
    """Of the trajectories, 50 a second."""
    apart_mm: float
    """Greatest distance between the two positions until the flight was judged."""
    landed_mm: float
    """The same to the end of the recording: what moves may run into a vehicle that lands."""


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
    """Return the greatest distance between two paths (n, 3) [m] at the same time, in mm."""
    common = min(len(here), len(there))
    apart = np.linalg.norm(here[:common] - there[:common], axis=1)
    return 1e3 * float(apart.max(initial=0.0))


def flown(arena: str, policy: str, seed: int, plant: PlantName) -> FlownEpisode:
    """Fly a seed on a plant."""
    asked = Scenario(level="lockstep", arena=arena, policy=policy, seed=seed, plant=plant)
    resolved = resolve(asked)
    return fly(resolved, resolved.fresh_policy(seed), 0, seed)


def until_judged(flight: FlownEpisode) -> NDArray[np.float64]:
    """Return the true positions NED (n, 3) [m] at 50 Hz, until the flight was judged."""
    path = flight.trajectory
    before: NDArray[np.float64] = path.position[path.time_us < flight.record.ended_us]
    return before


def main() -> int:
    """Compare, and print what was found."""
    asked, console = tyro.cli(Comparison), Console()
    deciding = dict(PAIRS)
    pairs: list[Pair] = []
    for seed in range(asked.seed, asked.seed + asked.flights):
        for arena in asked.arenas:
            pair = compared(arena, deciding[arena], seed)
            pairs.append(pair)
            if parted(pair, asked.limit_mm):
                console.print(f"parted: {pair}", highlight=False)
            if asked.out is not None:
                save(asked.out, pairs)
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
    """Return whether two flights ended differently, or went further apart than the limit [mm]."""
    return pair.outcomes[0] != pair.outcomes[1] or pair.apart_mm > limit_mm


def save(path: Path, pairs: list[Pair]) -> None:
    """Write a line for each pair."""
    lines = ["arena,seed,pybullet,kernel,samples_pybullet,samples_kernel,apart_mm,landed_mm"]
    lines += [
        f"{p.arena},{p.seed},{','.join(p.outcomes)},{p.samples[0]},{p.samples[1]},"
        f"{p.apart_mm:.6g},{p.landed_mm:.6g}"
        for p in pairs
    ]
    beside = path.with_suffix(".tmp")
    beside.write_text("\n".join(lines) + "\n", encoding="utf-8")
    beside.replace(path)


if __name__ == "__main__":
    sys.exit(main())
