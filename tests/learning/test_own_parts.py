"""A reward and a network of the user's: paid, trained, exported, flown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import validated
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.policy.card import load_card
from airl_mav.training.config import TrainingConfig
from airl_mav.training.training_run import train

PARTS = '''
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from airl_mav.envs.rewards import Step, reward_of


class Costly:
    """The shaped reward, and a price on every metre per second that is asked for."""

    price = 0.25

    def __call__(self, step: Step):
        return reward_of("shaped")(step) - self.price * abs(step.commands[:, 0])


def narrow(step: Step):
    return step.progress_m[:1]


def endless(step: Step):
    return step.progress_m / 0.0 - step.progress_m / 0.0


class Needy:
    def __init__(self, price):
        self.price = price


class Bearing(BaseFeaturesExtractor):
    """Sees nothing but where the goal is, and a blur of the image."""

    def __init__(self, observation_space, width):
        super().__init__(observation_space, width)
        self.blur = nn.AvgPool2d(observation_space["depth"].shape[1:])
        self.dense = nn.Linear(4, width)

    def forward(self, seen):
        blur = self.blur(seen["depth"]).flatten(1)
        return self.dense(torch.cat([blur, seen["goal"]], dim=1))


class Undecided(Bearing):
    """Asks Python what to do with what it sees, which no graph can."""

    def forward(self, seen):
        found = super().forward(seen)
        return found if float(found.sum()) > 0.0 else 2.0 * found
'''


@pytest.fixture
def parts(tmp_path: Path) -> str:
    path = tmp_path / "parts.py"
    path.write_text(PARTS)
    return str(path)


def test_the_environment_pays_the_user_s_reward(parts: str) -> None:
    ours = NavigationVectorEnv(3, arena="no-obstacles")
    theirs = NavigationVectorEnv(3, arena="no-obstacles", reward=f"{parts}:Costly")
    for env in (ours, theirs):
        env.reset(seed=1)
    # arc-25: 40, 70 and 100 % of 5 m/s.
    actions = np.array([12, 17, 22])
    difference = ours.step(actions)[1] - theirs.step(actions)[1]
    assert difference == pytest.approx(0.25 * np.array([2.0, 3.5, 5.0]))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("narrow", r"reward '.*:narrow': gives an array \(1,\); accepted: \(2,\) numbers"),
        ("endless", r"reward '.*:endless': gives what is no number; accepted: \(2,\) numbers"),
        ("Needy", r"reward '.*:Needy': cannot be made without arguments: TypeError: "),
        ("absent", r"reward '.*:absent': accepted: a function, or a class"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*divide by zero:RuntimeWarning")
@pytest.mark.filterwarnings("ignore:.*invalid value:RuntimeWarning")
def test_a_reward_that_cannot_be_paid_is_told_in_one_line(
    parts: str, name: str, words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        env = NavigationVectorEnv(2, arena="no-obstacles", reward=f"{parts}:{name}")
        env.reset(seed=1)
        env.step(np.array([22, 22]))


@pytest.mark.nightly
def test_a_network_of_the_user_s_trains_and_flies(parts: str, tmp_path: Path) -> None:
    config = validated(
        TrainingConfig,
        {
            "description": "of one's own",
            "steps": 400,
            "vehicles": 8,
            "environment": {"arena": "no-obstacles", "reward": f"{parts}:Costly"},
            "network": {
                "kind": f"{parts}:Bearing",
                "options": {"width": 16},
                "dense": [24],
            },
            "algorithm": {"learning_starts": 100},
            "selection": {"every": 400, "episodes": 4},
        },
    )
    train(config, tmp_path / "run", name="mine")
    card = load_card(tmp_path / "run/policy")
    assert card.network == "dense 16, dense 24, dense 25"
    assert card.parameters == 5 * 16 + 17 * 24 + 25 * 25
    assert card.training.config["environment"]["reward"] == f"{parts}:Costly"


def test_a_network_that_cannot_be_exported_is_refused_before_it_learns(
    parts: str, tmp_path: Path
) -> None:
    data = {
        "description": "of one's own",
        "environment": {"arena": "no-obstacles"},
        "network": {"kind": f"{parts}:Undecided", "options": {"width": 16}},
    }
    with pytest.raises(UsageError, match="cannot export the network"):
        train(validated(TrainingConfig, data), tmp_path / "run", name="mine")
    assert not list((tmp_path / "run").iterdir())


def test_what_is_no_extractor_is_refused(parts: str, tmp_path: Path) -> None:
    data = {
        "description": "of one's own",
        "environment": {"arena": "no-obstacles"},
        "network": {"kind": f"{parts}:Costly"},
    }
    with pytest.raises(FieldError, match=r"network\.kind '.*': accepted: a class of SB3's Base"):
        train(validated(TrainingConfig, data), tmp_path / "run", name="mine")
