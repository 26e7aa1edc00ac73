"""What stable-baselines3's VecNormalize did around a training environment, as part of a network."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from airl_mav.core.errors import FieldError
from airl_mav.policy.runtime import first_line

FIELD = "vec_normalize"


class Normalised(nn.Module):
    """Normalises observations as a VecNormalize does, in front of what takes a Dict of them."""

    def __init__(self, inner: nn.Module, learned: VecNormalize) -> None:
        """Take the statistics as they are."""
        super().__init__()
        self.inner = inner
        self.keys = normalised_keys(learned)
        self.most = float(learned.clip_obs)
        for key in self.keys:
            found = learned.obs_rms[key]
            for name, values in (("mean", found.mean), ("var", found.var + learned.epsilon)):
                self.register_buffer(f"{name}_{key}", torch.from_numpy(np.asarray(values)).float())

    def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return what the inner network makes of the normalised observations."""
        seen = dict(seen)
        for key in self.keys:
            away = seen[key].float() - self.get_buffer(f"mean_{key}")
            scaled = away / self.get_buffer(f"var_{key}").sqrt()
            seen[key] = scaled.clamp(-self.most, self.most)
        found: torch.Tensor = self.inner(seen)
        return found


def normalised_keys(learned: VecNormalize | None) -> tuple[str, ...]:
    """Return the keys of the observations that are normalised; where rewards alone are, none."""
    if learned is None or not learned.norm_obs:
        return ()
    return tuple(learned.norm_obs_keys or ())


def load_normalisation(path: Path) -> VecNormalize:
    """Load what the `save` of a VecNormalize wrote.

    The file holds pickled Python objects: load only those of people you trust.

    Raises:
        FieldError: No such file, or it is none, or not one of Dict observations.
    """
    if not path.is_file():
        raise FieldError(FIELD, path, problem="no such file")
    try:
        with path.open("rb") as file:
            found = pickle.load(file)  # noqa: S301 (the user was told)
    except Exception as error:  # Unpickling raises whatever the pickled objects do.
        raise FieldError(FIELD, path, problem=f"no VecNormalize: {first_line(error)}") from None
    if not isinstance(found, VecNormalize) or (
        found.norm_obs and not isinstance(found.obs_rms, dict)
    ):
        raise FieldError(FIELD, path, "what a VecNormalize of Dict observations has saved")
    return found
