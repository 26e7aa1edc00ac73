"""What the commands that compare runs share: fly, compare, print."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from airl_mav.core.progress import RichProgress
from airl_mav.experiments.experiment import Experiment, ExperimentRun, run_experiment
from airl_mav.experiments.live import EXIT_CODES
from airl_mav.report.comparison.show import print_comparison


def fly_and_show(
    experiment: Experiment, out: Path | None, console: Console
) -> tuple[int, ExperimentRun]:
    """Fly what is left of an experiment and show the comparison of what is there.

    Returns:
        Exit status, 0 all episodes flown, 1 processes or workers were lost, 130 Ctrl-C; and what
        was flown.

    Raises:
        UsageError: The input cannot be used.
    """
    with RichProgress(console) as progress:
        flown = run_experiment(experiment, out, progress)
    if len(flown.cells) > 1 or flown.ended == "complete":
        comparison, loaded, page = flown.compare()
        print_comparison(comparison, loaded, console, page)
    return EXIT_CODES[flown.ended], flown
