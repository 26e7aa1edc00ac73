"""Recorded flight with path, power and motor outputs from the vehicle's log.

The log's clock is aligned as in NTP, assuming equal delays both ways (D. Mills, RFC 5905).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.recordings.recorded_flight import episode_of, path_of, stamps_of
from airl_mav.black_box.mcap_file import BlackBox
from airl_mav.core.constants import US_PER_MS
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.stamps import SETPOINTS, commanded
from airl_mav.rehearsal.run_folder import MOTOR_OUTPUTS, MOTOR_TIMES, FlownEpisode
from airl_mav.vehicle_log import ClockAlignment, VehicleLog, align


def logged_episode_of(box: BlackBox, log: VehicleLog) -> FlownEpisode:
    """Return the flight with path, power and motor outputs from the log, or raise UsageError."""
    told = path_of(box)
    stamps = stamps_of(box)
    kind = commanded(stamps)
    setpoints = np.asarray(stamps[SETPOINTS[kind]], np.float64)
    clocks = align(told, log, stamps["sent_us"], setpoints, kind)
    ahead_us = offset_us(clocks)
    path = _path(told, log, clocks.told_us, ahead_us)
    note = (
        f"path, power and motor outputs are those of {log.path.name}; its clock is"
        f" {-ahead_us / US_PER_MS:+.1f} ms ahead of the recording's, by attitude and velocity in"
        f" both (which agree to {clocks.error_m_s:.3f} m/s) and {clocks.setpoints} setpoints"
    )
    episode = episode_of(box, path, (note,))
    columns: dict[str, NDArray[Any]] = {
        **episode.latency,
        MOTOR_TIMES: np.round(log.motors.time_us + ahead_us).astype(np.int64),
        MOTOR_OUTPUTS: log.motors.values.astype(np.float32),
    }
    return FlownEpisode(episode.record, path, columns)


def offset_us(clocks: ClockAlignment) -> float:
    """Return the offset from log to companion time [µs]; assumes equal delays if both are known."""
    if clocks.accepted_us is None:
        return clocks.told_us
    return 0.5 * (clocks.told_us - clocks.accepted_us)


def _path(told: Trajectory, log: VehicleLog, told_us: float, ahead_us: float) -> Trajectory:
    """Return the log's estimate at its attitude times, with the battery's power."""
    attitude, motion = log.attitude, log.motion
    inside = (attitude.time_us >= motion.time_us[0]) & (attitude.time_us <= motion.time_us[-1])
    logged_us, quaternion = attitude.time_us[inside], attitude.values[inside]
    state = motion.at(logged_us)
    # Both usually share the estimator's origin; otherwise, the goal uses the recording's origin.
    both = (told.time_us - told_us >= motion.time_us[0]) & (
        told.time_us - told_us <= motion.time_us[-1]
    )
    apart = told.position[both] - motion.at(told.time_us[both] - told_us)[:, :3]
    position = state[:, :3] + np.median(apart, axis=0)
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    times_us = np.round(logged_us + ahead_us).astype(np.int64)
    power_w = _power_w(log, logged_us, told, times_us)
    return Trajectory(times_us, position, state[:, 3:], quaternion / length, power_w)


def _power_w(
    log: VehicleLog, logged_us: NDArray[np.int64], told: Trajectory, times_us: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the battery's power (n,) from the log, or from the recording without log values."""
    battery = log.battery
    known = np.isfinite(battery.values[:, :2]).all(axis=1) if len(battery) else np.zeros(0, bool)
    if not known.any():
        return np.interp(times_us, told.time_us, told.power_w)
    watts = battery.values[known, 0] * battery.values[known, 1]
    return np.asarray(np.interp(logged_us, battery.time_us[known], watts), np.float64)
