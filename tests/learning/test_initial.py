"""Training that starts from the weights of another training."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest
import torch
from stable_baselines3.common.save_util import load_from_zip_file

from airl_mav.core.errors import UsageError
from airl_mav.training import training_run
from airl_mav.training.config import TrainingConfig
from airl_mav.training.training_folder import TrainingFolder

TINY: dict[str, Any] = {
    "description": "any",
    "steps": 80,
    "vehicles": 4,
    "environment": {
        "arena": "no-obstacles",
        "image_width_px": 16,
        "image_height_px": 12,
        "episode": {"goal_radius_m": 50},
    },
    "algorithm": {"learning_starts": 40, "buffer_size": 100, "env_steps_per_update": 4},
    "selection": {"every": 1000, "episodes": 2},
}


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that has ended."""
    out = tmp_path_factory.mktemp("initial") / "before"
    training_run.train(TrainingConfig.model_validate(TINY), out, name="before")
    return out


def weights(out: Path) -> dict[str, torch.Tensor]:
    _, found, _ = load_from_zip_file(TrainingFolder(out).best_model, load_data=False)
    return cast("dict[str, torch.Tensor]", found["policy"])


@pytest.mark.nightly
def test_begins_with_the_best_weights_of_a_run(before: Path, tmp_path: Path) -> None:
    # Training ends before its first update: its weights are still the initial weights.
    for name, initial, same in (("on", before, True), ("afresh", None, False)):
        changes = {"seed": 2, "steps": 20, "initial": None if initial is None else str(initial)}
        training_run.train(
            TrainingConfig.model_validate(TINY | changes), tmp_path / name, name=name
        )
        ours, theirs = weights(tmp_path / name), weights(before)
        assert all(ours[key].equal(theirs[key]) for key in theirs) is same
    noted = TrainingFolder(tmp_path / "on").about()["config"]["initial"]
    assert noted == str(before)


@pytest.mark.nightly
def test_ppo_goes_on_from_what_an_expert_has_taught(tmp_path: Path) -> None:
    """The mean of its actions is the pupil's; how widely it explores is its own."""
    environment = TINY["environment"] | {"actions": "velocity"}
    taught = TINY | {"environment": environment, "algorithm": {"name": "bc", "expert": "planner"}}
    training_run.train(TrainingConfig.model_validate(taught), tmp_path / "taught", name="taught")
    # Rollouts no longer than the training.
    options = {"log_std_init": -1.7, "n_steps": 20, "n_epochs": 2}
    algorithm = {"name": "ppo", "learning_rate": 1e-12, "batch_size": 20, "options": options}
    changes = {"algorithm": algorithm, "initial": str(tmp_path / "taught")}
    training_run.train(TrainingConfig.model_validate(taught | changes), tmp_path / "on", name="on")
    ours, theirs = weights(tmp_path / "on"), weights(tmp_path / "taught")
    assert torch.allclose(ours["action_net.weight"], theirs["action_net.weight"], atol=1e-6)
    assert ours["log_std"].tolist() == pytest.approx([-1.7, -1.7], abs=1e-4)
    assert theirs["log_std"].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"network": {"kind": "template", "layers": 1, "filters": 4}},
            "weights of 'dqn' that do not fit",
        ),
        ({"initial": "nowhere"}, "no training run here"),
    ],
)
def test_what_cannot_be_begun_with_gets_one_line(
    changes: dict[str, Any], told: str, before: Path, tmp_path: Path
) -> None:
    config = TrainingConfig.model_validate(TINY | {"initial": str(before)} | changes)
    with pytest.raises(UsageError, match=told) as error:
        training_run.train(config, tmp_path / "run", name="any")
    assert "\n" not in str(error.value)
