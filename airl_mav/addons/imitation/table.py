"""Rows of the algorithm table: behaviour cloning and DAgger."""

from __future__ import annotations

from airl_mav.training.algorithm_table import Algorithm, number, options_of, same

_SOURCE = "airl_mav.addons.imitation.imitation.Imitation"
_FIELDS = same(
    *("learning_rate", "batch_size", "buffer_size", "learning_starts"),
    *("env_steps_per_update", "expert", "precision"),
)
_COMMON = "stats_window_size max_grad_norm"

BEHAVIOUR_CLONING = Algorithm(
    _SOURCE, _FIELDS, options_of(_COMMON), defaults={"expert_share_final": 1.0}, batch=256
)

# Ross et al., arXiv 1011.0686
DAGGER = Algorithm(
    _SOURCE,
    _FIELDS,
    options_of(
        f"{_COMMON} expert_share_initial expert_share_final expert_share_fraction",
        expert_share_initial=number(
            float,
            "share of the decisions that the expert flies at first; left out: 1",
            ge=0,
            le=1,
        ),
        expert_share_final=number(float, "the same in the end; left out: 0", ge=0, le=1),
        expert_share_fraction=number(
            float, "share of the training in which it falls; left out: 0.3", gt=0, le=1
        ),
    ),
    batch=256,
)
