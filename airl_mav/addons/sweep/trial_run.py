"""Training and evaluation of one trial of a sweep."""

from __future__ import annotations

import numpy as np

from airl_mav.addons.sweep.config import (
    TrainedTrial,
    Trial,
    TrialResult,
    result_of,
    size_of,
    training_of,
)
from airl_mav.addons.sweep.summary import SweepFolder
from airl_mav.envs.evaluation import SLOTS, EpisodeResult, LearnedPilots, fly_seeds
from airl_mav.envs.navigation import Navigation
from airl_mav.policy.registry import load_learned
from airl_mav.rehearsal.run_folder import locked
from airl_mav.training.config import TrainingConfig
from airl_mav.training.training_folder import TrainingFolder, TrainingProgress
from airl_mav.training.training_run import export_best, fit, nominal


def run_trial(
    folder: SweepFolder, trial: Trial, command: str, device: str, mixed: bool
) -> TrialResult:
    """Run or resume a trial on cpu or cuda; return its result. Raises UsageError."""
    config, path = training_of(folder.config, trial), folder.trial_path(trial)
    # Waits for an ending worker to release the trial.
    with locked(path, lambda _: None):
        training = TrainingFolder.begin(path, config, command, resume=True, mixed=mixed)
        # Checked under the lock: its previous owner may have ended the trial.
        if (done := folder.result(trial)) is not None:
            return done
        best = fit(config, training, TrainingProgress(), device)
        export_best(training, config, trial.name)
        seeds = folder.config.evaluation
        flown = fly_best(training, config, range(seeds.seed, seeds.seed + seeds.episodes))
        last = training.evaluations()[-1]
        trained = TrainedTrial(last.steps, best.steps, best.success_rate, last.seconds)
        size = size_of(folder.config, trial)
        result = result_of(trial, size.parameters, size.macs, trained, flown)
        folder.finish(result, training.checkpoints)
    return result


def fly_best(training: TrainingFolder, config: TrainingConfig, seeds: range) -> list[EpisodeResult]:
    """Fly the exported policy of a training like `airl evaluate`, at level gym."""
    policy = load_learned(training.policy, trust=True)
    navigation = Navigation(nominal(config.environment), min(SLOTS, len(seeds)))
    pilots = LearnedPilots(policy, lambda seed: np.random.default_rng(seed))
    return [flown for _, flown in fly_seeds(navigation, pilots, seeds)]
