"""`airl export-data`: tables and data sets of a run."""

from __future__ import annotations

import csv
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.core import errors, fields, files, progress
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report.run_columns import TABLES, Columns

Format = Literal["csv", "parquet", "minari", "lerobot"]


class ExportDataOptions(fields.ProfileModel):
    """Export the data of a run for analysis or learning.

    csv and parquet write the tables episodes, decisions, latency and trajectories. minari and
    lerobot write a data set: true state in NED, goal and setpoint, sampled at --rate-hz.

    Examples:
        airl export-data runs/A
        airl export-data runs/A --format parquet --out tables
        airl export-data runs/A --format lerobot --rate-hz 10 --out datasets/a
    """

    run: Annotated[Path, POSITIONAL] = Field(description="run folder")
    format: Format = Field(default="csv", description="format of the files")
    out: Path | None = Field(
        default=None, description="folder of the files; default: RUN/data-FORMAT"
    )
    rate_hz: float = fields.quantity(
        "minari and lerobot: samples per second", "Hz", ge=1, le=250, default=10.0
    )


OPTIONS = ExportDataOptions
READS_FILES = True


def run(options: ExportDataOptions, console: Console | None = None) -> int:
    """Write the files; return 0. Raises UsageError for a damaged run or an unusable folder."""
    console = console or progress.new_console()
    if options.format != "csv":
        check_installed("data")
    loaded = load(options.run)
    out = options.out or files.subfolder(options.run, f"data-{options.format}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise errors.FieldError("out", f"{out}", problem="exists already; name another folder")
    if options.format in ("csv", "parquet"):
        out.mkdir(parents=True, exist_ok=True)
        write = _write_csv if options.format == "csv" else _write_parquet
        for name, columns_of in TABLES.items():
            path = out / f"{name}.{options.format}"
            with files.replacing(path) as partial:
                write(columns_of(loaded), partial)
            console.print(f"{name}: {path}", soft_wrap=True, highlight=False)
        return 0
    # Their packages take seconds to import.
    module = importlib.import_module("airl_mav.addons.data_export.data_sets")
    writer: Callable[[LoadedRun, float, Path], int]
    writer = module.write_minari if options.format == "minari" else module.write_lerobot
    n = writer(loaded, options.rate_hz, out)
    console.print(f"{n} episodes: {out}", soft_wrap=True, highlight=False)
    return 0


def _write_csv(columns: Columns, path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def _write_parquet(columns: Columns, path: Path) -> None:
    pyarrow = importlib.import_module("pyarrow")
    parquet = importlib.import_module("pyarrow.parquet")
    parquet.write_table(pyarrow.table(columns), path)
