"""The training specification: the network, and the algorithm that fits it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from airl_mav.core.fields import ProfileModel, quantity

NetworkKind = Literal["small", "appendix", "template"]
Precision = Literal["float32", "bfloat16"]
Option = bool | int | float | str | list[int | float | str]


class NetworkSpec(ProfileModel):
    """Convolutions over the depth image; velocity and goal join before the dense layers.

    `small`: convolutions 16-32-32-32 (3x3), dense 128x2; the fastest that learns well.
    `appendix`: Air Learning's network: convolutions 32 (4x4), 64 (4x4), 128 (2x2), 64 (1x1),
    dense 256x3. `template`: Air Learning's sweep: `layers` convolutions of `filters` 3x3 filters,
    stride 1, and as many dense layers of as many units.
    """

    kind: NetworkKind = "small"
    strides: tuple[int, int, int, int] | None = Field(
        default=None,
        description="strides of the four convolutions of small and appendix; "
        "left out: chosen by the height of the image",
    )
    layers: int | None = quantity(
        "convolutions, and dense layers, of a template", "1", ge=1, le=16, default=None
    )
    filters: int | None = quantity(
        "filters a convolution, and units a dense layer, of a template",
        "1",
        ge=1,
        le=256,
        default=None,
    )

    @model_validator(mode="after")
    def _fields_fit_kind(self) -> NetworkSpec:
        template = self.kind == "template"
        for name in ("layers", "filters"):
            if template == (getattr(self, name) is None):
                raise ValueError(
                    f"{name}: kind {self.kind!r} {'needs' if template else 'has no'} it"
                )
        if self.strides is None:
            return self
        if template:
            raise ValueError("strides: kind 'template' always has stride 1")
        if not all(1 <= stride <= 8 for stride in self.strides):
            raise ValueError(f"strides = {list(self.strides)}: accepted: 1 <= each <= 8")
        return self


class AlgorithmSpec(ProfileModel):
    """The learner and its hyperparameters.

    `dqn` (double, n-step) takes all fields; any other algorithm the first five, as far as it
    has them, and the rest of its own arguments in `options`.
    """

    name: str = Field(default="dqn", description="dqn, ppo or another by its class name")
    learning_rate: float = quantity("step of the optimiser", "1", gt=0, le=1, default=3e-4)
    learning_rate_final: float | None = quantity(
        "its last value, reached in a straight line; left out: it stays",
        "1",
        gt=0,
        le=1,
        default=None,
    )
    gamma: float = quantity("discount of a decision", "1", gt=0, le=1, default=0.98)
    batch_size: int | None = quantity(
        "samples an update; left out: 128 (ppo: 256)", "1", ge=2, le=65536, default=None
    )
    buffer_size: int = quantity("steps that replay remembers", "1", ge=100, le=10**8, default=10**5)
    learning_starts: int = quantity("steps before the first update", "1", ge=0, default=2000)
    n_step: int = quantity("rewards summed before the bootstrap", "1", ge=1, le=50, default=3)
    double: bool = Field(default=True, description="double Q-learning")
    env_steps_per_update: int = quantity("steps an update", "1", ge=1, le=100_000, default=32)
    target_interval: int = quantity("steps between target updates", "1", ge=1, default=8000)
    exploration_initial: float = quantity("first share of random", "1", ge=0, le=1, default=1.0)
    exploration_final: float = quantity(
        "last share of random actions", "1", ge=0, le=1, default=0.05
    )
    exploration_fraction: float = quantity(
        "share of the training in which exploration falls", "1", gt=0, le=1, default=0.3
    )
    precision: Precision = Field(
        default="float32", description="numbers of the updates; bfloat16 is for wide networks"
    )
    options: dict[str, Option] = Field(
        default_factory=dict, description="further arguments of the stable-baselines3 class"
    )
