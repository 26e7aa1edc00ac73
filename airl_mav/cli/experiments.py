"""What the commands that compare runs share: fly, compare, print."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from airl_mav.cli.gate import Gate, leave, requirements_of
from airl_mav.core.progress import RichProgress
from airl_mav.experiments.experiment import Experiment, ExperimentRun, run_experiment
from airl_mav.experiments.live import EXIT_CODES
from airl_mav.report.comparison.show import print_comparison
from airl_mav.report.verdict import load_verdict

NOTHING_REQUIRED = Gate()


def fly_and_show(
    experiment: Experiment, out: Path | None, console: Console, gate: Gate = NOTHING_REQUIRED
) -> tuple[int, ExperimentRun]:
    """Fly what is left of an experiment and show the comparison of what is there.

    Returns:
        Exit status, 0 all episodes flown, 1 processes or workers were lost, 3 to 5 as of the
        verdict, 130 Ctrl-C; and what was flown.

    Raises:
        UsageError: The input cannot be used.
    """
    requirements = requirements_of(gate)
    with RichProgress(console) as progress:
        flown = run_experiment(experiment, out, progress)
    code = EXIT_CODES[flown.ended]
    if len(flown.cells) > 1 or flown.ended == "complete":
        comparison, loaded, page = flown.compare(requirements)
        print_comparison(comparison, loaded, console, page)
        if flown.ended == "complete":
            verdict = load_verdict(flown.path)
            leave(gate, verdict, f"airl {experiment.kind}")
            code = verdict.exit_code
    return code, flown
