"""`airl export-log`: export flights of a run to log files."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from rich.console import Console

from airl_mav.addons.export_log import recorded, ulog_log
from airl_mav.addons.view.replayed_flight import ReplayedRun
from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.cli.shared_options import TrustArenas, folder_of
from airl_mav.core.errors import FieldError, usage_errors
from airl_mav.core.fields import ProfileModel
from airl_mav.core.files import open_regular, replacing
from airl_mav.core.progress import RichProgress, new_console
from airl_mav.rehearsal.run_folder import load, trust_arenas
from firmware_sim.interfaces import ULOG_SUFFIX

Format = Literal["mcap", "ulog"]


class ExportLogOptions(ProfileModel):
    """Write flights of a run as MCAP (Foxglove, rerun) or ULog (PlotJuggler, Flight Review).

    Writes one file per flight, flight-NNN.mcap or flight-NNN.ulg.

    Examples:
        airl export-log runs/20261122T101530Z-sitl-static-obstacles
        airl export-log runs/A 3 7 --format ulog --out logs
    """

    run: Annotated[Path, POSITIONAL] = Field(
        description="run folder, or the black box of a flight (.mcap)"
    )
    flights: Annotated[tuple[int, ...], POSITIONAL] = Field(
        default=(), description="numbers of the flights; by default all that are recorded"
    )
    format: Format = Field(default="mcap", description="of the files")
    out: Path | None = Field(
        default=None, description="folder of the files; by default that of the run"
    )
    trust: TrustArenas = False


OPTIONS = ExportLogOptions
READS_FILES = True


def run(options: ExportLogOptions, console: Console | None = None) -> int:
    """Write the files; return 0."""
    console = console or new_console()
    if options.format == "mcap":
        check_installed("export")
    folder = folder_of(options.run)
    if options.trust:
        trust_arenas(load(folder))
    replayed = ReplayedRun(folder)
    numbers = options.flights or tuple(sorted(record.index for record in replayed.records))
    for number in numbers:
        _check_recorded(replayed, number)
    out = options.out or folder
    with usage_errors(f"--out {out}"):
        out.mkdir(parents=True, exist_ok=True)
    with RichProgress(console) as progress:
        bar = progress.bar("flights", len(numbers), unit="flights")
        for number in numbers:
            path = write_flight(flight_of(replayed, number), folder, out, options.format)
            bar.advance()
            progress.note(f"{path}  {path.stat().st_size / 1e6:.1f} MB")
        bar.close()
    return 0


def _check_recorded(run: ReplayedRun, number: int) -> None:
    try:
        run.record(number)
    except FieldError as error:
        raise FieldError("flights", number, error.accepted) from None


def flight_of(run: ReplayedRun, index: int) -> recorded.RecordedFlight:
    """Return a flight of a run; raise UsageError if the flight or its arena is missing."""
    return recorded.RecordedFlight(run.flight(run.record(index)), run.info)


def write_flight(flight: recorded.RecordedFlight, run: Path, out: Path, kind: Format) -> Path:
    """Write a flight to a folder and return the file's path; a recorded ULog is copied."""
    name = f"flight-{flight.replayed.record.index:03d}"
    if kind == "mcap":
        # Imported here: MCAP and Foxglove's messages are extras.
        from airl_mav.addons.export_log.mcap_export import write_mcap

        path = out / f"{name}.mcap"
        write_mcap(flight, path)
        return path
    path, own = out / f"{name}{ULOG_SUFFIX}", run / f"{name}{ULOG_SUFFIX}"
    if not os.path.lexists(own):
        ulog_log.write_ulog(flight, path)
    elif not (path.exists() and path.samefile(own)):
        source = open_regular(own, links=False)
        with source, replacing(path) as partial, partial.open("wb") as copy:
            shutil.copyfileobj(source, copy)
    return path
