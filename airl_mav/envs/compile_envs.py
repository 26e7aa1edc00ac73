"""Load or compile every kernel of the vectorized simulator, as plans of `core.first_start` do."""

from __future__ import annotations

import numpy as np

from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.profiles.projections import CameraKind


def compile_vectorized(kind: CameraKind) -> None:
    """Compile all kernels by a flight of a few decisions."""
    flying = _navigation(kind)
    flying.begin([0], [1])
    # A few decisions reach every kernel of a flight.
    for _ in range(3):
        flying.observe()
        flying.fly(np.zeros((1, 3)))


def compile_dynamics() -> None:
    """Compile flight dynamics and contacts."""
    _navigation("depth").compile_dynamics()


def compile_images(kind: CameraKind) -> None:
    """Compile arenas and images."""
    _navigation(kind).begin([0], [1])


def _navigation(kind: CameraKind) -> Navigation:
    return Navigation(EnvironmentSpec.model_validate({"camera": {"kind": kind}}), 1)
