"""The fault matrix: every fault in every phase, many seeds, and how each flight ended."""

from __future__ import annotations

import json
import multiprocessing
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

from airl_mav.core.files import replace_file
from airl_mav.experiments.fault_flight import FaultFlight, fly_fault
from airl_mav.faults.catalogue import CASE_OF, MATRIX_PHASES, Case, End
from airl_mav.faults.kinds import Phase
from airl_mav.profiles.vehicle import VehicleProfile

ANY: frozenset[End] = frozenset({"not armed", "landed", "crashed"})
"""How a flight with a fault that is not in the catalogue may end."""


@dataclass(frozen=True)
class Cell:
    """All flights with one fault in one phase."""

    fault: str
    phase: Phase
    flights: tuple[FaultFlight, ...]

    @property
    def ends(self) -> Mapping[End, int]:
        """How often each end was, the most frequent first."""
        return dict(Counter(flight.end for flight in self.flights).most_common())

    @property
    def unexpected(self) -> tuple[FaultFlight, ...]:
        """Flights that ended otherwise than documented."""
        case = CASE_OF.get(self.fault, Case(self.fault, ANY))
        allowed = case.allowed(self.phase)
        return tuple(flight for flight in self.flights if flight.end not in allowed)

    @property
    def touchdown_m_s(self) -> float | None:
        """Fastest touch-down of the flights that landed."""
        speeds = [f.touchdown_m_s for f in self.flights if f.end == "landed"]
        return max((speed for speed in speeds if speed is not None), default=None)


def fly_matrix(
    vehicle: VehicleProfile,
    faults: Sequence[str],
    phases: Sequence[Phase] = MATRIX_PHASES,
    seeds: Sequence[int] = (1,),
    *,
    workers: int = 1,
    flown: Callable[[int], None] = lambda _: None,
) -> list[Cell]:
    """Fly every fault in every phase with every seed; the same arguments give the same cells.

    Args:
        vehicle: What flies.
        faults: In words, without a time.
        phases: When they begin.
        seeds: Of the flights.
        workers: Processes that fly; they change no result.
        flown: Is told how many flights have been flown.
    """
    jobs = [(fault, phase) for fault in faults for phase in phases]
    cells: list[Cell] = []
    if workers == 1:
        for job in jobs:
            cells.append(_fly_cell(vehicle, *job, seeds))
            flown(len(cells) * len(seeds))
        return cells
    # A fresh process each: pybullet and compiled kernels do not survive a fork beside threads.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        waiting = [pool.submit(_fly_cell, vehicle, *job, tuple(seeds)) for job in jobs]
        for future in waiting:
            cells.append(future.result())
            flown(len(cells) * len(seeds))
    return cells


def _fly_cell(vehicle: VehicleProfile, fault: str, phase: Phase, seeds: Sequence[int]) -> Cell:
    flights = tuple(fly_fault(vehicle, fault, phase, seed) for seed in seeds)
    return Cell(fault, phase, flights)


def markdown(cells: Sequence[Cell]) -> str:
    """Return the matrix as a table, a fault a row; `!` marks what is not documented."""
    phases = list(dict.fromkeys(cell.phase for cell in cells))
    by_key = {(cell.fault, cell.phase): cell for cell in cells}
    lines = [f"| fault | {' | '.join(phases)} |", f"|---|{'---|' * len(phases)}"]
    for fault in dict.fromkeys(cell.fault for cell in cells):
        row = [cell_text(by_key[fault, phase]) for phase in phases]
        lines.append(f"| `{fault}` | {' | '.join(row)} |")
    return "\n".join(lines) + "\n"


def cell_text(cell: Cell) -> str:
    """Return how the flights of a cell ended: "19 landed (0.8 m/s), 1 crashed !"."""
    parts = []
    for end, count in cell.ends.items():
        speed = cell.touchdown_m_s if end == "landed" else None
        told = "" if speed is None else f" ({speed:.1f} m/s)"
        parts.append(f"{count} {end}{told}")
    return ", ".join(parts) + (" !" if cell.unexpected else "")


def save(cells: Sequence[Cell], path: Path) -> None:
    """Write every flight of a matrix as JSON."""
    flights = [asdict(flight) for cell in cells for flight in cell.flights]
    replace_file(path, json.dumps({"schema": 1, "flights": flights}, indent=1).encode())
