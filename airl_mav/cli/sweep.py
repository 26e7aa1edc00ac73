"""`airl sweep`: the architecture search, here or on a cluster, taken up again after anything."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro
from pydantic import BaseModel, ValidationError
from rich.console import Console

from airl_mav.cli.common import EXIT_BROKEN, EXIT_INTERRUPTED, check_range, check_train_installed
from airl_mav.cli.signals import stop_on_signals
from airl_mav.core.errors import UsageError
from airl_mav.core.progress import RichProgress

if TYPE_CHECKING:
    from airl_mav.experiments.executors import ExecutorSettings
    from airl_mav.sweep.config import SweepConfig

GREATEST_SEEDS = 1000

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class SweepCommand:
    """Search for the network that flies best: train many, judge all, draw heat maps.

    Air Learning's search over its template: layers x filters, several training seeds a cell. The
    same --out goes on with what was interrupted, whoever was killed.
    """

    sweep: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SWEEP")] = "quick"
    """quick (two cores, an hour), full (the paper's grid), paper (the same on the paper's image,
    for GPUs), tiny (seconds, shows nothing), or a path to a .toml."""

    out: Path | None = None
    """Folder of the sweep. None: runs/sweep-<name>."""

    seeds: int | None = None
    """Training seeds of each cell, 1 to N, 1 to 1000. None: the sweep's."""

    steps: int | None = None
    """Decisions of each training. None: the sweep's."""

    episodes: int | None = None
    """Flights that judge each trained network. None: the sweep's."""

    seed: int | None = None
    """Seed of the first of these flights; flight i has seed + i, in every cell. None: the
    sweep's."""

    computer: str | None = None
    """Computer profile: a shipped name, or a path to a .toml. Each cell then shows its decision
    latency t2 there, estimated from multiply-accumulates. May change when a sweep goes on."""

    executor: Literal["process", "ray"] = "process"
    """Who carries out the trials: processes of this machine, or Ray."""

    workers: int | None = None
    """Trials at a time, 1 to 256, each on one core. None: one for each core, here or in the
    cluster."""

    ray_address: str = "local"
    """local starts a Ray here, auto takes the one that runs here, else HOST:PORT of a cluster whose
    machines all see --out."""

    device: Literal["cpu", "cuda"] = "cpu"
    """What trains: cpu, one core a trial, or cuda."""

    ray_gpus: float | None = None
    """Share of a GPU that Ray keeps for each trial, 0 to 8. None: 1 with --device cuda, else 0."""

    dry_run: bool = False
    """Say what would be done: trials, parameters, multiply-accumulates, decisions. Nothing is
    trained or written."""


def run(command: SweepCommand, console: Console | None = None) -> int:
    """Carry out what is left of a sweep, and show what came out.

    Returns:
        Exit status: 0 all trials ended, 1 a trial cannot be carried out, 130 Ctrl-C.

    Raises:
        UsageError: The input cannot be used.
    """
    from airl_mav.experiments.executors import open_executor
    from airl_mav.profiles.computer import load_computer
    from airl_mav.report.sweep.terminal import print_plan, print_sweep
    from airl_mav.sweep.run import run_sweep
    from airl_mav.sweep.summary import Computer, estimated_ms

    console = console or Console()
    config, settings = _config(command), _executor(command)
    computer = None
    if command.computer is not None:
        computer = Computer(command.computer, load_computer(command.computer))
        estimated_ms(computer.profile, 1)  # Raises for a computer without a workload.
    name = Path(command.sweep).stem
    path = (command.out or Path("runs") / f"sweep-{name}").absolute()
    if command.dry_run:
        print_plan(name, config, computer, path, console)
        return 0
    check_train_installed()
    with RichProgress(console) as progress, open_executor(settings) as executor:
        progress.note(f"sweep      {name}: {config.description}\nfolder     {path}")
        with stop_on_signals() as stop:
            sweep, error = run_sweep(
                path,
                config,
                executor,
                command=shlex.join(["airl", *sys.argv[1:]]),
                progress=progress,
                device=command.device,
                computer=computer,
                stop=stop,
            )
        if error is not None:
            progress.note(error, "yellow")
    if sweep.ended:
        from airl_mav.report.sweep.page import build_page

        print_sweep(sweep, console, build_page(sweep))
    if sweep.ended == sweep.planned:
        return 0
    told = "interrupted" if error is None else "not all trials have ended"
    progress.note(f"{told}: the same command with --out {path} goes on", "yellow")
    return EXIT_INTERRUPTED if error is None else EXIT_BROKEN


def _config(command: SweepCommand) -> SweepConfig:
    """Load the sweep, put the command line's values into it, and check it. Raises UsageError."""
    from airl_mav.profiles.arena import ArenaSpec
    from airl_mav.profiles.loading import load_profile
    from airl_mav.sweep.config import SweepConfig, load_sweep

    data = load_sweep(command.sweep).model_dump(exclude_unset=True)
    if command.seeds is not None:
        check_range("--seeds", command.seeds, 1, GREATEST_SEEDS)
        data["seeds"] = range(1, command.seeds + 1)
    for table, field, value in (
        ("training", "steps", command.steps),
        ("evaluation", "episodes", command.episodes),
        ("evaluation", "seed", command.seed),
    ):
        if value is not None:
            data.setdefault(table, {})[field] = value
    for grid in data["grids"]:
        load_profile("arenas", grid["arena"], ArenaSpec)
        if grid["arena"].endswith(".toml"):
            # Workers, and other machines, may have another working directory.
            grid["arena"] = f"{Path(grid['arena']).absolute()}"
    return _checked(SweepConfig, data)


def _executor(command: SweepCommand) -> ExecutorSettings:
    """Return who carries out the trials. Raises UsageError."""
    from airl_mav.experiments.executors import ExecutorSettings

    gpus = command.ray_gpus
    if gpus is not None and command.executor != "ray":
        raise UsageError(f"--ray-gpus {gpus:g}: accepted: with --executor ray")
    if command.device == "cuda" and command.executor == "process":
        check_train_installed()
        import torch

        if not torch.cuda.is_available():
            raise UsageError("--device cuda: torch finds no GPU here; accepted: cpu")
    data = {name: getattr(command, name) for name in ("executor", "workers", "ray_address")}
    default = 1.0 if command.device == "cuda" else 0.0
    return _checked(ExecutorSettings, data | {"ray_gpus": default if gpus is None else gpus})


def _checked(model: type[Model], data: dict[str, Any]) -> Model:
    """Return a model of the command line's values. Raises UsageError."""
    from airl_mav.profiles.loading import explain

    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise UsageError(explain(error, model)) from None
