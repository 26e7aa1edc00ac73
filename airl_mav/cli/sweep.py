"""`airl sweep`: the architecture search, here or on a cluster, taken up again after anything."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.core.errors import EXIT_BROKEN, EXIT_INTERRUPTED, FieldError
from airl_mav.core.fields import quantity, validated
from airl_mav.core.progress import RichProgress
from airl_mav.experiments.executors import ExecutorSettings
from airl_mav.experiments.open_executor import open_executor
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import load_profile
from airl_mav.rehearsal.signals import stop_on_signals
from airl_mav.report.document import print_document, write_document
from airl_mav.scenario.model import Workers
from airl_mav.sweep.config import SweepConfig, load_sweep
from airl_mav.sweep.document import document_of
from airl_mav.sweep.run import run_sweep
from airl_mav.sweep.summary import Computer, estimated_ms
from airl_mav.sweep.tables import print_plan


class SweepOptions(Workers):
    """Search for the network that flies best: train many, judge all, draw heat maps.

    Air Learning's search over its template: layers x filters, several training seeds a cell. The
    same --out goes on with what was interrupted, whoever was killed.

    Examples:
        airl sweep quick
        airl sweep full --executor ray --ray-address 192.168.1.10:6379
        airl sweep quick --dry-run
    """

    sweep: Annotated[str, POSITIONAL] = Field(
        default="quick",
        description="quick (two cores, an hour), full (the paper's grid), paper (the same on the"
        " paper's image, for GPUs), tiny (seconds, shows nothing), or a path to a .toml",
    )
    out: Path | None = Field(
        default=None, description="folder of the sweep; by default runs/sweep-<name>"
    )
    seeds: int | None = quantity(
        "training seeds of each cell, 1 to N; by default the sweep's",
        "1",
        ge=1,
        le=1000,
        default=None,
    )
    steps: int | None = Field(
        default=None, description="decisions of each training; by default the sweep's"
    )
    episodes: int | None = Field(
        default=None,
        description="flights that judge each trained network; by default the sweep's",
    )
    seed: int | None = Field(
        default=None,
        description="seed of the first of these flights; flight i has seed + i, in every cell; by"
        " default the sweep's",
    )
    computer: str | None = Field(
        default=None,
        description="computer profile: each cell then shows its decision latency t2 there,"
        " estimated from multiply-accumulates; may change when a sweep goes on",
    )
    device: Literal["cpu", "cuda"] = Field(
        default="cpu", description="what trains: cpu, one core a trial, or cuda"
    )
    ray_gpus: float | None = quantity(
        "share of a GPU that Ray keeps for each trial; by default 1 with device cuda, else 0",
        "1",
        ge=0,
        le=8,
        default=None,
    )
    dry_run: bool = Field(
        default=False,
        description="say what would be done: trials, parameters, multiply-accumulates, decisions;"
        " nothing is trained or written",
    )


OPTIONS = SweepOptions


def run(options: SweepOptions, console: Console | None = None) -> int:
    """Carry out what is left of a sweep, and show what came out.

    Returns:
        Exit status: 0 all trials ended, 1 a trial cannot be carried out, 130 Ctrl-C.

    Raises:
        UsageError: The input cannot be used.
    """
    console = console or Console()
    config, settings = _config(options), _executor(options)
    computer = None
    if options.computer is not None:
        computer = Computer(options.computer, load_computer(options.computer))
        estimated_ms(computer.profile, 1)  # Raises for a computer without a workload.
    name = Path(options.sweep).stem
    path = (options.out or Path("runs") / f"sweep-{name}").absolute()
    if options.dry_run:
        print_plan(name, config, computer, path, console)
        return 0
    check_installed("train")
    with RichProgress(console) as progress, open_executor(settings) as executor:
        progress.note(f"sweep      {name}: {config.description}\nfolder     {path}")
        with stop_on_signals() as stop:
            sweep, error = run_sweep(
                path,
                config,
                executor,
                command=shlex.join(["airl", *sys.argv[1:]]),
                progress=progress,
                device=options.device,
                computer=computer,
                stop=stop,
            )
        if error is not None:
            progress.note(error, "yellow")
    if sweep.ended:
        document = document_of(sweep)
        print_document(document, console, write_document(document, path))
    if sweep.ended == sweep.planned:
        return 0
    told = "interrupted" if error is None else "not all trials have ended"
    progress.note(f"{told}: the same command with --out {path} goes on", "yellow")
    return EXIT_INTERRUPTED if error is None else EXIT_BROKEN


def _config(options: SweepOptions) -> SweepConfig:
    """Load the sweep, put the command line's values into it, and check it. Raises UsageError."""
    data = load_sweep(options.sweep).model_dump(exclude_unset=True)
    if options.seeds is not None:
        data["seeds"] = range(1, options.seeds + 1)
    for table, field, value in (
        ("training", "steps", options.steps),
        ("evaluation", "episodes", options.episodes),
        ("evaluation", "seed", options.seed),
    ):
        if value is not None:
            data.setdefault(table, {})[field] = value
    for grid in data["grids"]:
        load_profile("arenas", grid["arena"], ArenaSpec)
        if grid["arena"].endswith(".toml"):
            # Workers, and other machines, may have another working directory.
            grid["arena"] = f"{Path(grid['arena']).absolute()}"
    return validated(SweepConfig, data)


def _executor(options: SweepOptions) -> ExecutorSettings:
    """Return who carries out the trials. Raises UsageError."""
    gpus = options.ray_gpus
    if gpus is not None and options.executor != "ray":
        raise FieldError("ray_gpus", gpus, "with executor ray")
    if options.device == "cuda" and options.executor == "process":
        check_installed("train")
        import torch

        if not torch.cuda.is_available():
            raise FieldError("device", "cuda", "cpu: torch finds no GPU here")
    data = {name: getattr(options, name) for name in Workers.model_fields}
    default = 1.0 if options.device == "cuda" else 0.0
    return validated(ExecutorSettings, data | {"ray_gpus": default if gpus is None else gpus})
