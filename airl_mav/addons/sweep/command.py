"""`airl sweep`: resumable architecture search, on this machine or on a cluster."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from rich.console import Console

from airl_mav.addons.sweep.config import (
    SweepConfig,
    Trial,
    TrialResult,
    load_sweep,
    trials,
)
from airl_mav.addons.sweep.document import document_of, print_plan
from airl_mav.addons.sweep.summary import (
    Computer,
    Sweep,
    SweepFolder,
    declaration,
    estimated_ms,
    summarize,
    write_sweep,
)
from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.core import child_process, errors, fields
from airl_mav.core.progress import Progress, RichProgress, new_console
from airl_mav.experiments import executors
from airl_mav.experiments.campaign import open_campaign
from airl_mav.profiles import arena, loading
from airl_mav.profiles.computer import load_computer
from airl_mav.report.document import print_document, print_place, write_document
from airl_mav.scenario.model import Workers


class SweepOptions(Workers):
    """Search for the best network: train many networks, evaluate all, draw heat maps.

    The search space is Air Learning's template: layers x filters, with several training seeds per
    cell. The same --out resumes after any interruption.

    Examples:
        airl sweep quick
        airl sweep full --executor ray --ray-address 192.168.1.10:6379
        airl sweep quick --dry-run
    """

    sweep: Annotated[str, POSITIONAL] = Field(
        default="quick",
        description="quick (the paper's grid, taught by the planner: two cores, an hour), full (by"
        " DQN), paper (on the paper's image, for GPUs), tiny (seconds, shows nothing), or a path"
        " to a .toml",
    )
    out: Path | None = fields.optional("folder of the sweep; by default runs/sweep-<name>")
    seeds: int | None = fields.quantity(
        "training seeds of each cell, 1 to N; by default the sweep's",
        "1",
        ge=1,
        le=1000,
        default=None,
    )
    steps: int | None = fields.optional("decisions of each training; by default the sweep's")
    episodes: int | None = fields.optional(
        "flights that judge each trained network; by default the sweep's"
    )
    seed: int | None = fields.optional(
        "seed of the first of these flights; flight i has seed + i, in every cell; by"
        " default the sweep's"
    )
    computer: str | None = fields.optional(
        "computer profile: each cell then shows its decision latency t2 there,"
        " estimated from multiply-accumulates; may change when a sweep resumes"
    )
    device: Literal["cpu", "cuda"] = Field(
        default="cpu", description="device for training: cpu, one core per trial, or cuda"
    )
    ray_gpus: float | None = fields.quantity(
        "share of a GPU that Ray keeps for each trial; by default 1 with device cuda, else 0",
        "1",
        ge=0,
        le=8,
        default=None,
    )
    dry_run: bool = fields.switch(
        "say what would be done: trials, parameters, multiply-accumulates, decisions;"
        " nothing is trained or written"
    )

    @property
    def name(self) -> str:
        """Name of the sweep."""
        return Path(self.sweep).stem

    @property
    def path(self) -> Path:
        """Folder of the sweep, absolute."""
        return (self.out or Path("runs") / f"sweep-{self.name}").absolute()

    def config(self) -> SweepConfig:
        """Load the sweep, apply the given values, and validate the result."""
        data = load_sweep(self.sweep).model_dump(exclude_unset=True)
        if self.seeds is not None:
            data["seeds"] = range(1, self.seeds + 1)
        for table, field, value in (
            ("training", "steps", self.steps),
            ("evaluation", "episodes", self.episodes),
            ("evaluation", "seed", self.seed),
        ):
            if value is not None:
                data.setdefault(table, {})[field] = value
        for grid in data["grids"]:
            loading.load_profile("arenas", grid["arena"], arena.ArenaSpec)
            if grid["arena"].endswith(".toml"):
                # Workers, and other machines, may have another working directory.
                grid["arena"] = f"{Path(grid['arena']).absolute()}"
        return fields.validated(SweepConfig, data)

    def executor_settings(self) -> executors.ExecutorSettings:
        """Return the executor settings of the trials, with their GPU share."""
        gpus = self.ray_gpus
        if gpus is not None and self.executor != "ray":
            raise errors.FieldError("ray_gpus", gpus, "with executor ray")
        data = {name: getattr(self, name) for name in Workers.model_fields}
        default = 1.0 if self.device == "cuda" else 0.0
        return fields.validated(
            executors.ExecutorSettings, data | {"ray_gpus": default if gpus is None else gpus}
        )

    def for_computer(self) -> Computer | None:
        """Return the computer for each cell's decision latency, or None."""
        if self.computer is None:
            return None
        computer = Computer(self.computer, load_computer(self.computer))
        estimated_ms(computer.profile, 1)  # Raises for a computer without a workload.
        return computer


def _worker(
    folder: SweepFolder,
    command: str,
    device: str,
    mixed: bool,
    stop: executors.Stop,  # noqa: ARG001 (a worker is killed, and loses no checkpoint)
) -> Callable[[Trial], list[TrialResult]]:
    """Return the function that runs a trial."""
    # Imported late: the learner takes two seconds to load, and only a worker needs it.
    from airl_mav.addons.sweep.trial_run import run_trial

    return lambda trial: [run_trial(folder, trial, command, device, mixed)]


def run_sweep(
    path: Path,
    config: SweepConfig,
    executor: executors.Executor,
    *,
    command: str,
    progress: Progress,
    device: str = "cpu",
    computer: Computer | None = None,
    mixed_code: bool = False,
    stop: executors.Stop = executors.never,
) -> tuple[Sweep, str | None]:
    """Run the remaining trials; `sweep.json` is written after each.

    All workers see the folder, new or resumed, under this path. `stop` is polled several times a
    second. True stops the sweep and keeps finished trials. Returns the sweep so far, and the reason
    of an early end or None. Raises UsageError for invalid input, or if the folder contains
    something else.
    """
    say = partial(progress.note, style="yellow")
    with open_campaign(
        path, declaration(config), command=command, mixed=mixed_code, say=say
    ) as campaign:
        folder = SweepFolder(path.absolute(), config)

        def summary() -> Sweep:
            sweep = summarize(folder, campaign.made, computer)
            write_sweep(sweep)
            return sweep

        sweep, wanted = summary(), trials(config)
        waiting = [trial for trial in wanted if folder.result(trial) is None]
        bar = progress.bar("sweep", len(wanted), completed=sweep.ended, unit="trials")
        results = executor.run(
            waiting,
            partial(_worker, folder, command, device, mixed_code),
            name=lambda trial: trial.name,
            stop=stop,
            lost=say,
        )
        try:
            with closing(results):
                for _, result in results:
                    sweep = summary()
                    progress.note(_line(sweep.ended, len(wanted), result))
                    bar.update(completed=sweep.ended)
        except executors.WorkerError as error:
            return sweep, str(error)
        return sweep, None


def _line(ended: int, total: int, result: TrialResult) -> str:
    """Return the line of a finished trial."""
    trial, trained = result.trial, result.trained
    return (
        f"{ended:>{len(str(total))}}/{total}  "
        f"{trial.arena_name}  {trial.network:>6}  seed {trial.seed}  success "
        f"{result.success_rate:6.1%} of {result.episodes}, best after "
        f"{trained.best_steps:,} of {trained.steps:,} decisions, {trained.seconds:,.0f} s"
    )


OPTIONS = SweepOptions


def run(options: SweepOptions, console: Console | None = None) -> int:
    """Run the rest of a sweep and show it; return 0, 1 (a trial failed) or 130 (Ctrl-C)."""
    console = console or new_console()
    config, settings = options.config(), options.executor_settings()
    _check_device(options)
    computer, path = options.for_computer(), options.path
    if options.dry_run:
        print_plan(options.name, config, computer, path, console)
        return 0
    check_installed("train")
    with RichProgress(console) as progress, executors.open_executor(settings) as executor:
        progress.note(f"sweep      {options.name}: {config.description}\nfolder     {path}")
        with child_process.stop_on_signals() as stop:
            sweep, error = run_sweep(
                path,
                config,
                executor,
                command=shlex.join(["airl", *sys.argv[1:]]),
                progress=progress,
                device=options.device,
                computer=computer,
                mixed_code=options.mixed_code,
                stop=stop,
            )
        if error is not None:
            progress.note(error, "yellow")
    if sweep.ended:
        document = document_of(sweep)
        print_document(document, console)
        print_place(document.name, write_document(document, path), console)
    if sweep.ended == sweep.planned:
        return 0
    told = "interrupted" if error is None else "not all trials have ended"
    progress.note(f"{told}: resume with --out {path}", "yellow")
    return errors.EXIT_INTERRUPTED if error is None else errors.EXIT_BROKEN


def _check_device(options: SweepOptions) -> None:
    """Raise UsageError if the requested GPU is not available."""
    if options.device == "cuda" and options.executor == "process":
        check_installed("train")
        import torch

        if not torch.cuda.is_available():
            raise errors.FieldError("device", "cuda", "cpu: torch finds no GPU here")
