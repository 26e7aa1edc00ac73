"""Carry out a trial: train, choose the best weights, export them, fly them, write the result.

Every part is there to be killed: training goes on from its newest checkpoint, what comes after it
is done again in seconds, and the result appears whole.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.envs.evaluation import SLOTS, EpisodeResult, LearnedPilots, fly_seeds
from airl_mav.envs.navigation import Navigation
from airl_mav.policy.learned import load_learned
from airl_mav.sweep.store import SweepFolder, TrainingProgress
from airl_mav.sweep.trial import Trained, Trial, TrialResult, result_of, size_of, training_of
from airl_mav.training.config import TrainingConfig
from airl_mav.training.run import export_best, fit, nominal
from airl_mav.training.store import CONFIG_FILE, Evaluation, TrainingFolder
from airl_mav.training.store import TrainingProgress as TrainingListener

NOTE_US = 2 * US_PER_S
"""How often a training says how far it is [wall µs]."""

PATIENCE_US = 30 * US_PER_S
"""Longest wait for a process that is just ending to let go of a trial [wall µs]."""

POLL_US = US_PER_S // 5


def run_trial(folder: SweepFolder, trial: Trial, command: str, device: str) -> TrialResult:
    """Carry out a trial from wherever it is, or return what it came to.

    Args:
        folder: The sweep's.
        trial: Which one.
        command: The command line, for the policy's card.
        device: What trains: cpu or cuda.

    Raises:
        UsageError: It cannot be trained, or another process is at it.
    """
    config, path = training_of(folder.config, trial), folder.trial_path(trial)
    if (path / CONFIG_FILE).exists():
        training = TrainingFolder.open(path, config)
    else:
        training = TrainingFolder.create(path, config, command)
    with _held(training):
        # Looked at under the lock: whoever had it may have ended the trial.
        if (done := folder.result(trial)) is not None:
            return done
        best = fit(config, training, _Watcher(folder, trial), device)
        export_best(training, config, trial.name)
        seeds = folder.config.evaluation
        flown = fly_best(training, config, range(seeds.seed, seeds.seed + seeds.episodes))
        last = training.evaluations()[-1]
        trained = Trained(last.steps, best.steps, best.success_rate, last.seconds)
        size = size_of(folder.config, trial)
        result = result_of(trial, size.parameters, size.macs, trained, flown)
        folder.finish(result, training.checkpoints)
    return result


def fly_best(training: TrainingFolder, config: TrainingConfig, seeds: range) -> list[EpisodeResult]:
    """Fly the exported policy of a training as `airl evaluate` would, at level gym."""
    policy = load_learned(training.policy)
    navigation = Navigation(nominal(config.environment), min(SLOTS, len(seeds)))
    pilots = LearnedPilots(policy, lambda seed: np.random.default_rng(seed))
    return [flown for _, flown in fly_seeds(navigation, pilots, seeds)]


@contextmanager
def _held(training: TrainingFolder) -> Iterator[None]:
    """Hold a trial's lock; wait a while for a process that is just being ended to let go."""
    clock = WallClock()
    while True:
        lock = training.locked()
        try:
            lock.__enter__()
        except UsageError:
            if clock.time_us() > PATIENCE_US:
                raise
            clock.sleep_until(clock.time_us() + POLL_US)
            continue
        break
    try:
        yield
    finally:
        lock.__exit__(None, None, None)


class _Watcher(TrainingListener):
    """Leaves a note of the progress now and then."""

    def __init__(self, folder: SweepFolder, trial: Trial) -> None:
        self._folder, self._trial = folder, trial
        self._clock = WallClock()
        self._due_us = 0
        self._success: float | None = None

    def trained(self, steps: int, success: float | None, zone: int | None) -> None:  # noqa: ARG002
        """Training goes on."""
        if self._clock.time_us() >= self._due_us:
            self._due_us = self._clock.time_us() + NOTE_US
            self._folder.note_progress(self._trial, TrainingProgress(steps, self._success))

    def evaluated(self, evaluation: Evaluation, *, best: bool) -> None:  # noqa: ARG002
        """An evaluation is done."""
        self._success = evaluation.success_rate
