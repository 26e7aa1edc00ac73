"""What a person sees while a policy is trained."""

from __future__ import annotations

from airl_mav.core.progress import RichProgress
from airl_mav.training.store import Evaluation, TrainingProgress


class TrainingBar(TrainingProgress):
    """A bar with the success rate, a line for every evaluation. A `TrainingProgress`."""

    def __init__(self, progress: RichProgress, steps: int) -> None:
        self._progress = progress
        self._bar = progress.bar("training", steps, unit="decisions")

    def waiting(self, why: str) -> None:
        """Print a line."""
        self._progress.note(why)

    def trained(self, steps: int, success: float | None, zone: int | None) -> None:
        """Draw the bar."""
        text = "" if success is None else f"success {success:.0%} in training"
        text += "" if zone is None else f", zone {zone}"
        self._bar.update(completed=steps, postfix=text)

    def evaluated(self, evaluation: Evaluation, *, best: bool) -> None:
        """Print a line."""
        time = "" if evaluation.flight_time_s is None else f"{evaluation.flight_time_s:6.2f} s"
        zone = "" if evaluation.zone is None else f"  zone {evaluation.zone}"
        self._progress.note(
            f"{evaluation.steps:>11,} decisions {evaluation.seconds:7.0f} s  success "
            f"{evaluation.success_rate:6.1%}  {time}{zone}{'  best so far' if best else ''}"
        )
