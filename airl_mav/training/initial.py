"""Weights to begin with: those of a training run that was before."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.save_util import load_from_zip_file

from airl_mav.core.errors import UsageError
from airl_mav.training.store import TrainingFolder


def begin_with(model: BaseAlgorithm, run: Path, log_std: float | None = None) -> None:
    """Give a learner the best weights of a training run; its optimiser begins afresh.

    Weights are all that the networks of a learner hold: the value's and the exploration's too.

    Args:
        model: A learner of the same algorithm, with the same inputs, network and actions.
        run: Folder of the training run, of which the newest evaluation may still be to come.
        log_std: Logarithm of the standard deviation of continuous actions to begin with; None:
            the run's. What an expert has taught knows none.

    Raises:
        UsageError: There is no run, it has not been evaluated yet, or its weights do not fit.
    """
    folder = TrainingFolder(run)
    learned = folder.about()["config"]["algorithm"]["name"]
    if folder.best() is None:
        raise UsageError(f"initial = '{run}': no weights yet; accepted: a run that was evaluated")
    # Only tensors are read: nothing is unpickled.
    _, states, _ = load_from_zip_file(folder.best_model, device=model.device, load_data=False)
    try:
        # stable-baselines3 calls a network's state a tensor.
        model.policy.load_state_dict(cast("dict[str, Any]", states["policy"]))
    except RuntimeError:
        raise UsageError(
            f"initial = '{run}': weights of {learned!r} that do not fit; accepted: a run with the"
            " same algorithm, network, observation and actions"
        ) from None
    if log_std is not None:
        cast("ActorCriticPolicy", model.policy).log_std.data.fill_(log_std)
