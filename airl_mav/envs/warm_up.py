"""Load or compile every kernel of the vectorized simulator, as plans of `core.first_start` do."""

from __future__ import annotations

import numpy as np

from airl_mav.envs.fleet import Verdict
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.envs.trace import Trace
from airl_mav.profiles.camera_kind import CameraKind


def compile_vectorized(kind: CameraKind, *, recorded: bool) -> None:
    """Compile the whole: a flight of some decisions."""
    flying = _navigation(kind, recorded=recorded)
    flying.begin([0], [1])
    for _ in range(3):
        flying.observe()
        flying.fly(np.zeros((1, 3)))


def compile_dynamics(*, recorded: bool) -> None:
    """Compile flight dynamics and contacts, of flights that are recorded or are not."""
    flying = _navigation("depth", recorded=recorded)
    flying.fleet.verdict[:] = Verdict.SUCCESS  # Nobody flies: there is no arena yet.
    if recorded or not flying.advance_in_legs(np.ones((1, 3), np.int64), np.zeros((1, 4))):
        flying.advance(np.ones(1, np.int64))


def compile_images(kind: CameraKind) -> None:
    """Compile arenas and images."""
    _navigation(kind, recorded=False).begin([0], [1])


def _navigation(kind: CameraKind, *, recorded: bool) -> Navigation:
    spec = EnvironmentSpec.model_validate({"camera": {"kind": kind}})
    return Navigation(spec, 1, trace=Trace(1) if recorded else None)
