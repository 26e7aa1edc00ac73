"""`airl report`: rebuild a run's report, or compare runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from rich.console import Console

from airl_mav.black_box.messages import SUFFIX
from airl_mav.cli.options import POSITIONAL
from airl_mav.cli.shared_options import TrustArenas, folder_of
from airl_mav.core import clock, errors, fields, progress
from airl_mav.rehearsal.run_folder import RUN_FILE, load, trust_arenas
from airl_mav.report.comparison.comparison_model import comparison_file, kind_of


class ReportOptions(fields.ProfileModel):
    """Print the tables of a run or a comparison and rewrite its page; or compare runs.

    Two or more runs are compared: settings, quality of flight with intervals, paired differences on
    shared seeds, latencies, paths, energy. The first run is the reference.

    Examples:
        airl report runs/20261122T101530Z-sitl-static-obstacles
        airl report runs/A runs/B --names before after --out runs/before-after
        airl report flights/20261123T101530.123456Z.mcap
        airl report flights/20261123T101530.123456Z.mcap --ulg log_12.ulg
    """

    runs: Annotated[tuple[Path, ...], POSITIONAL] = Field(
        default=(),
        description="run folders, black boxes of flights (.mcap), or the folder of one comparison",
    )
    names: tuple[str, ...] = Field(
        default=(),
        description="labels of the compared runs, in order; default: their differences",
    )
    out: Path | None = Field(
        default=None,
        description="folder of the pages and pictures; by default that of the run, or of a new"
        " comparison runs/<UTC time>-compare",
    )
    ulg: Path | None = Field(
        default=None,
        description="with one black box: the flight controller's own log of that flight (.ulg),"
        " used for path, power and motor outputs",
    )
    figures: tuple[Literal["pdf", "svg"], ...] = Field(
        default=(), description="also write the figures of a run in these formats, for papers"
    )
    trust: TrustArenas = False


OPTIONS = ReportOptions
READS_FILES = True


def run(options: ReportOptions, console: Console | None = None) -> int:
    """Build the report; return 0."""
    console = console or progress.new_console()
    if not options.runs:
        raise errors.FieldError("runs", accepted="one run folder or more")
    recorded = [path for path in options.runs if path.suffix == SUFFIX and not path.is_dir()]
    if options.ulg is not None and len(recorded) != 1:
        raise errors.FieldError("ulg", f"{options.ulg}", "with one black box of a flight (.mcap)")
    folders = [folder_of(path, options.ulg if path in recorded else None) for path in options.runs]
    options = options.model_copy(update={"runs": tuple(folders)})
    first = options.runs[0]
    if options.trust:
        for folder in options.runs:
            if kind_of(folder) is None:
                trust_arenas(load(folder))
    if not all(map(str.isprintable, options.names)):
        raise errors.FieldError("names", accepted="printable characters")
    if len(options.runs) > 1 or kind_of(first) == "matrix":
        return _compare(options, console)
    if options.names:
        raise errors.FieldError("names", " ".join(options.names), "with two runs or more")
    out = options.out or first
    with errors.usage_errors(f"--out {out}"):
        out.mkdir(parents=True, exist_ok=True)
    if kind_of(first) is None:
        # Imported here and below: options do not need the figures.
        from airl_mav.report import theme
        from airl_mav.report.run_tables import show_report
        from airl_mav.report.run_verdict import verdict_of

        loaded = load(first)
        with theme.figure_files(out, options.figures):
            show_report(loaded, verdict_of(loaded), console, out=out)
    else:
        from airl_mav.report.comparison.show import rebuild_comparison, show_comparison

        show_comparison(*rebuild_comparison(first), out, console)
    return 0


def _compare(options: ReportOptions, console: Console) -> int:
    from airl_mav.report.comparison.show import compare_folders, show_comparison

    out = options.out or Path("runs") / f"{clock.utc_now():%Y%m%dT%H%M%SZ}-compare"
    if (out / RUN_FILE).exists():
        raise errors.FieldError("out", f"{out}", "another folder: it holds a run")
    held = comparison_file(out, "compare").exists()
    if out.is_dir() and any(out.iterdir()) and not held:
        raise errors.FieldError("out", f"{out}", "a new or empty folder: it holds something else")
    comparison, runs = compare_folders(list(options.runs), options.names)
    show_comparison(comparison, runs, out, console)
    return 0
