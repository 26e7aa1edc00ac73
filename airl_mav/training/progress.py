"""What is seen while a policy is trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from airl_mav.core.progress import Event, Progress
from airl_mav.training.store import Evaluation, TrainingProgress

FLOWN_BY_CHANCE = 0.2
"""So much more of success in training than on the selection's episodes is told."""


@dataclass(frozen=True)
class Evaluated(Event):
    """The policy was evaluated on the selection episodes."""

    event: ClassVar[str] = "evaluation"
    steps: int
    """Decisions of all vehicles so far."""
    episodes: int
    success_rate: float
    """Of those episodes, 0 to 1."""
    collision_rate: float
    flight_time_s: float | None
    """Mean of those that reached the goal; None: none did."""
    zone: int | None
    """Open zone of the curriculum; None: there is none."""
    best: bool
    """Whether it is better than all before it."""


@dataclass(frozen=True)
class Exported(Event):
    """The best weights were exported."""

    event: ClassVar[str] = "policy"
    path: str


class TrainingBar(TrainingProgress):
    """A bar with the success rate, a line for every evaluation. A `TrainingProgress`."""

    def __init__(self, progress: Progress, steps: int) -> None:
        self._progress = progress
        self._bar = progress.bar("training", steps, unit="decisions")

    def waiting(self, why: str) -> None:
        """Print a line."""
        self._progress.note(why)

    def trained(self, steps: int, success: float | None, zone: int | None) -> None:
        """Draw the bar."""
        text = "" if success is None else f"success {success:.0%} in training"
        text += "" if zone is None else f", zone {zone}"
        figures = {"training_success": success, "zone": zone}
        self._bar.update(completed=steps, postfix=text, figures=figures)

    def evaluated(self, evaluation: Evaluation, *, best: bool) -> None:
        """Print a line, and tell programs."""
        self._progress.tell(
            Evaluated(
                steps=evaluation.steps,
                episodes=evaluation.episodes,
                success_rate=evaluation.success_rate,
                collision_rate=evaluation.collision_rate,
                flight_time_s=evaluation.flight_time_s,
                zone=evaluation.zone,
                best=best,
            )
        )
        time = "" if evaluation.flight_time_s is None else f"{evaluation.flight_time_s:6.2f} s"
        zone = "" if evaluation.zone is None else f"  zone {evaluation.zone}"
        zone += _of_training(evaluation)
        self._progress.note(
            f"{evaluation.steps:>11,} decisions {evaluation.seconds:7.0f} s  success "
            f"{evaluation.success_rate:6.1%}  {time}{zone}{'  best so far' if best else ''}"
        )


def _of_training(evaluation: Evaluation) -> str:
    """Return the training success if random actions make it differ from the evaluation."""
    success = evaluation.training_success
    if success is None or success - evaluation.success_rate < FLOWN_BY_CHANCE:
        return ""
    return f"  ({success:.1%} with training's random actions)"
