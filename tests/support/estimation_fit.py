"""Fits the batch twin's model of estimation errors to recorded ones: a profile's `estimation`."""

from __future__ import annotations

from typing import Final

import numpy as np

from airl_mav.core.frames import quat_multiply
from airl_mav.envs.draws import GROUPS, Array
from airl_mav.profiles.vehicle import Estimation

_LAGS = 40  # of the autocorrelation, evenly spaced on a logarithmic scale
_TIMES_S: Final = np.geomspace(0.02, 10_000.0, 4000)  # correlation times tried


def errors_between(
    truth: tuple[Array, Array, Array], estimate: tuple[Array, Array, Array]
) -> Array:
    """Return the errors (..., 9) that turn `truth` into `estimate`; undoes `perturbed`.

    Args:
        truth: Position (..., 3), velocity (..., 3), quaternion (..., 4).
        estimate: The same, as estimated.
    """
    back = truth[2] * np.array([1.0, -1.0, -1.0, -1.0])
    turn = np.moveaxis(
        quat_multiply(np.moveaxis(estimate[2], -1, 0), np.moveaxis(back, -1, 0)), 0, -1
    )
    turn = turn * np.where(turn[..., :1] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(turn[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, turn[..., :1])
    vector = turn[..., 1:] * np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 2.0)
    return np.concatenate([estimate[0] - truth[0], estimate[1] - truth[1], vector], axis=-1)


def autocorrelation(errors: Array, lag: int) -> Array:
    """Return the correlation (9,) of errors (flights, samples, 9) with errors `lag` samples later.

    The mean is taken as zero: a constant offset over a flight is an error too.
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
