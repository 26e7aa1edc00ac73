"""What differs between the algorithms: one row each, and the hyperparameters that each has.

`[algorithm]` of a training file has the fields that algorithms share, `[algorithm.options]` those
of one alone, under the names that stable-baselines3 and sb3-contrib give them. What is left out is
their default, or `Algorithm.defaults`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import Field

from airl_mav.core.fields import ProfileModel, quantity

ActionKind = Literal["discrete", "continuous"]

EARLIER_NAMES = {"qrdqn": "qr-dqn"}
"""Names that training files of earlier versions have."""

_GRADIENT_NORM = "greatest norm of a gradient; greater ones are scaled down"
_LAMBDA = "lambda of the generalised advantage estimate"
_ADVANTAGE = "scale the advantages of a batch to mean 0, deviation 1"


class Options(ProfileModel):
    """What every algorithm of stable-baselines3 has."""

    stats_window_size: int | None = quantity(
        "episodes that the logged means are of", "1", ge=1, le=10**6, default=None
    )


class TargetNumbers(ProfileModel):
    """What a target network has."""

    tau: float | None = quantity(
        "share of the online network in an update of the target network",
        "1",
        gt=0,
        le=1,
        default=None,
    )


class TargetOptions(Options, TargetNumbers):
    """Options of the algorithms with a target network."""


class DqnOptions(TargetOptions):
    """Options of `dqn`."""

    max_grad_norm: float | None = quantity(_GRADIENT_NORM, "1", gt=0, le=1e6, default=None)


class DdpgOptions(TargetNumbers):
    """Options of `ddpg` (Lillicrap et al., arXiv 1509.02971), and of all with SB3's replay."""

    train_freq: int | None = quantity(
        "steps of each vehicle between two rounds of updates", "1", ge=1, le=10**6, default=None
    )
    gradient_steps: int | None = quantity(
        "updates a round; -1: as many as steps were flown", "1", ge=-1, le=10**6, default=None
    )


class ReplayOptions(TargetOptions, DdpgOptions):
    """Options of the algorithms with a replay memory of stable-baselines3."""


class Td3Options(ReplayOptions):
    """Options of `td3` (Fujimoto et al., arXiv 1802.09477)."""

    policy_delay: int | None = quantity(
        "updates of the critics for one of the actor", "1", ge=1, le=1000, default=None
    )
    target_policy_noise: float | None = quantity(
        "standard deviation of the noise on the target's actions",
        "1",
        ge=0,
        le=10,
        default=None,
    )
    target_noise_clip: float | None = quantity(
        "greatest such noise", "1", ge=0, le=10, default=None
    )


class QrDqnOptions(ReplayOptions):
    """Options of `qr-dqn` (Dabney et al., arXiv 1710.10044)."""

    target_update_interval: int | None = quantity(
        "steps between two updates of the target network", "1", ge=1, le=10**9, default=None
    )
    exploration_fraction: float | None = quantity(
        "share of the training in which exploration falls", "1", gt=0, le=1, default=None
    )
    exploration_initial_eps: float | None = quantity(
        "first share of random actions", "1", ge=0, le=1, default=None
    )
    exploration_final_eps: float | None = quantity(
        "last share of random actions", "1", ge=0, le=1, default=None
    )
    max_grad_norm: float | None = quantity(_GRADIENT_NORM, "1", gt=0, le=1e6, default=None)
    n_quantiles: int | None = quantity("quantiles of a value", "1", ge=1, le=1000, default=None)


class NoiseOptions(ProfileModel):
    """Options of exploration with noise that depends on the state (Raffin et al., gSDE)."""

    use_sde: bool | None = Field(default=None, description="explore with gSDE; continuous actions")
    sde_sample_freq: int | None = quantity(
        "steps between two draws of gSDE's noise; -1: once a rollout",
        "1",
        ge=-1,
        le=10**6,
        default=None,
    )


class A2cOptions(Options, NoiseOptions):
    """Options of `a2c` (Mnih et al., arXiv 1602.01783)."""

    n_steps: int | None = quantity(
        "steps of each vehicle a rollout; left out: 5", "1", ge=1, le=10**6, default=None
    )
    gae_lambda: float | None = quantity(_LAMBDA, "1", ge=0, le=1, default=None)
    ent_coef: float | None = quantity("weight of the entropy", "1", ge=0, le=10, default=None)
    vf_coef: float | None = quantity("weight of the value's loss", "1", ge=0, le=100, default=None)
    max_grad_norm: float | None = quantity(_GRADIENT_NORM, "1", gt=0, le=1e6, default=None)
    rms_prop_eps: float | None = quantity(
        "added to RMSprop's denominator", "1", gt=0, le=1, default=None
    )
    use_rms_prop: bool | None = Field(default=None, description="RMSprop, or else Adam")
    normalize_advantage: bool | None = Field(default=None, description=_ADVANTAGE)


class TrpoOptions(Options, NoiseOptions):
    """Options of `trpo` (Schulman et al., arXiv 1502.05477)."""

    n_steps: int | None = quantity(
        "steps of each vehicle a rollout; left out: 4096 of all together, in whole batches",
        "1",
        ge=1,
        le=10**6,
        default=None,
    )
    gae_lambda: float | None = quantity(_LAMBDA, "1", ge=0, le=1, default=None)
    cg_max_steps: int | None = quantity(
        "most steps of the conjugate gradient", "1", ge=1, le=1000, default=None
    )
    cg_damping: float | None = quantity(
        "damping of the Hessian's products", "1", ge=0, le=10, default=None
    )
    line_search_shrinking_factor: float | None = quantity(
        "by which a step shrinks in the line search", "1", gt=0, lt=1, default=None
    )
    line_search_max_iter: int | None = quantity(
        "most steps of the line search", "1", ge=1, le=1000, default=None
    )
    n_critic_updates: int | None = quantity(
        "updates of the value a rollout", "1", ge=1, le=1000, default=None
    )
    normalize_advantage: bool | None = Field(default=None, description=_ADVANTAGE)
    target_kl: float | None = quantity(
        "KL divergence that a step may reach", "1", gt=0, le=100, default=None
    )
    sub_sampling_factor: int | None = quantity(
        "so many-th of a rollout are the samples of the step's direction",
        "1",
        ge=1,
        le=1000,
        default=None,
    )


class SacOptions(ReplayOptions, NoiseOptions):
    """Options of `sac` (Haarnoja et al., arXiv 1812.05905)."""

    use_sde_at_warmup: bool | None = Field(
        default=None, description="gSDE in place of uniform actions before learning_starts"
    )

    ent_coef: float | str | None = Field(
        default=None,
        description="weight of the entropy: a number, 'auto' (learned) or 'auto_0.1' (from 0.1 on)",
        pattern=r"^auto(_[0-9.]+)?$",
    )
    target_entropy: float | Literal["auto"] | None = Field(
        default=None, description="entropy that ent_coef 'auto' aims at; 'auto': -2"
    )
    target_update_interval: int | None = quantity(
        "updates between two of the target network", "1", ge=1, le=10**6, default=None
    )
    n_critics: int | None = quantity("critics", "1", ge=1, le=20, default=None)


class TqcOptions(SacOptions):
    """Options of `tqc` (Kuznetsov et al., arXiv 2005.04269)."""

    top_quantiles_to_drop_per_net: int | None = quantity(
        "highest quantiles of each critic that count for nothing", "1", ge=0, le=999, default=None
    )
    n_quantiles: int | None = quantity("quantiles of a critic", "1", ge=1, le=1000, default=None)


class PpoOptions(Options, NoiseOptions):
    """Options of `ppo` (Schulman et al., arXiv 1707.06347)."""

    n_steps: int | None = quantity(
        "steps of each vehicle a rollout; left out: 4096 of all together, in whole batches",
        "1",
        ge=1,
        le=10**6,
        default=None,
    )
    n_epochs: int | None = quantity(
        "passes over a rollout; left out: 4", "1", ge=1, le=1000, default=None
    )
    gae_lambda: float | None = quantity(_LAMBDA, "1", ge=0, le=1, default=None)
    clip_range: float | None = quantity(
        "greatest change of an action's odds in a rollout", "1", gt=0, le=1, default=None
    )
    clip_range_vf: float | None = quantity(
        "greatest change of a value in a rollout; left out: any", "1", gt=0, le=1e6, default=None
    )
    normalize_advantage: bool | None = Field(default=None, description=_ADVANTAGE)
    ent_coef: float | None = quantity(
        "weight of the entropy; left out: 0.005", "1", ge=0, le=10, default=None
    )
    log_std_init: float | None = quantity(
        "logarithm of the first standard deviation of continuous actions, whose range is -1 to 1;"
        " left out: 0",
        "1",
        ge=-5,
        le=2,
        default=None,
    )
    vf_coef: float | None = quantity("weight of the value's loss", "1", ge=0, le=100, default=None)
    max_grad_norm: float | None = quantity(_GRADIENT_NORM, "1", gt=0, le=1e6, default=None)
    target_kl: float | None = quantity(
        "KL divergence that ends the passes over a rollout; left out: none",
        "1",
        gt=0,
        le=100,
        default=None,
    )


class RecurrentPpoOptions(PpoOptions):
    """Options of `recurrent-ppo`: PPO with an LSTM behind the convolutions."""

    lstm_hidden_size: int | None = quantity(
        "units of the LSTM; left out: 128", "1", ge=1, le=2048, default=None
    )
    n_lstm_layers: int | None = quantity("layers of the LSTM", "1", ge=1, le=8, default=None)
    shared_lstm: bool | None = Field(
        default=None, description="the value takes the actor's LSTM; needs enable_critic_lstm false"
    )
    enable_critic_lstm: bool | None = Field(
        default=None, description="the value has an LSTM of its own"
    )


class CloningOptions(Options):
    """Options of `bc`: behaviour cloning."""

    max_grad_norm: float | None = quantity(_GRADIENT_NORM, "1", gt=0, le=1e6, default=None)


class DaggerOptions(CloningOptions):
    """Options of `dagger` (Ross et al., arXiv 1011.0686)."""

    expert_share_initial: float | None = quantity(
        "share of the decisions that the expert flies at first; left out: 1",
        "1",
        ge=0,
        le=1,
        default=None,
    )
    expert_share_final: float | None = quantity(
        "the same in the end; left out: 0", "1", ge=0, le=1, default=None
    )
    expert_share_fraction: float | None = quantity(
        "share of the training in which it falls; left out: 0.3", "1", gt=0, le=1, default=None
    )


@dataclass(frozen=True)
class Algorithm:
    """What sets an algorithm apart."""

    source: str
    """Its class."""
    fields: Mapping[str, str]
    """Fields of `[algorithm]` that it has, and the names of its arguments for them."""
    actions: ActionKind | None = None
    """The only kind of action set that it can choose from; None: both."""
    options: type[ProfileModel] = Options
    """Its hyperparameters."""
    to_policy: tuple[str, ...] = ()
    """Options that the network takes, not the learner."""
    defaults: Mapping[str, Any] = field(default_factory=dict)
    """Options whose default differs from that of stable-baselines3."""
    batch: int = 128
    """Samples an update where `batch_size` is left out."""
    rollouts: bool = False
    """Whether it learns from rollouts of `n_steps` steps that whole batches must fill."""
    policy: str = "MultiInputPolicy"


def _same(*names: str) -> dict[str, str]:
    return {name: name for name in names}


_ANY = _same("learning_rate", "gamma")
_BATCHES = _same("learning_rate", "gamma", "batch_size")
_REPLAY = _same("learning_rate", "gamma", "batch_size", "buffer_size", "learning_starts")
_IMITATION = "airl_mav.training.imitation.Imitation"
_IMITATED = _same("learning_rate", "batch_size", "buffer_size", "learning_starts") | _same(
    "env_steps_per_update", "expert"
)
_PPO: dict[str, Any] = {"n_epochs": 4, "ent_coef": 0.005}

ALGORITHMS: dict[str, Algorithm] = {
    "dqn": Algorithm(
        "airl_mav.training.dqn.DoubleDQN",
        _REPLAY
        | _same("n_step", "double", "env_steps_per_update", "exploration_fraction", "precision")
        | {
            "target_interval": "target_update_interval",
            "exploration_initial": "exploration_initial_eps",
            "exploration_final": "exploration_final_eps",
        },
        "discrete",
        DqnOptions,
    ),
    "qr-dqn": Algorithm(
        "sb3_contrib.QRDQN", _REPLAY, "discrete", QrDqnOptions, to_policy=("n_quantiles",)
    ),
    "ppo": Algorithm(
        "stable_baselines3.PPO",
        _BATCHES,
        options=PpoOptions,
        to_policy=("log_std_init",),
        defaults=_PPO,
        batch=256,
        rollouts=True,
    ),
    "recurrent-ppo": Algorithm(
        "sb3_contrib.RecurrentPPO",
        _BATCHES,
        options=RecurrentPpoOptions,
        to_policy=(
            "log_std_init",
            "lstm_hidden_size",
            "n_lstm_layers",
            "shared_lstm",
            "enable_critic_lstm",
        ),
        defaults=_PPO | {"lstm_hidden_size": 128},
        batch=256,
        rollouts=True,
        policy="MultiInputLstmPolicy",
    ),
    "sac": Algorithm(
        "stable_baselines3.SAC", _REPLAY, "continuous", SacOptions, to_policy=("n_critics",)
    ),
    "tqc": Algorithm(
        "sb3_contrib.TQC",
        _REPLAY,
        "continuous",
        TqcOptions,
        to_policy=("n_critics", "n_quantiles"),
    ),
    "bc": Algorithm(
        _IMITATION,
        _IMITATED,
        options=CloningOptions,
        defaults={"expert_share_final": 1.0},
        batch=256,
    ),
    "dagger": Algorithm(_IMITATION, _IMITATED, options=DaggerOptions, batch=256),
    "a2c": Algorithm("stable_baselines3.A2C", _ANY, options=A2cOptions),
    "ddpg": Algorithm("stable_baselines3.DDPG", _REPLAY, "continuous", DdpgOptions),
    "td3": Algorithm("stable_baselines3.TD3", _REPLAY, "continuous", Td3Options),
    "trpo": Algorithm("sb3_contrib.TRPO", _BATCHES, options=TrpoOptions, batch=256, rollouts=True),
}
"""Algorithms that take Dict observations and need no action mask."""


def fitting(kind: ActionKind) -> list[str]:
    """Return the names of the algorithms that can choose from a kind of action set."""
    return [name for name, row in ALGORITHMS.items() if row.actions in (None, kind)]
