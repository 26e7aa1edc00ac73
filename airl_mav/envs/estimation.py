"""What the flight controller believes: the EKF's error as noise on the batch twin's true state.

Nine errors a vehicle: position NED [m], velocity NED [m/s], attitude as a turn about north, east
and down [rad]. Each is a stationary first-order Gauss-Markov process of its own. In truth they are
not quite that: where the magnetic field dips steeply, a tilt about north turns the heading with it;
and attitude is worst in the first seconds, until an acceleration has shown the sensors' biases.

Pure functions: the caller brings the random numbers, so that every episode draws from its own
Generator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.profiles.vehicle import Estimation

N_ERRORS: Final = 9
POSITION: Final = slice(0, 3)
VELOCITY: Final = slice(3, 6)
ATTITUDE: Final = slice(6, 9)

GROUPS: Final[dict[str, tuple[str, tuple[int, ...]]]] = {
    "position_horizontal_m": ("position_horizontal_time_s", (0, 1)),
    "position_vertical_m": ("position_vertical_time_s", (2,)),
    "velocity_horizontal_m_s": ("velocity_horizontal_time_s", (3, 4)),
    "velocity_vertical_m_s": ("velocity_vertical_time_s", (5,)),
    "tilt_rad": ("tilt_time_s", (6, 7)),
    "heading_rad": ("heading_time_s", (8,)),
}
"""`Estimation` field of the standard deviation -> field of the time, and the errors they are of."""

Array = NDArray[np.float64]

_LAGS = 40  # of the autocorrelation, evenly spaced on a logarithmic scale
_TIMES_S: Final = np.geomspace(0.02, 10_000.0, 4000)  # correlation times tried


@dataclass(frozen=True)
class EstimationError:
    """Standard deviation and correlation time of each of the nine errors."""

    sd: Array  # (9,) [m], [m/s], [rad]
    time_s: Array  # (9,)

    @classmethod
    def from_profile(cls, table: Estimation) -> EstimationError:
        """Return the model of a vehicle profile's `estimation` table."""
        sd, time_s = np.empty(N_ERRORS), np.empty(N_ERRORS)
        for name, (time_name, errors) in GROUPS.items():
            sd[list(errors)] = getattr(table, name)
            time_s[list(errors)] = getattr(table, time_name)
        return cls(sd, time_s)


def first_errors(model: EstimationError, normals: Array) -> Array:
    """Return the errors (..., 9) at an episode's start from standard normal numbers (..., 9)."""
    return model.sd * normals


def step_errors(model: EstimationError, errors: Array, normals: Array, dt: float | Array) -> Array:
    """Return the errors after dt: exact for any dt, so that steps may be of any length.

    Args:
        model: Standard deviations and correlation times.
        errors: (..., 9) before.
        normals: (..., 9) standard normal numbers.
        dt: Seconds, for all or (...) for each vehicle; 0 changes nothing.
    """
    kept = np.exp(-np.asarray(dt)[..., None] / model.time_s)
    return kept * errors + model.sd * np.sqrt(1.0 - kept * kept) * normals


def perturbed(
    position: Array, velocity: Array, quaternion: Array, errors: Array
) -> tuple[Array, Array, Array]:
    """Return position, velocity and attitude as the flight controller reports them.

    Args:
        position: (..., 3) true, NED [m].
        velocity: (..., 3) true, NED [m/s].
        quaternion: (..., 4) true, body -> NED.
        errors: (..., 9).
    """
    turn = errors[..., ATTITUDE]
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    axis = 0.5 * np.sinc(angle / (2.0 * np.pi)) * turn
    estimated = _multiply(np.concatenate([np.cos(0.5 * angle), axis], axis=-1), quaternion)
    return position + errors[..., POSITION], velocity + errors[..., VELOCITY], estimated


def errors_between(
    truth: tuple[Array, Array, Array], estimate: tuple[Array, Array, Array]
) -> Array:
    """Return the errors (..., 9) that turn `truth` into `estimate`; undoes `perturbed`.

    Args:
        truth: Position (..., 3), velocity (..., 3), quaternion (..., 4).
        estimate: The same, as estimated.
    """
    turn = _multiply(estimate[2], truth[2] * np.array([1.0, -1.0, -1.0, -1.0]))
    turn = turn * np.where(turn[..., :1] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(turn[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, turn[..., :1])
    vector = turn[..., 1:] * np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 2.0)
    return np.concatenate([estimate[0] - truth[0], estimate[1] - truth[1], vector], axis=-1)


def autocorrelation(errors: Array, lag: int) -> Array:
    """Return the correlation (9,) of errors (flights, samples, 9) with those `lag` samples on.

    Their mean is taken as zero: what is constant over a flight is error too.
    """
    later = np.mean(errors[:, lag:] * errors[:, : errors.shape[1] - lag], axis=(0, 1))
    power = np.mean(errors**2, axis=(0, 1))
    result: Array = later / power
    return result


def fit(errors: Array, dt: float) -> Estimation:
    """Return the model that describes recorded errors.

    The standard deviation is their rms. The correlation time is the one whose exponential is
    closest, in least squares, to their autocorrelation at lags up to half a flight.

    Args:
        errors: (flights, samples, 9).
        dt: Between samples [s].
    """
    lags = np.unique(np.geomspace(1, errors.shape[1] // 2, _LAGS).astype(int))
    found = np.array([autocorrelation(errors, int(lag)) for lag in lags])  # (lags, 9)
    models = np.exp(-np.outer(lags * dt, 1.0 / _TIMES_S))  # (lags, times)
    table: dict[str, float] = {}
    for name, (time_name, group) in GROUPS.items():
        columns = list(group)
        table[name] = float(np.sqrt(np.mean(errors[..., columns] ** 2)))
        measured = found[:, columns].mean(axis=1)
        misfit = np.sum((models - measured[:, None]) ** 2, axis=0)
        table[time_name] = float(_TIMES_S[np.argmin(misfit)])
    return Estimation(**table)


def _multiply(a: Array, b: Array) -> Array:
    """Return the Hamilton product a ⊗ b of quaternions (..., 4)."""
    w, v = a[..., :1], a[..., 1:]
    s, u = b[..., :1], b[..., 1:]
    scalar = w * s - np.sum(v * u, axis=-1, keepdims=True)
    return np.concatenate([scalar, w * u + s * v + np.cross(v, u)], axis=-1)
