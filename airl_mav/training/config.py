"""A training run as a TOML file: environment, network, algorithm, and how long."""

from __future__ import annotations

from pydantic import Field

from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy.action_sets import discrete_actions
from airl_mav.training.spec import AlgorithmSpec, NetworkSpec

SELECTION_SEED = 500_000
"""First seed of the episodes that choose the best checkpoint: neither those of training, which
begin at a million, nor those that people evaluate with, which begin at one."""


class Selection(ProfileModel):
    """Periodic evaluation on fixed seeds; the best checkpoint is the run's result."""

    every: int = quantity("steps between evaluations", "1", ge=1, le=10**9, default=10_000)
    episodes: int = quantity("episodes of an evaluation", "1", ge=1, le=100_000, default=200)
    stop_at: float | None = quantity(
        "end the training once so large a share reach the goal; left out: never",
        "1",
        gt=0,
        le=1,
        default=None,
    )


class TrainingConfig(ProfileModel):
    """What is trained, on what, how long."""

    description: str = Field(description="one line for people")
    seed: int = quantity("of weights, exploration and episodes", "1", ge=0, le=2**31, default=1)
    steps: int = quantity(
        "decisions of all vehicles together", "1", ge=1, le=10**10, default=100_000
    )
    vehicles: int = quantity("flights at a time", "1", ge=1, le=100_000, default=32)
    checkpoint_every: int = quantity(
        "steps between checkpoints", "1", ge=1, le=10**9, default=20_000
    )
    environment: EnvironmentSpec = Field(
        default_factory=EnvironmentSpec, description="what flies where"
    )
    network: NetworkSpec = Field(default_factory=NetworkSpec, description="what decides")
    algorithm: AlgorithmSpec = Field(default_factory=AlgorithmSpec, description="what learns")
    selection: Selection = Field(default_factory=Selection, description="which weights are kept")

    @property
    def discrete(self) -> bool:
        """Whether the actions are numbered."""
        return discrete_actions(self.environment.action_spec) is not None
