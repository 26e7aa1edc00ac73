"""`airl faults`: fault matrix of the flight controller."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, get_args

from pydantic import Field
from rich.console import Console

from airl_mav.addons.fault_matrix import matrix as fault_matrix
from airl_mav.core import clock, errors, fields, files, machine
from airl_mav.core.progress import RichProgress, new_console
from airl_mav.experiments import executors
from airl_mav.faults import LINKS, PROCESSES, Fault, Phase
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.report.document import Column, TableView, print_table
from airl_mav.scenario import aircraft, model

ELSEWHERE = (*LINKS, *PROCESSES, "camera")


class FaultsOptions(fields.ProfileModel):
    """Fly every fault in every phase of a flight, in simulated time, and report how flights end.

    The command runs only the flight controller and its plant. A scripted pilot arms, climbs to 5 m,
    holds, flies in offboard mode or a mission, and lands. Undocumented ends are marked and give
    exit status 3. The same --out resumes an interrupted run.

    Examples:
        airl faults
        airl faults --fault 'gps off' --fault 'motor1 off' --episodes 100
        airl faults --episodes 1 --phases hold
    """

    faults: Annotated[tuple[Fault, ...], aircraft.IN_WORDS] = Field(
        default=(),
        description="faults in words, without a time; by default those of the catalogue",
    )
    phases: tuple[str, ...] = Field(
        default=fault_matrix.MATRIX_PHASES, description="phases of the flight in which they begin"
    )
    episodes: int = fields.quantity(
        "flights with each fault in each phase", "1", ge=1, le=10_000, default=20
    )
    seed: int = fields.quantity(
        "seed of the first; the others follow", "1", ge=0, le=model.GREATEST_SEED, default=1
    )
    vehicle: aircraft.VehicleName = aircraft.DEFAULT_VEHICLE
    workers: int | None = fields.quantity(
        "processes that fly; by default one for each core",
        "1",
        ge=1,
        le=model.GREATEST_WORKERS,
        default=None,
    )
    mixed_code: bool = fields.switch(
        "continue a matrix whose flights have another version of the code; faults.md lists the"
        " versions"
    )
    out: Path | None = Field(
        default=None,
        description="folder of faults.json, every flight, and faults.md, the table; by default"
        " runs/<UTC time>-faults",
    )


OPTIONS = FaultsOptions


def run(options: FaultsOptions, console: Console | None = None) -> int:
    """Fly the matrix, show and save it; return 0 if every flight ended as documented, else 3."""
    console = console or new_console()
    phases = tuple(_phase(name) for name in options.phases)
    faults = [_without_time(fault) for fault in options.faults] or [
        c.fault for c in fault_matrix.CASES
    ]
    seeds = range(options.seed, options.seed + options.episodes)
    workers = options.workers or machine.usable_cores()
    vehicle = load_vehicle(options.vehicle)
    out = options.out or Path("runs") / f"{clock.utc_now():%Y%m%dT%H%M%SZ}-faults"
    out.mkdir(parents=True, exist_ok=True)
    file = out / "faults.json"
    matrix = fault_matrix.resumed(
        file,
        machine.provenance("airl faults"),
        fault_matrix.vehicle_digest(vehicle),
        mixed=options.mixed_code,
        say=console.print,
    )
    done: list[fault_matrix.MatrixCell] = []
    with RichProgress(console) as progress:
        bar = progress.bar("faults", len(faults) * len(phases) * len(seeds), unit="flights")

        def flown(cell: fault_matrix.MatrixCell) -> None:
            done.append(cell)
            fault_matrix.save(fault_matrix.with_cells(matrix, done), file)
            bar.update(completed=len(done) * len(seeds))

        try:
            cells = fault_matrix.fly_matrix(
                vehicle, faults, phases, seeds, workers=workers, known=matrix.cells, flown=flown
            )
        except executors.WorkerError as error:
            progress.note(f"{error}: resume with --out {out}", "red")
            return errors.EXIT_BROKEN
        finally:
            bar.close()
    mixed = "".join(machine.mixed_code(each.code for cell in cells for each in cell.flights))
    text = fault_matrix.markdown(cells) + (f"\n{mixed}\n" if mixed else "")
    files.replace_file(out / "faults.md", text.encode())
    print_table(table_of(faults, phases, cells), console, wrap=True)
    if mixed:
        console.print(mixed, soft_wrap=True)
    console.print(f"{out}", soft_wrap=True)
    return errors.EXIT_NOT_MET if any(cell.unexpected for cell in cells) else 0


def table_of(
    faults: Sequence[str], phases: Sequence[Phase], cells: Sequence[fault_matrix.MatrixCell]
) -> TableView:
    """Return the matrix as a table with a row per fault, for a terminal of any width."""
    rows = tuple(
        (fault, *(fault_matrix.cell_text(cell) for cell in cells if cell.fault == fault))
        for fault in faults
    )
    columns = (Column("fault", number=False), *(Column(p, number=False) for p in phases))
    note = "!: a flight ended otherwise than documented. In brackets: fastest touch-down."
    return TableView("fault-matrix", "Faults", columns, rows, (note,))


def _phase(name: str) -> Phase:
    for phase in get_args(Phase):
        if phase == name and phase in fault_matrix.MATRIX_PHASES:
            known: Phase = phase
            return known
    raise errors.FieldError("phases", name, ", ".join(fault_matrix.MATRIX_PHASES))


def _without_time(fault: Fault) -> str:
    if fault.phase is not None or fault.at_s:
        raise errors.FieldError("faults", str(fault), "without a time: each phase gives it one")
    if fault.part in ELSEWHERE:
        raise errors.FieldError("faults", str(fault), "a part of the aircraft: it flies alone here")
    return str(fault)
