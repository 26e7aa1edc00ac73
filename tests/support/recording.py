"""Recordings of made-up flights."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from firmware_sim.recording import TrajectoryRecorder


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
    if not len(recorder.extend(np.array([time_us]), np.array([power_w]), state[None])) and keep:
        recorder.keep(state)
