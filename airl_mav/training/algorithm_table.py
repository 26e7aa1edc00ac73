"""Table of the learning algorithms and their hyperparameters.

`[algorithm]` of a training file has the common fields, `[algorithm.options]` the specific ones, by
the names of stable-baselines3 and sb3-contrib, with their defaults or `Algorithm.defaults`.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import Field, create_model

from airl_mav.core.fields import ProfileModel, quantity

ActionKind = Literal["discrete", "continuous"]

Declared = tuple[Any, Any]


def number(kind: Any, meaning: str, **bounds: Any) -> Declared:
    """Return an optional number with its meaning and bounds."""
    return kind | None, quantity(meaning, "1", default=None, **bounds)


def _choice(kind: Any, meaning: str, **more: Any) -> Declared:
    return kind | None, Field(default=None, description=meaning, **more)


_AUTO_ENTROPY = _choice(
    float | str,
    "weight of the entropy: a number, 'auto' (learned) or 'auto_0.1' (from 0.1 on)",
    pattern=r"^auto(_[0-9.]+)?$",
)
_ROLLOUT = "steps of each vehicle a rollout; left out: "

_OPTIONS: dict[str, Declared] = {
    "cg_damping": number(float, "damping of the Hessian's products", ge=0, le=10),
    "cg_max_steps": number(int, "most steps of the conjugate gradient", ge=1, le=1000),
    "clip_range": number(float, "greatest change of an action's odds in a rollout", gt=0, le=1),
    "clip_range_vf": number(
        float, "greatest change of a value in a rollout; left out: any", gt=0, le=1e6
    ),
    "enable_critic_lstm": _choice(bool, "the value has an LSTM of its own"),
    "ent_coef": number(float, "weight of the entropy; left out: 0.005", ge=0, le=10),
    "exploration_final_eps": number(float, "last share of random actions", ge=0, le=1),
    "exploration_fraction": number(
        float, "share of the training in which exploration falls", gt=0, le=1
    ),
    "exploration_initial_eps": number(float, "first share of random actions", ge=0, le=1),
    "gae_lambda": number(float, "lambda of the generalised advantage estimate", ge=0, le=1),
    "gradient_steps": number(
        int, "updates a round; -1: as many as steps were flown", ge=-1, le=10**6
    ),
    "line_search_max_iter": number(int, "most steps of the line search", ge=1, le=1000),
    "line_search_shrinking_factor": number(
        float, "by which a step shrinks in the line search", gt=0, lt=1
    ),
    "log_std_init": number(
        float,
        "logarithm of the first standard deviation of continuous actions, whose range is -1 to 1;"
        " left out: 0",
        ge=-5,
        le=2,
    ),
    "lstm_hidden_size": number(int, "units of the LSTM; left out: 128", ge=1, le=2048),
    "max_grad_norm": number(
        float, "greatest norm of a gradient; greater ones are scaled down", gt=0, le=1e6
    ),
    "n_critic_updates": number(int, "updates of the value a rollout", ge=1, le=1000),
    "n_critics": number(int, "critics", ge=1, le=20),
    "n_epochs": number(int, "passes over a rollout; left out: 4", ge=1, le=1000),
    "n_lstm_layers": number(int, "layers of the LSTM", ge=1, le=8),
    "n_quantiles": number(int, "quantiles of a value", ge=1, le=1000),
    "n_steps": number(int, f"{_ROLLOUT}4096 of all together, in whole batches", ge=1, le=10**6),
    "normalize_advantage": _choice(bool, "scale the advantages of a batch to mean 0, deviation 1"),
    "policy_delay": number(int, "updates of the critics for one of the actor", ge=1, le=1000),
    "rms_prop_eps": number(float, "added to RMSprop's denominator", gt=0, le=1),
    "sde_sample_freq": number(
        int, "steps between two draws of gSDE's noise; -1: once a rollout", ge=-1, le=10**6
    ),
    "shared_lstm": _choice(
        bool, "the value takes the actor's LSTM; needs enable_critic_lstm false"
    ),
    "stats_window_size": number(int, "episodes that the logged means are of", ge=1, le=10**6),
    "sub_sampling_factor": number(
        int, "so many-th of a rollout are the samples of the step's direction", ge=1, le=1000
    ),
    "target_entropy": _choice(
        float | Literal["auto"], "entropy that ent_coef 'auto' aims at; 'auto': -2"
    ),
    "target_kl": number(
        float, "KL divergence that ends the passes over a rollout; left out: none", gt=0, le=100
    ),
    "target_noise_clip": number(float, "greatest such noise", ge=0, le=10),
    "target_policy_noise": number(
        float, "standard deviation of the noise on the target's actions", ge=0, le=10
    ),
    "target_update_interval": number(
        int, "updates between two of the target network", ge=1, le=10**6
    ),
    "tau": number(
        float, "share of the online network in an update of the target network", gt=0, le=1
    ),
    "top_quantiles_to_drop_per_net": number(
        int, "highest quantiles of each critic that count for nothing", ge=0, le=999
    ),
    "train_freq": number(
        int, "steps of each vehicle between two rounds of updates", ge=1, le=10**6
    ),
    "use_rms_prop": _choice(bool, "RMSprop, or else Adam"),
    "use_sde": _choice(bool, "explore with gSDE; continuous actions"),
    "use_sde_at_warmup": _choice(bool, "gSDE in place of uniform actions before learning_starts"),
    "vf_coef": number(float, "weight of the value's loss", ge=0, le=100),
}
"""Options under the names of stable-baselines3 and sb3-contrib; `options_of` may replace some."""


def options_of(names: str, **others: Declared) -> type[ProfileModel]:
    """Return the model of an algorithm's options, by names; `others` declares special ones."""
    declared = {name: (_OPTIONS | others)[name] for name in names.split()}
    fields: dict[str, Any] = {name: (kind, copy(field)) for name, (kind, field) in declared.items()}
    return create_model("Options", __base__=ProfileModel, **fields)


_SDE = "use_sde sde_sample_freq "
_UPDATES = "tau train_freq gradient_steps "
_WINDOW = "stats_window_size "
_PPO_OPTIONS = (
    f"{_SDE}{_WINDOW}n_steps n_epochs gae_lambda clip_range clip_range_vf normalize_advantage"
    " ent_coef log_std_init vf_coef max_grad_norm target_kl"
)
_SAC_OPTIONS = (
    f"{_SDE}{_UPDATES}{_WINDOW}use_sde_at_warmup ent_coef target_entropy target_update_interval"
    " n_critics"
)


@dataclass(frozen=True)
class Algorithm:
    """Properties of an algorithm."""

    source: str
    fields: Mapping[str, str]
    """Supported fields of `[algorithm]`, and the names of the constructor's arguments."""
    options: type[ProfileModel]
    actions: ActionKind | None = None
    """Supported kind of action set; None = both."""
    to_policy: tuple[str, ...] = ()
    """Options passed to the network instead of the learner."""
    defaults: Mapping[str, Any] = field(default_factory=dict)
    """Options with a default that differs from stable-baselines3."""
    batch: int = 128
    """Default of `batch_size`: samples per update."""
    rollouts: bool = False
    """True if the algorithm learns from rollouts of `n_steps` steps, in whole batches."""
    policy: str = "MultiInputPolicy"


def same(*names: str) -> dict[str, str]:
    """Return fields whose arguments have the same names."""
    return {name: name for name in names}


_ANY = same("learning_rate", "gamma")
_BATCHES = same("learning_rate", "gamma", "batch_size")
_REPLAY = same("learning_rate", "gamma", "batch_size", "buffer_size", "learning_starts")
_PPO: dict[str, Any] = {"n_epochs": 4, "ent_coef": 0.005}

CORE_ALGORITHMS: dict[str, Algorithm] = {
    # Mnih et al., Nature 518 (2015)
    "dqn": Algorithm(
        "airl_mav.training.dqn.DoubleDQN",
        _REPLAY
        | same("n_step", "double", "env_steps_per_update", "exploration_fraction", "precision")
        | {
            "target_interval": "target_update_interval",
            "exploration_initial": "exploration_initial_eps",
            "exploration_final": "exploration_final_eps",
        },
        options_of(f"tau {_WINDOW}max_grad_norm"),
        "discrete",
    ),
    # Dabney et al., arXiv 1710.10044
    "qr-dqn": Algorithm(
        "sb3_contrib.QRDQN",
        _REPLAY,
        options_of(
            f"{_UPDATES}{_WINDOW}target_update_interval exploration_fraction"
            " exploration_initial_eps exploration_final_eps max_grad_norm n_quantiles",
            target_update_interval=number(
                int, "steps between two updates of the target network", ge=1, le=10**9
            ),
        ),
        "discrete",
        to_policy=("n_quantiles",),
    ),
    # Schulman et al., arXiv 1707.06347
    "ppo": Algorithm(
        "stable_baselines3.PPO",
        _BATCHES,
        options_of(_PPO_OPTIONS),
        to_policy=("log_std_init",),
        defaults=_PPO,
        batch=256,
        rollouts=True,
    ),
    # PPO with an LSTM behind the convolutions
    "recurrent-ppo": Algorithm(
        "sb3_contrib.RecurrentPPO",
        _BATCHES,
        options_of(f"{_PPO_OPTIONS} lstm_hidden_size n_lstm_layers shared_lstm enable_critic_lstm"),
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
    # Haarnoja et al., arXiv 1812.05905
    "sac": Algorithm(
        "stable_baselines3.SAC",
        _REPLAY,
        options_of(_SAC_OPTIONS, ent_coef=_AUTO_ENTROPY),
        "continuous",
        to_policy=("n_critics",),
    ),
    # Kuznetsov et al., arXiv 2005.04269
    "tqc": Algorithm(
        "sb3_contrib.TQC",
        _REPLAY,
        options_of(
            f"{_SAC_OPTIONS} top_quantiles_to_drop_per_net n_quantiles",
            ent_coef=_AUTO_ENTROPY,
            n_quantiles=number(int, "quantiles of a critic", ge=1, le=1000),
        ),
        "continuous",
        to_policy=("n_critics", "n_quantiles"),
    ),
    # Mnih et al., arXiv 1602.01783
    "a2c": Algorithm(
        "stable_baselines3.A2C",
        _ANY,
        options_of(
            f"{_SDE}{_WINDOW}n_steps gae_lambda ent_coef vf_coef max_grad_norm rms_prop_eps"
            " use_rms_prop normalize_advantage",
            n_steps=number(int, f"{_ROLLOUT}5", ge=1, le=10**6),
            ent_coef=number(float, "weight of the entropy", ge=0, le=10),
        ),
    ),
    # Lillicrap et al., arXiv 1509.02971
    "ddpg": Algorithm("stable_baselines3.DDPG", _REPLAY, options_of(_UPDATES), "continuous"),
    # Fujimoto et al., arXiv 1802.09477
    "td3": Algorithm(
        "stable_baselines3.TD3",
        _REPLAY,
        options_of(f"{_UPDATES}{_WINDOW}policy_delay target_policy_noise target_noise_clip"),
        "continuous",
    ),
    # Schulman et al., arXiv 1502.05477
    "trpo": Algorithm(
        "sb3_contrib.TRPO",
        _BATCHES,
        options_of(
            f"{_SDE}{_WINDOW}n_steps gae_lambda cg_max_steps cg_damping"
            " line_search_shrinking_factor line_search_max_iter n_critic_updates"
            " normalize_advantage target_kl sub_sampling_factor",
            target_kl=number(float, "KL divergence that a step may reach", gt=0, le=100),
        ),
        batch=256,
        rollouts=True,
    ),
}
"""Algorithms of the core; they take Dict observations and need no action mask."""
