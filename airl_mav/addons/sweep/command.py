"""`airl sweep`: resumable architecture search, on this machine or on a cluster."""

from __future__ import annotations

import shlex
import sys
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.addons.sweep.document import document_of, print_plan
from airl_mav.addons.sweep.run import SweepRequest, run_sweep
from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.core.errors import EXIT_BROKEN, EXIT_INTERRUPTED, FieldError
from airl_mav.core.progress import RichProgress, new_console
from airl_mav.experiments.process_executor import open_executor
from airl_mav.rehearsal.signals import stop_on_signals
from airl_mav.report.document import print_document, print_place, write_document


class SweepOptions(SweepRequest):
    """Search for the best network: train many networks, evaluate all, draw heat maps.

    The search space is Air Learning's template: layers x filters, with several training seeds per
    cell. The same --out resumes after any interruption.

    Examples:
        airl sweep quick
        airl sweep full --executor ray --ray-address 192.168.1.10:6379
        airl sweep quick --dry-run
    """

    sweep: Annotated[str, POSITIONAL] = Field(
        default="quick", description=SweepRequest.model_fields["sweep"].description
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
    with RichProgress(console) as progress, open_executor(settings) as executor:
        progress.note(f"sweep      {options.name}: {config.description}\nfolder     {path}")
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
        print_document(document, console)
        print_place(document.name, write_document(document, path), console)
    if sweep.ended == sweep.planned:
        return 0
    told = "interrupted" if error is None else "not all trials have ended"
    progress.note(f"{told}: the same command with --out {path} goes on", "yellow")
    return EXIT_INTERRUPTED if error is None else EXIT_BROKEN


def _check_device(options: SweepOptions) -> None:
    """Raise UsageError if the requested GPU is not available."""
    if options.device == "cuda" and options.executor == "process":
        check_installed("train")
        import torch

        if not torch.cuda.is_available():
            raise FieldError("device", "cuda", "cpu: torch finds no GPU here")
