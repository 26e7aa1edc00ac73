"""`airl sweep`: the architecture search, here or on a cluster, taken up again after anything."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from pydantic import ValidationError
from rich.console import Console

from airl_mav.cli.common import (
    EXIT_BROKEN,
    EXIT_INTERRUPTED,
    GREATEST_SEED,
    check_range,
    check_train_installed,
)
from airl_mav.cli.episode_bar import stop_on_signals
from airl_mav.cli.sweep_command import SweepCommand
from airl_mav.cli.sweep_progress import SweepProgress
from airl_mav.core.errors import UsageError
from airl_mav.core.provenance import usable_cores
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import explain, load_profile
from airl_mav.rehearsal.workers import GREATEST_WORKERS, WorkerError
from airl_mav.sweep.config import Examination, Grid, SweepConfig, load_sweep
from airl_mav.sweep.executors import Executor, LocalExecutor, Work
from airl_mav.sweep.store import SweepFolder
from airl_mav.sweep.summary import Computer, estimated_ms, summarize, write_sweep
from airl_mav.sweep.trial import trials

GREATEST_SEEDS = 1000
GREATEST_GPUS = 8.0


def run(command: SweepCommand, console: Console | None = None) -> int:
    """Carry out what is left of a sweep, and show what came out.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status: 0 all trials ended, 1 a trial cannot be carried out, 130 Ctrl-C.

    Raises:
        UsageError: The input cannot be used.
    """
    console = console or Console()
    config, computer = sweep_of(command), _computer(command)
    name = Path(command.sweep).stem
    path = (command.out or Path("runs") / f"sweep-{name}").absolute()
    if command.dry_run:
        from airl_mav.report.sweep import print_plan

        print_plan(name, config, computer, path, console)
        return 0
    _check_installed(command)
    folder = SweepFolder.at(path, config)
    with folder.locked():
        made = folder.made(shlex.join(["airl", *sys.argv[1:]]))
        sweep = summarize(folder, made, computer)
        write_sweep(sweep)
        console.print(f"sweep      {name}: {config.description}", markup=False, highlight=False)
        console.print(f"folder     {path}", soft_wrap=True, markup=False, highlight=False)
        code = _carry_out(
            command, folder, console, lambda: write_sweep(summarize(folder, made, computer))
        )
        sweep = summarize(folder, made, computer)
        write_sweep(sweep)
        if sweep.ended:
            from airl_mav.report.document import print_document, write_document
            from airl_mav.report.sweep import document_of

            document = document_of(sweep)
            print_document(document, console, write_document(document, path))
    if code:
        told = "interrupted" if code == EXIT_INTERRUPTED else "not all trials have ended"
        console.print(
            f"{told}: the same command with --out {path} goes on",
            style="yellow",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )
    return code


def _carry_out(
    command: SweepCommand, folder: SweepFolder, console: Console, ended: Callable[[], None]
) -> int:
    """Carry out the trials that are left; `ended` is called as each one ends."""
    wanted = trials(folder.config)
    waiting = [trial for trial in wanted if folder.result(trial) is None]
    if not waiting:
        return 0
    # Imported late: the learner takes two seconds to load, and a typo must not wait for it.
    from airl_mav.sweep.work import TrialWork

    work = TrialWork(folder, shlex.join(["airl", *sys.argv[1:]]), command.device)
    progress = SweepProgress(console, folder, wanted, len(wanted) - len(waiting))
    with ExitStack() as stack:
        executor = stack.enter_context(_executor(command, work, progress.say))
        stack.enter_context(progress)
        progress.begin(waiting)
        interrupted = stack.enter_context(stop_on_signals())

        def stop() -> bool:
            progress.look()
            return interrupted()

        try:
            for result in executor.run(waiting, stop):
                progress.finished(result)
                ended()
        except WorkerError as error:
            progress.say(str(error))
            return EXIT_BROKEN
        return EXIT_INTERRUPTED if interrupted() else 0


@contextmanager
def _executor(command: SweepCommand, work: Work, lost: Callable[[str], None]) -> Iterator[Executor]:
    """Give whoever carries out the trials."""
    cores = min(usable_cores(), GREATEST_WORKERS)
    if command.ray is None:
        yield LocalExecutor(work, command.workers or cores, lost)
        return
    from airl_mav.sweep.ray_executor import LOCAL, RayExecutor, connected

    cores = command.workers or cores
    most = cores if command.ray == LOCAL else command.workers
    gpus = command.ray_gpus
    if gpus is None:
        gpus = 1.0 if command.device == "cuda" else 0.0
    with connected(command.ray, cores):
        yield RayExecutor(work, most, gpus, lost)


def sweep_of(command: SweepCommand) -> SweepConfig:
    """Load the sweep, put the command line's values into it, and check it. Raises UsageError."""
    if command.workers is not None:
        check_range("--workers", command.workers, 1, GREATEST_WORKERS)
    if command.ray_gpus is not None:
        if command.ray is None:
            raise UsageError(f"--ray-gpus {command.ray_gpus:g}: accepted: with --ray")
        check_range("--ray-gpus", command.ray_gpus, 0.0, GREATEST_GPUS)
    config = load_sweep(command.sweep)
    changes: dict[str, object] = {}
    if command.seeds is not None:
        check_range("--seeds", command.seeds, 1, GREATEST_SEEDS)
        changes["seeds"] = tuple(range(1, command.seeds + 1))
    if command.steps is not None:
        check_range("--steps", command.steps, 1, 10**10)
        changes["training"] = config.training.model_copy(update={"steps": command.steps})
    flights = config.evaluation.model_dump()
    if command.episodes is not None:
        check_range("--episodes", command.episodes, 1, 100_000)
        flights["episodes"] = command.episodes
    if command.seed is not None:
        check_range("--seed", command.seed, 0, GREATEST_SEED)
        flights["seed"] = command.seed
    changes["evaluation"] = _examination(flights)
    # Workers, and other machines, may have another working directory.
    changes["grids"] = tuple(_found(grid) for grid in config.grids)
    return config.model_copy(update=changes)


def _examination(flights: dict[str, int]) -> Examination:
    try:
        return Examination.model_validate(flights)
    except ValidationError as error:
        told = explain(error, Examination)
        raise UsageError(f"--episodes, --seed: {told}") from None


def _found(grid: Grid) -> Grid:
    """Return a grid whose arena exists, by its full path if it has one. Raises UsageError."""
    load_profile("arenas", grid.arena, ArenaSpec)
    if not grid.arena.endswith(".toml"):
        return grid
    return grid.model_copy(update={"arena": f"{Path(grid.arena).absolute()}"})


def _computer(command: SweepCommand) -> Computer | None:
    """Return the computer whose latency is estimated. Raises UsageError."""
    if command.computer is None:
        return None
    computer = Computer(command.computer, load_computer(command.computer))
    estimated_ms(computer.profile, 1)
    return computer


def _check_installed(command: SweepCommand) -> None:
    """Raise UsageError unless all that the trainings need is there."""
    check_train_installed()
    if command.ray is not None:
        from airl_mav.sweep.ray_executor import check_ray_installed

        check_ray_installed()
    elif command.device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise UsageError("--device cuda: torch finds no GPU here; accepted: cpu")
