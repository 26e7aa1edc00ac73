"""Smoothness of command and flight: jerk, and the steps of the command.

Jerk is the second derivative of velocity. For a sampled velocity it depends on the bandwidth. The
jerk of a commanded velocity consists of its steps, filtered to that bandwidth. A step of 1 m/s
gives a peak of exp(-1/2) / (sqrt(2 pi) SIGMA_S^2) = 345 m/s³. Both velocities are therefore
processed alike: sampled at 50 Hz, and differentiated twice with a Gaussian that passes half the
power at `BANDWIDTH_HZ`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import heading_to_ned, quats_to_euler
from airl_mav.flight.trajectory import SAMPLE_US, Trajectory
from airl_mav.latency.stamps import NO_STAMP, SETPOINT

SAMPLE_S = SAMPLE_US / US_PER_S

BANDWIDTH_HZ = 5.0
"""Half-power bandwidth [Hz]. Well above a multicopter's velocity loop (about 1 Hz), well below the
25 Hz Nyquist frequency of 50 Hz samples."""

SIGMA_S = math.sqrt(math.log(2.0)) / (2.0 * math.pi * BANDWIDTH_HZ)
"""Standard deviation of the Gaussian [s]: its gain is exp(-2 (pi SIGMA_S f)^2)."""

REACH = math.ceil(5.0 * SIGMA_S / SAMPLE_S)
"""Samples to each side that a jerk value uses; the first and last ones have no jerk."""


def _second_derivative() -> NDArray[np.float64]:
    """Return the sampled second derivative of the Gaussian, as a convolution kernel."""
    t = np.arange(-REACH, REACH + 1) * SAMPLE_S
    gauss = np.exp(-0.5 * (t / SIGMA_S) ** 2)
    kernel = (t**2 / SIGMA_S**4 - 1.0 / SIGMA_S**2) * gauss / gauss.sum()
    kernel -= kernel.mean()  # A constant velocity has zero jerk.
    return np.asarray(kernel, np.float64)


_KERNEL = _second_derivative()


@dataclass(frozen=True)
class Jerk:
    """Magnitude of the jerk over a part of a flight, at `BANDWIDTH_HZ`."""

    rms_m_s3: float
    peak_m_s3: float


def jerk_of(velocity: NDArray[np.float64]) -> Jerk | None:
    """Return the jerk of velocities (n, 3) [m/s], sampled at 50 Hz; None with too few samples."""
    if len(velocity) < len(_KERNEL):
        return None
    columns = [np.convolve(column, _KERNEL, "valid") for column in velocity.T]
    squares = np.sum(np.square(columns), axis=0)
    return Jerk(math.sqrt(squares.mean()), math.sqrt(squares.max()))


def sample_times(trajectory: Trajectory, start_us: int, end_us: int) -> NDArray[np.int64]:
    """Return the times (n,) [µs] of an even 50 Hz grid between two times.

    The grid begins at a recorded sample. Evenly sampled recordings, all except real firmware's, are
    therefore not interpolated.
    """
    inside = trajectory.time_us[(trajectory.time_us >= start_us) & (trajectory.time_us <= end_us)]
    if not inside.size:
        return np.zeros(0, np.int64)
    return np.arange(inside[0], inside[-1] + 1, SAMPLE_US, dtype=np.int64)


def flown_velocity(trajectory: Trajectory, times_us: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the true velocity (n, 3) NED [m/s] at times (n,) [µs]."""
    columns = [np.interp(times_us, trajectory.time_us, column) for column in trajectory.velocity.T]
    return np.stack(columns, axis=1)


def commanded_velocity(
    trajectory: Trajectory, decisions: Mapping[str, NDArray[Any]], times_us: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the commanded velocity (n, 3) NED [m/s] at increasing times (n,) [µs].

    A command holds from its sending to the next one's. Before the first one, the command is zero.
    Commands are in the heading frame: they turn with the vehicle's true heading. Watchdog stops
    between commands (`hover_after_s`) are not included. `decisions` has the columns `sent_us` and
    `setpoint` of `latency.npz`.
    """
    sent_us, setpoints = _sent(decisions)
    commands = np.vstack([np.zeros(3), setpoints])
    flown = commands[np.searchsorted(sent_us, times_us, side="right")]
    headings = np.unwrap(quats_to_euler(trajectory.quaternion)[2])
    return heading_to_ned(flown, np.interp(times_us, trajectory.time_us, headings))


def command_steps(decisions: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Return the change of the commanded velocity at each switch of action (k - 1,) [m/s].

    The length of the difference between successive commands of k sent. Both use the heading frame
    at the switch, so the length is equal in the world frame.
    """
    _, setpoints = _sent(decisions)
    steps: NDArray[np.float64] = np.linalg.norm(np.diff(setpoints, axis=0), axis=1)
    return steps


def _sent(
    decisions: Mapping[str, NDArray[Any]],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return times (k,) [µs] and velocities (k, 3) [m/s] of the sent commands."""
    if "sent_us" not in decisions or SETPOINT not in decisions:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    sent = decisions["sent_us"] != NO_STAMP
    return decisions["sent_us"][sent], decisions[SETPOINT][sent, :3].astype(np.float64)
