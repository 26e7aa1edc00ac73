"""Recordings of made-up flights."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from firmware_sim.recording import TrajectoryRecorder


class TestRecorder(TrajectoryRecorder):
    """Recorder that can sample between its own samples."""

    __test__ = False

    def keep(self, state: NDArray[np.float64]) -> None:
        """Sample the newest tick, with its state (10,), as at the end of an episode."""
        last_us, kept_us, energy, power_w = self._memory.tolist()
        mean_w = power_w if kept_us < 0.0 else energy / (last_us - kept_us)
        self._times.append(np.array([int(last_us)]))
        self._powers.append(np.array([mean_w]))
        self._states.append(state[None])
        self._memory[1:3] = last_us, 0.0


def record_tick(
    recorder: TestRecorder,
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
