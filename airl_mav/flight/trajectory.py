"""True path of one episode, sampled at 50 Hz from the plant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

SAMPLE_US = 20_000
"""Sampling period [µs]: 50 Hz."""


@dataclass(frozen=True)
class Trajectory:
    """n samples of the vehicle's true state; world NED, body FRD."""

    time_us: NDArray[np.int64]  # (n,) simulated time, increasing
    position: NDArray[np.float64]  # (n, 3) NED [m]
    velocity: NDArray[np.float64]  # (n, 3) NED [m/s]
    quaternion: NDArray[np.float64]  # (n, 4) [w, x, y, z] body -> world
    power_w: NDArray[np.float64]  # (n,) electrical power of the vehicle, without its computer
    """Mean since the previous sample, so that power times time equals the energy integrated at the
    full tick rate; NaN without a measurement."""

    def __post_init__(self) -> None:
        """Check shapes and order. Raises ValueError."""
        n = len(self.time_us)
        shapes = {"position": (n, 3), "velocity": (n, 3), "quaternion": (n, 4), "power_w": (n,)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name}: shape {getattr(self, name).shape}, expected {shape}")
        if np.any(np.diff(self.time_us) <= 0):
            raise ValueError("time_us: must increase")

    def __len__(self) -> int:
        """Return n."""
        return len(self.time_us)

    def speed(self) -> NDArray[np.float64]:
        """Return the speed (n,) [m/s], three-dimensional."""
        speed: NDArray[np.float64] = np.linalg.norm(self.velocity, axis=1)
        return speed

    def between(self, start_us: int, end_us: int) -> Trajectory:
        """Return the part from `start_us` to `end_us` [µs], its ends interpolated.

        The part is limited to the recording: it ends at the recording's end, and is empty without
        an overlap.
        """
        if not len(self):
            return self
        start = max(start_us, int(self.time_us[0]))
        end = min(end_us, int(self.time_us[-1]))
        if end < start:
            return self._rows(np.zeros(0, np.int64))
        inside = self.time_us[(self.time_us > start) & (self.time_us < end)]
        return self._rows(np.unique(np.concatenate([[start], inside, [end]]).astype(np.int64)))

    def _rows(self, times: NDArray[np.int64]) -> Trajectory:
        """Return the state at the given times [µs], all inside the recording."""
        before = np.searchsorted(self.time_us, times, side="left")

        def linear(values: NDArray[np.float64]) -> NDArray[np.float64]:
            at = [np.interp(times, self.time_us, column) for column in values.T]
            return np.stack(at, axis=1)

        quaternion = linear(self._continuous_quaternion())
        quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        # Power is a mean over the step that ends at a sample; a time inside a step uses its power.
        return Trajectory(
            times, linear(self.position), linear(self.velocity), quaternion, self.power_w[before]
        )

    def _continuous_quaternion(self) -> NDArray[np.float64]:
        """Return the quaternions with signs flipped so that neighbours lie close."""
        dots = np.sum(self.quaternion[1:] * self.quaternion[:-1], axis=1)
        signs = np.cumprod(np.where(dots < 0.0, -1.0, 1.0))
        near: NDArray[np.float64] = self.quaternion * np.concatenate([[1.0], signs])[:, None]
        return near

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays by field name, for a file."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Trajectory:
        """Build from arrays by field name. Raises KeyError or ValueError if invalid."""
        return cls(**{field.name: arrays[field.name] for field in fields(cls)})


def pose_at(
    path: Trajectory, time_us: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return position (3,), velocity (3,), quaternion (4,) at a time, limited to the recording."""
    time = min(max(time_us, int(path.time_us[0])), int(path.time_us[-1]))
    at = path.between(time, time)
    return at.position[0], at.velocity[0], at.quaternion[0]
