"""Configuration of a training run, a TOML file: environment, network, algorithm, duration."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, field_validator, model_validator

from airl_mav.core.addons import entries, load
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel, optional, quantity, switch, validated
from airl_mav.core.plugins import NETWORKS, part_name
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy.actions import SHIPPED, ActionSpec, discrete_actions
from airl_mav.profiles.computer import load_computer
from airl_mav.training.algorithm_table import CORE_ALGORITHMS, ActionKind, Algorithm

SELECTION_SEED = 500_000
"""First seed of the selection episodes; training starts at a million, evaluation at one."""

HELD_OUT_SEED = 900_000
"""First seed held out for the final evaluation; training draws arenas from 1,000,000 on."""

ALGORITHMS: dict[str, Algorithm] = CORE_ALGORITHMS | {
    name: load(place) for name, place in entries("airl_mav", "ALGORITHMS").items()
}
"""Learning algorithms of the core and of add-ons."""

SHIPPED_NETWORKS = ("small", "appendix", "template")
NetworkKind = Annotated[str, part_name(NETWORKS, SHIPPED_NETWORKS)]
Precision = Literal["float32", "bfloat16"]
ExpertName = Literal["planner", "gates"]
Option = bool | int | float | str | list[int | float | str]


def check_seeds(seed: int, count: int = 1, field: str = "seed") -> None:
    """Raise FieldError if one of `count` seeds from `seed` on is held out."""
    if seed > (greatest := HELD_OUT_SEED - count):
        why = f"seeds from {HELD_OUT_SEED} on are held out for the final evaluation"
        raise FieldError(field, seed, f"0 to {greatest}; choose a lower one: {why}")


def kind_of(actions: str) -> ActionKind:
    """Return whether an action set is discrete or continuous."""
    return "continuous" if discrete_actions(ActionSpec(set=actions)) is None else "discrete"


ACTION_SETS = {
    kind: [name for name in SHIPPED if kind_of(name) == kind] for kind in get_args(ActionKind)
}


class NetworkSpec(ProfileModel):
    """Convolutions over the depth image; velocity and goal join before the dense layers.

    `small`: convolutions 16-32-32-32 (3x3), dense 128x2; the fastest that learns well. `appendix`:
    Air Learning's network: convolutions 32 (4x4), 64 (4x4), 128 (2x2), 64 (1x1), dense 256x3.
    `template`: Air Learning's sweep: `layers` convolutions of `filters` 3x3 filters, stride 1, and
    as many dense layers of as many units. Any other is a custom features extractor for
    stable-baselines3, as MODULE:CLASS or FILE.py:CLASS, which receives all inputs.
    """

    kind: NetworkKind = Field(default="small", description="network")
    strides: tuple[int, int, int, int] | None = optional(
        "strides of the four convolutions of small and appendix; "
        "left out: chosen by the height of the image"
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

    dense: tuple[Annotated[int, Field(ge=1, le=65536)], ...] | None = optional(
        "units of each dense layer behind an extractor of your own; left out: 128, 128"
    )
    options: dict[str, Option] = Field(
        default_factory=dict, description="arguments of an extractor of your own"
    )

    @property
    def own(self) -> bool:
        """True for a custom extractor."""
        return self.kind not in SHIPPED_NETWORKS

    @model_validator(mode="after")
    def _fields_fit_kind(self) -> NetworkSpec:
        for name in ("strides",) if self.own else ("dense", "options"):
            if getattr(self, name):
                raise ValueError(f"{name}: kind {self.kind!r} has no such field")
        template = self.kind == "template"
        for name in ("layers", "filters"):
            if template == (getattr(self, name) is None):
                raise ValueError(
                    f"{name}: kind {self.kind!r} {'needs it' if template else 'has no such field'}"
                )
        if self.strides is None:
            return self
        if template:
            raise ValueError("strides: kind 'template' always has stride 1")
        if not all(1 <= stride <= 8 for stride in self.strides):
            raise ValueError(f"strides = {list(self.strides)}: accepted: 1 <= each <= 8")
        return self


class AlgorithmSpec(ProfileModel):
    """The learner and its hyperparameters (`algorithm_table`), specific ones in `options`."""

    name: str = Field(default="dqn", description=", ".join(ALGORITHMS))
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
    expert: ExpertName = Field(
        default="planner",
        description="expert to imitate: planner, with the true arena, or gates, with the openings"
        " of the arena's gates",
    )
    options: dict[str, Option] = Field(
        default_factory=dict,
        description="hyperparameters that the algorithm alone has, by stable-baselines3's names",
    )

    @field_validator("name")
    @classmethod
    def _is_known(cls, name: str) -> str:
        if name not in ALGORITHMS:
            raise FieldError("algorithm.name", name, ", ".join(ALGORITHMS))
        return name

    @model_validator(mode="after")
    def _options_fit_the_algorithm(self) -> AlgorithmSpec:
        options = ALGORITHMS[self.name].options
        check_names(self, options.model_fields)
        try:
            validated(options, self.options)
        except FieldError as error:
            raise FieldError(
                f"algorithm.options.{error.field}", error.value, error.accepted, error.problem
            ) from None
        return self


def check_fields(spec: AlgorithmSpec) -> None:
    """Raise FieldError for a given field that the algorithm does not have.

    Not a validator of the model, because a run's stored configuration contains every field.
    """
    known = ALGORITHMS[spec.name].fields
    for name in sorted(spec.model_fields_set - {"name", "options", "learning_rate_final"}):
        if name not in known:
            raise FieldError(
                f"algorithm.{name}",
                problem=f"{spec.name!r} has no such field; fields: {', '.join(known)}",
            )


def check_names(spec: AlgorithmSpec, accepted: Iterable[str]) -> None:
    """Raise FieldError for an option that is not accepted."""
    names = list(accepted)
    for name in spec.options:
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"accepted: {', '.join(names)}"
            raise FieldError(
                f"algorithm.options.{name}", problem=f"unknown to {spec.name!r}; {hint}"
            )


def check_actions(name: str, kind: ActionKind) -> None:
    """Raise FieldError unless an algorithm supports a kind of action set."""
    wanted = ALGORITHMS[name].actions
    if wanted not in (None, kind):
        sets = ", ".join(ACTION_SETS[wanted])
        suited = [each for each, row in ALGORITHMS.items() if row.actions in (None, kind)]
        raise FieldError(
            "algorithm.name",
            name,
            f"a {wanted} action set (environment.actions: {sets}), and this one is {kind}; "
            f"with it: {', '.join(suited)}",
        )


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
    """A training run: environment, network, algorithm, duration."""

    description: str = Field(description="one line for people")
    seed: int = quantity("of weights, exploration and episodes", "1", ge=0, le=2**31, default=1)
    steps: int = quantity(
        "decisions of all vehicles together", "1", ge=1, le=10**10, default=100_000
    )
    vehicles: int = quantity("flights at a time", "1", ge=1, le=100_000, default=32)
    initial: str | None = optional(
        "folder of a training run whose best weights this one begins with; left out:"
        " with fresh ones"
    )
    checkpoint_every: int = quantity(
        "steps between checkpoints", "1", ge=1, le=10**9, default=20_000
    )
    keep_zones: bool = switch(
        "keep a checkpoint and the weights with which each curriculum zone was done"
    )
    environment: EnvironmentSpec = Field(default_factory=EnvironmentSpec, description="environment")
    network: NetworkSpec = Field(default_factory=NetworkSpec, description="network")
    algorithm: AlgorithmSpec = Field(default_factory=AlgorithmSpec, description="algorithm")
    selection: Selection = Field(default_factory=Selection, description="periodic evaluation")

    @model_validator(mode="after")
    def _chooses_from_the_action_set(self) -> TrainingConfig:
        check_seeds(self.seed)
        # A custom set is checked at the start of training: reading a file runs no code.
        if self.environment.actions in SHIPPED:
            check_actions(self.algorithm.name, kind_of(self.environment.actions))
        return self


def configured(
    config: TrainingConfig,
    *,
    seed: int | None = None,
    steps: int | None = None,
    computer: str | None = None,
    workload: str | None = None,
    latency: tuple[str, ...] = (),
    sensing_distance_m: float | None = None,
    initial: str | None = None,
) -> TrainingConfig:
    """Return a configuration with some of its values changed.

    `steps` are decisions of all vehicles together. The latency t2 is drawn from a `workload` of the
    `computer`, or from the sources `latency`. `initial` is the training run with the initial
    weights. Raises UsageError if a value is out of range, or requires another one.
    """
    if computer is not None and workload is None:
        known = ", ".join(load_computer(computer).workloads)
        raise FieldError("computer", computer, problem=f"takes workload: {known}")
    if computer is None and workload is not None:
        raise FieldError("workload", workload, "with computer")
    if computer is not None and latency:
        raise FieldError("latency", latency, "without computer")
    values: dict[str, Any] = config.model_dump(exclude_unset=True)
    given = {"seed": seed, "steps": steps, "initial": initial}
    values |= {k: v for k, v in given.items() if v is not None}
    environment = values.setdefault("environment", {})
    if computer is not None or latency:
        kept = environment.get("delay", {})
        kept = {k: v for k, v in kept.items() if k not in ("computer", "workload", "latency")}
        source = {"latency": latency} if latency else {"computer": computer, "workload": workload}
        environment["delay"] = kept | source
    if sensing_distance_m is not None:
        environment["safe_velocity"] = {"sensing_distance_m": sensing_distance_m}
    return validated(TrainingConfig, values)
