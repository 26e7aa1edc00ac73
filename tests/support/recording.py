"""Recordings of made-up flights."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from airl_mav.flight.trajectory import TrajectoryRecorder


def record_tick(
    recorder: TrajectoryRecorder,
    time_us: int,
    position: ArrayLike,
    velocity: ArrayLike,
    quaternion: ArrayLike,
    power_w: float,
    *,
    keep: bool = False,
) -> None:
    """Hand the state after a tick to a recorder; `keep` it even between samples."""
    state = np.concatenate([position, velocity, quaternion]).astype(np.float64)
    if not recorder.extend([time_us], [power_w], state[None]) and keep:
        recorder.keep(state)
