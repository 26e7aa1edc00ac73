"""The fault matrix: every fault in every phase, many seeds, and how each flight ended."""

from __future__ import annotations

import hashlib
import multiprocessing
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import TypeAdapter

from airl_mav.core.errors import UsageError
from airl_mav.core.files import read_json, write_json
from airl_mav.experiments.fault_flight import FaultFlight, fly_fault
from airl_mav.faults.catalogue import CASE_OF, MATRIX_PHASES, Case, End
from airl_mav.faults.kinds import Phase
from airl_mav.profiles.vehicle import VehicleProfile

SCHEMA = 2
"""Of `faults.json`."""

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
    known: Sequence[Cell] = (),
    flown: Callable[[Cell], None] = lambda _: None,
) -> list[Cell]:
    """Fly every fault in every phase with every seed; the same arguments give the same cells.

    Args:
        vehicle: What flies.
        faults: In words, without a time.
        phases: When they begin.
        seeds: Of the flights.
        workers: Processes that fly; they change no result.
        known: Cells that have been flown; those with these seeds are not flown again.
        flown: Is told each cell in its order, those that were known too.
    """
    kept = {
        (cell.fault, cell.phase): cell
        for cell in known
        if [flight.seed for flight in cell.flights] == list(seeds)
    }
    jobs = [(fault, phase) for fault in faults for phase in phases]
    cells: list[Cell] = []
    for cell in _flown_cells(vehicle, jobs, tuple(seeds), kept, workers):
        cells.append(cell)
        flown(cell)
    return cells


def _flown_cells(
    vehicle: VehicleProfile,
    jobs: Sequence[tuple[str, Phase]],
    seeds: Sequence[int],
    kept: Mapping[tuple[str, Phase], Cell],
    workers: int,
) -> Iterator[Cell]:
    """Yield the cells of the jobs, in their order."""
    if workers == 1:
        for job in jobs:
            yield kept.get(job) or _fly_cell(vehicle, *job, seeds)
        return
    # A fresh process each: pybullet and compiled kernels do not survive a fork beside threads.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        waiting = {
            job: pool.submit(_fly_cell, vehicle, *job, seeds) for job in jobs if job not in kept
        }
        for job in jobs:
            yield kept.get(job) or waiting[job].result()


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


class Matrix(NamedTuple):
    """What `faults.json` holds."""

    made: dict[str, Any]
    """With what it was flown (`core.provenance`)."""
    vehicle: str
    """SHA-256 of its profile."""
    cells: tuple[Cell, ...]


_FLIGHTS = TypeAdapter(tuple[FaultFlight, ...])


def with_cells(matrix: Matrix, cells: Sequence[Cell]) -> Matrix:
    """Return a matrix with these cells in place of its own of the same fault and phase."""
    new = {(cell.fault, cell.phase) for cell in cells}
    kept = (cell for cell in matrix.cells if (cell.fault, cell.phase) not in new)
    return matrix._replace(cells=(*cells, *kept))


def vehicle_digest(vehicle: VehicleProfile) -> str:
    """Return the SHA-256 of a profile."""
    return hashlib.sha256(vehicle.model_dump_json().encode()).hexdigest()


def save(matrix: Matrix, path: Path) -> None:
    """Write every flight of a matrix as JSON, whole or not at all."""
    flights = [asdict(flight) for cell in matrix.cells for flight in cell.flights]
    head = {"schema": SCHEMA, "made": matrix.made, "vehicle": matrix.vehicle}
    write_json(path, {**head, "flights": flights})


def load(path: Path) -> Matrix:
    """Read a matrix. Raises UsageError: it is missing or damaged."""
    data = read_json(path, SCHEMA, "fault matrix")
    try:
        flights = _FLIGHTS.validate_python(data["flights"])
        made, vehicle = dict(data["made"]), str(data["vehicle"])
    except (KeyError, TypeError, ValueError):
        raise UsageError(
            f"{path}: no fault matrix of this version; accepted: faults.json"
        ) from None
    cells: dict[tuple[str, Phase], list[FaultFlight]] = {}
    for flight in flights:
        cells.setdefault((flight.fault, flight.phase), []).append(flight)
    return Matrix(made, vehicle, tuple(Cell(*key, tuple(of)) for key, of in cells.items()))


def resumed(path: Path, made: Mapping[str, Any], vehicle: str) -> Matrix:
    """Return the matrix that goes on in a file: what a stopped one has flown, else nothing yet.

    Raises:
        UsageError: Another vehicle, or another version of this package, has flown there.
    """
    if not path.exists():
        return Matrix(dict(made), vehicle, ())
    found = load(path)
    if found.vehicle != vehicle:
        raise UsageError(f"{path}: flown by another vehicle; accepted: another --out")
    if _version(found.made) != _version(made):
        raise UsageError(f"{path}: flown by another version; accepted: another --out")
    return found


def _version(made: Mapping[str, Any]) -> tuple[object, object]:
    git = made["git"]
    return made["versions"]["airl-mav"], None if git is None else git["commit"]
