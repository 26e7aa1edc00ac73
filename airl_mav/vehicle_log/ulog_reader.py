"""Reader of PX4 flight logs, versions 1.14 to 1.16; times since boot [µs], NED and FRD."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyulog import ULog
from pyulog.exceptions import ULogException

from airl_mav.core.constants import UNMEASURED_A
from airl_mav.core.errors import UsageError

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

MOTORS = 4

_TOPICS = (
    "actuator_motors",
    "battery_status",
    "sensor_combined",
    "trajectory_setpoint",
    "vehicle_acceleration",
    "vehicle_attitude",
    "vehicle_attitude_setpoint",
    "vehicle_local_position",
    "vehicle_local_position_setpoint",
    "vehicle_rates_setpoint",
    "vehicle_status",
    "wind",
)

_THRUST = "thrust_body[2]"
"""Thrust field of multicopters, along the body's down axis, so negative."""

_BROKEN = (
    EOFError,
    IndexError,
    KeyError,
    TypeError,
    UnicodeDecodeError,
    ValueError,
    struct.error,
    ULogException,
)
"""Exceptions that pyulog raises for other or damaged files."""


@dataclass(frozen=True)
class Series:
    """Samples of one topic; their number is n."""

    time_us: Times
    """Times (n,), increasing [µs]."""
    values: Floats
    """Values (n, k)."""

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time_us)

    def at(self, times_us: NDArray[Any]) -> Floats:
        """Return the values (m, k) at times (m,) [µs], linearly interpolated."""
        columns = [np.interp(times_us, self.time_us, column) for column in self.values.T]
        return np.stack(columns, axis=1)

    def newest(self, times_us: NDArray[Any]) -> Floats:
        """Return the newest values (m, k) at times (m,) [µs]; NaN before the first sample."""
        if not len(self):
            return np.full((len(times_us), self.values.shape[1]), np.nan)
        newest = np.searchsorted(self.time_us, times_us, side="right") - 1
        return np.where(newest[:, None] >= 0, self.values[np.maximum(newest, 0)], np.nan)

    def between(self, start_us: float, end_us: float) -> Series:
        """Return the samples from `start_us` to `end_us` [µs]."""
        inside = (self.time_us >= start_us) & (self.time_us <= end_us)
        return Series(self.time_us[inside], self.values[inside])


def empty(width: int) -> Series:
    """Return an empty series for a missing topic."""
    return Series(np.zeros(0, np.int64), np.zeros((0, width)))


@dataclass(frozen=True)
class VehicleLog:
    """Topics from a flight controller's log; missing topics are empty."""

    path: Path
    attitude: Series
    """Estimated attitude w, x, y, z, body to world."""
    motion: Series
    """Estimated position north, east, down [m], then velocity [m/s]."""
    motors: Series
    """Commands of the four motors, 0 to 1."""
    specific_force: Series
    """Specific force forward, right, down [m/s²], corrected by the estimated bias."""
    raw_specific_force: Series
    """Measured specific force forward, right, down [m/s²], including bias."""
    raw_rates: Series
    """Measured angular velocity about forward, right, down [rad/s], including bias."""
    setpoint: Series
    """Velocity setpoint north, east, down [m/s] and yaw rate setpoint [rad/s]."""
    yaw_rate_setpoint: Series
    """Yaw rate setpoint [rad/s]; logged more often than `setpoint`."""
    attitude_setpoint: Series
    """Attitude setpoint w, x, y, z, body to world, then thrust, 0 to 1."""
    rates_setpoint: Series
    """Body rate setpoint about forward, right, down [rad/s], then thrust, 0 to 1."""
    more_than_velocity: Series
    """Commanded position north, east, down [m], then acceleration [m/s²]; NaN = not commanded."""
    nav_state: Series
    """Flight mode, numbered as in `vehicle_status`."""
    battery: Series
    """Voltage [V], current [A] (NaN if not measured), remaining charge 1 to 0."""
    wind: Series
    """Estimated wind velocity north, east [m/s]."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """Parameters at the start of the log."""


def read_vehicle_log(path: Path) -> VehicleLog:
    """Read a .ulg file; raise UsageError without attitude or velocity."""
    accepted = "a ULog (.ulg) with vehicle_attitude and vehicle_local_position"
    try:
        with path.open("rb") as file:
            read = ULog(file, list(_TOPICS))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    except _BROKEN:
        raise UsageError(f"{path}: accepted: {accepted}") from None
    topics = {each.name: each.data for each in reversed(read.data_list) if each.multi_id == 0}
    attitude = _series(topics, "vehicle_attitude", _numbered("q", 4))
    motion = _series(topics, "vehicle_local_position", ("x", "y", "z", "vx", "vy", "vz"))
    if len(attitude) < 2 or len(motion) < 2:
        raise UsageError(f"{path}: accepted: {accepted}")
    return VehicleLog(
        path=path,
        attitude=_known(attitude),
        motion=_known(motion),
        motors=_known(_series(topics, "actuator_motors", _numbered("control", MOTORS))),
        specific_force=_known(_series(topics, "vehicle_acceleration", _numbered("xyz", 3))),
        raw_specific_force=_known(
            _series(topics, "sensor_combined", _numbered("accelerometer_m_s2", 3))
        ),
        raw_rates=_known(_series(topics, "sensor_combined", _numbered("gyro_rad", 3))),
        setpoint=_setpoint(topics),
        yaw_rate_setpoint=_known(
            _series(topics, "vehicle_attitude_setpoint", ("yaw_sp_move_rate",))
        ),
        attitude_setpoint=_upward(
            _series(topics, "vehicle_attitude_setpoint", (*_numbered("q_d", 4), _THRUST))
        ),
        rates_setpoint=_upward(
            _series(topics, "vehicle_rates_setpoint", ("roll", "pitch", "yaw", _THRUST))
        ),
        more_than_velocity=_series(
            topics,
            "trajectory_setpoint",
            (*_numbered("position", 3), *_numbered("acceleration", 3)),
        ),
        nav_state=_series(topics, "vehicle_status", ("nav_state",)),
        battery=_battery(topics),
        wind=_known(_series(topics, "wind", ("windspeed_north", "windspeed_east"))),
        parameters={name: float(value) for name, value in read.initial_parameters.items()},
    )


def _battery(topics: Mapping[str, Any]) -> Series:
    """Return the battery measurements; an unmeasured current is NaN."""
    told = _series(topics, "battery_status", ("voltage_v", "current_a", "remaining"))
    told.values[told.values[:, 1] == UNMEASURED_A, 1] = np.nan
    return told


def _setpoint(topics: Mapping[str, Any]) -> Series:
    local = _series(topics, "vehicle_local_position_setpoint", ("vx", "vy", "vz", "yawspeed"))
    trajectory = _series(topics, "trajectory_setpoint", (*_numbered("velocity", 3), "yawspeed"))
    return max(local, trajectory, key=len)


def _series(topics: Mapping[str, Any], topic: str, fields: Sequence[str]) -> Series:
    data = topics.get(topic)
    if data is None or any(name not in data for name in fields):
        return empty(len(fields))
    # Values belong to the sample's time; `timestamp` is the later time of publication.
    times = np.asarray(data.get("timestamp_sample", data["timestamp"]), np.int64)
    later = np.diff(times, prepend=-1) > 0
    values = np.stack([np.asarray(data[name], np.float64) for name in fields], axis=1)
    return Series(times[later], values[later])


def _known(series: Series) -> Series:
    """Return the finite samples: stopped motors are NaN."""
    there = np.isfinite(series.values).all(axis=1)
    return Series(series.time_us[there], series.values[there])


def _upward(series: Series) -> Series:
    """Return the finite samples with the thrust, their last column, made positive."""
    known = _known(series)
    return Series(known.time_us, np.column_stack([known.values[:, :-1], -known.values[:, -1]]))


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}[{i}]" for i in range(count))
