"""PX4 flight logs, versions 1.14 to 1.16, and their alignment with a companion's recording.

Times of a log count from boot [µs], frames are NED and FRD. Alignment of the clocks:

Downlink: telemetry repeats the log's velocity and attitude with a delay. The best matching shift is
the clock offset plus the age of telemetry: the link delay plus the age of the newest message.
Uplink: a setpoint appears in the log between two samples. Each setpoint thus bounds the clock
offset plus its delay. Marzullo's algorithm finds the shift within most of these bounds
(K. Marzullo, Maintaining the time in a distributed system, 1984).

Neither shift alone separates the offset from the link delay. The offset cancels in their sum, which
is the round trip from sending a setpoint to the first telemetry that can reflect it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyulog import ULog
from pyulog.exceptions import ULogException
from scipy.optimize import minimize_scalar
from scipy.signal import correlate, correlation_lags

from airl_mav.core import constants, errors, files, frames
from airl_mav.flight.trajectory import Trajectory

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

MOTORS = 4

_THRUST = "thrust_body[2]"
"""Thrust field of multicopters, along the body's down axis, so negative."""

_BROKEN = (
    EOFError,
    IndexError,
    KeyError,
    RecursionError,
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


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}[{i}]" for i in range(count))


_SERIES: Mapping[str, tuple[str, Sequence[str]]] = {
    "attitude": ("vehicle_attitude", _numbered("q", 4)),
    "motion": ("vehicle_local_position", ("x", "y", "z", "vx", "vy", "vz")),
    "motors": ("actuator_motors", _numbered("control", MOTORS)),
    "specific_force": ("vehicle_acceleration", _numbered("xyz", 3)),
    "raw_specific_force": ("sensor_combined", _numbered("accelerometer_m_s2", 3)),
    "raw_rates": ("sensor_combined", _numbered("gyro_rad", 3)),
    "setpoint": ("vehicle_local_position_setpoint", ("vx", "vy", "vz", "yawspeed")),
    "yaw_rate_setpoint": ("vehicle_attitude_setpoint", ("yaw_sp_move_rate",)),
    "attitude_setpoint": ("vehicle_attitude_setpoint", (*_numbered("q_d", 4), _THRUST)),
    "rates_setpoint": ("vehicle_rates_setpoint", ("roll", "pitch", "yaw", _THRUST)),
    "more_than_velocity": (
        "trajectory_setpoint",
        (*_numbered("position", 3), *_numbered("acceleration", 3)),
    ),
    "nav_state": ("vehicle_status", ("nav_state",)),
    "battery": ("battery_status", ("voltage_v", "current_a", "remaining")),
    "wind": ("wind", ("windspeed_north", "windspeed_east")),
}
"""Topic and columns of each series of a `VehicleLog`."""

_PARTLY_NAN = ("setpoint", "more_than_velocity", "nav_state", "battery")
"""Series in which NaN has a meaning; samples with NaN are removed from all others."""


class _LimitedLog(ULog):  # type: ignore[misc]  # pyulog has no types
    """Reader that ends for any file: with limits of damaged places, and of a message's fields."""

    left = 1_000_000

    def _check_packet_corruption(self, header: Any) -> bool:
        # pyulog goes back by the size of a damaged message, and would search the same place again.
        self.left -= (found := bool(super()._check_packet_corruption(header)))
        if self.left < 0:
            raise ULogException("too many damaged places")
        return found

    class _MessageAddLogged(ULog._MessageAddLogged):  # type: ignore[misc]  # as above
        left = 1 << 16

        def _parse_nested_type(self, prefix: str, name: str, formats: Mapping[str, Any]) -> None:
            self.left -= 1 + sum(max(size, 1) for _, size, _ in formats[name].fields)
            if self.left < 0:
                raise ULogException(f"{name}: too many fields")
            super()._parse_nested_type(prefix, name, formats)


def read_vehicle_log(path: Path) -> VehicleLog:
    """Read a .ulg file; raise UsageError without attitude or velocity."""
    accepted = "a ULog (.ulg) with vehicle_attitude and vehicle_local_position"
    try:
        with files.open_regular(path) as file:
            read = _LimitedLog(file, sorted({topic for topic, _ in _SERIES.values()}))
    except OSError as error:
        raise errors.UsageError(f"{path}: {error.strerror}") from None
    except _BROKEN:
        raise errors.UsageError(f"{path}: accepted: {accepted}") from None
    # First instance of each topic; reversed, so that the first entry wins.
    topics = {each.name: each.data for each in reversed(read.data_list) if each.multi_id == 0}
    series = {name: _series(topics, *columns) for name, columns in _SERIES.items()}
    # Alignment needs a course of both.
    if len(series["attitude"]) < 2 or len(series["motion"]) < 2:
        raise errors.UsageError(f"{path}: accepted: {accepted}")
    # Either topic may have more samples.
    velocity = (*_numbered("velocity", 3), "yawspeed")
    trajectory = _series(topics, "trajectory_setpoint", velocity)
    series["setpoint"] = max(series["setpoint"], trajectory, key=len)
    battery = series["battery"].values
    # An unmeasured current must not look like a small one.
    battery[battery[:, 1] == constants.UNMEASURED_A, 1] = np.nan
    known = {name: each if name in _PARTLY_NAN else _known(each) for name, each in series.items()}
    # pyulog returns a parameter of a damaged type as bytes.
    given = read.initial_parameters.items()
    return VehicleLog(
        path=path,
        parameters={name: float(value) for name, value in given if type(value) is not bytes},
        **known | {name: _upward(known[name]) for name in ("attitude_setpoint", "rates_setpoint")},
    )


def _series(topics: Mapping[str, Any], topic: str, fields: Sequence[str]) -> Series:
    data = topics.get(topic)
    if data is None or any(name not in data for name in ("timestamp", *fields)):
        return empty(len(fields))
    # Values belong to the sample's time; `timestamp` is the later time of publication.
    times = np.asarray(data.get("timestamp_sample", data["timestamp"]), np.int64)
    # Interpolation needs increasing times: repeated and late samples are dropped.
    later = np.diff(times, prepend=-1) > 0
    values = np.stack([np.asarray(data[name], np.float64) for name in fields], axis=1)
    return Series(times[later], values[later])


def _known(series: Series) -> Series:
    """Return the finite samples: stopped motors are NaN."""
    there = np.isfinite(series.values).all(axis=1)
    return Series(series.time_us[there], series.values[there])


def _upward(series: Series) -> Series:
    """Return the samples with the thrust, their last column, made positive."""
    return Series(series.time_us, np.column_stack([series.values[:, :-1], -series.values[:, -1]]))


GRID_US = 40_000
"""Step of the search over all shifts [µs]: the period of the companion's recording."""

FINE_US = 100_000
"""Half-width of the refinement around the coarse shift [µs]."""

LEAST_CORRELATION = 0.8
"""Minimum correlation of the velocities; below it, the recordings are of different flights."""

LEAST_SPEED_M_S = 0.5
"""Minimum top speed of a flight [m/s]; slower motion is indistinguishable from noise."""

LEAST_SETPOINTS = 3
"""Minimum number of matched setpoints for an uplink delay."""

SAME_SPEED_M_S, SAME_RATE_RAD_S = 0.02, 0.01
"""Tolerances for equal setpoints: speed and yaw rate, which do not depend on the heading."""

SAME_TURN, SAME_THRUST = 0.001, 0.001
"""Tolerances for equal body rates [rad/s], components of `_down_and_nose`, and thrusts. Unlike yaw
rates, they reach the log unfiltered."""

LONGEST_LINK_US = constants.US_PER_S
"""Maximum uplink delay of a setpoint [µs]."""


@dataclass(frozen=True)
class ClockAlignment:
    """Relation of the clocks of a recording and a log of the same flight."""

    told_us: float
    """Downlink shift: companion's telemetry time minus the flight controller's time [µs]."""
    correlation: float
    """Correlation of the velocities at that shift, 0 to 1."""
    error_m_s: float
    """Root mean square difference of the velocities at that shift [m/s]."""
    accepted_us: float | None
    """Uplink shift: flight controller's time of accepting a setpoint minus the companion's send
    time [µs]; None = fewer than `LEAST_SETPOINTS` matched setpoints."""
    accepted_range_us: tuple[float, float] | None
    """Bounds of the uplink shift that most setpoints agree on [µs]."""
    setpoints: int

    @property
    def round_trip_us(self) -> float | None:
        """Time from sending a setpoint to its telemetry [µs], without the vehicle's response."""
        return None if self.accepted_us is None else self.told_us + self.accepted_us


def align(
    path: Trajectory,
    log: VehicleLog,
    sent_us: NDArray[np.int64],
    setpoints: NDArray[np.float64],
    commands: constants.CommandKind = "velocity",
) -> ClockAlignment:
    """Return the clock relation of a recorded flight and its vehicle's log, or raise UsageError."""
    # The coarse search over all shifts avoids local minima of the fine one.
    told_us = _refined(path, log, _coarse(path, log))
    flown, logged = path.velocity[:, :2], log.motion.at(path.time_us - told_us)[:, 3:5]
    inside = _inside(path, log, told_us)
    error = flown[inside] - logged[inside]
    correlation = _correlation(flown[inside], logged[inside])
    if correlation < LEAST_CORRELATION:
        raise errors.UsageError(
            f"{log.path}: its velocities agree with those of the recording by {correlation:.2f} at "
            f"best; accepted: the log of the same flight, {LEAST_CORRELATION:g} or more"
        )
    low_us, high_us, count = _accepted(sent_us, setpoints, commands, log, told_us)
    # One or two matches may be coincidence.
    known = count >= LEAST_SETPOINTS
    return ClockAlignment(
        told_us=told_us,
        correlation=correlation,
        error_m_s=float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        accepted_us=0.5 * (low_us + high_us) if known else None,
        accepted_range_us=(low_us, high_us) if known else None,
        setpoints=count,
    )


def _coarse(path: Trajectory, log: VehicleLog) -> float:
    """Return the shift [µs] of maximum velocity correlation, rounded to the grid."""
    times = [
        np.arange(int(each[0]), int(each[-1]), GRID_US)
        for each in (path.time_us, log.motion.time_us)
    ]
    told = np.stack([np.interp(times[0], path.time_us, each) for each in path.velocity.T])
    logged = log.motion.at(times[1])[:, 3:].T
    # Without motion every shift correlates equally well.
    if min(len(each) for each in times) < 2 or np.abs(told).max() < LEAST_SPEED_M_S:
        raise errors.UsageError(
            f"{log.path}: the clocks cannot be aligned; accepted: a flight with motion of "
            f"{LEAST_SPEED_M_S:g} m/s or more"
        )
    # All three axes add up: one alone may be constant.
    score = sum(correlate(a, b) for a, b in zip(told, logged, strict=True))
    lag = correlation_lags(len(times[0]), len(times[1]))[int(np.argmax(score))]
    return float(times[0][0] - times[1][0] + lag * GRID_US)


def _refined(path: Trajectory, log: VehicleLog, coarse_us: float) -> float:
    """Return the best shift [µs] for attitude and velocity near a coarse shift."""

    def cost(shift_us: float) -> float:
        inside = _inside(path, log, shift_us)
        times = path.time_us[inside] - shift_us
        leaning = _down_and_nose(path.quaternion[inside])
        logged = _down_and_nose(log.attitude.at(times))
        moved = path.velocity[inside] - log.motion.at(times)[:, 3:]
        # Both residuals are divided by their spread, so neither unit dominates.
        turned = (leaning - logged) / max(float(leaning.std()), 1e-3)
        return float(np.mean(turned**2) + np.mean((moved / path.velocity[inside].std()) ** 2))

    # Beyond the coarse grid's step, as its maximum may be one step off.
    bounds = (coarse_us - FINE_US, coarse_us + FINE_US)
    return float(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 50.0}).x)


def _down_and_nose(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the horizontal parts of the body's down and nose axes (n, 4), equal for q and -q."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    return np.stack(
        [
            2.0 * (x * z + w * y),
            2.0 * (y * z - w * x),
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y + w * z),
        ],
        axis=1,
    )


def _inside(path: Trajectory, log: VehicleLog, shift_us: float) -> NDArray[np.bool_]:
    """Return a mask (n,) of the samples within the log's time range."""
    times = path.time_us - shift_us
    first = max(log.motion.time_us[0], log.attitude.time_us[0])
    last = min(log.motion.time_us[-1], log.attitude.time_us[-1])
    inside: NDArray[np.bool_] = (times >= first) & (times <= last)
    if not inside.any():
        raise errors.UsageError(f"{log.path}: accepted: the log of the same flight")
    return inside


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    power = float(np.sum(a * a) * np.sum(b * b))
    # Without the means: a constant velocity is a signal, too.
    return float(np.sum(a * b) / np.sqrt(power)) if power > 0.0 else 0.0


def _accepted(
    sent_us: NDArray[np.int64],
    setpoints: NDArray[np.float64],
    commands: constants.CommandKind,
    log: VehicleLog,
    told_us: float,
) -> tuple[float, float, int]:
    """Return the bounds [µs] of the uplink shift and the number of setpoints that agree."""
    expected_us = np.asarray(sent_us - told_us, np.float64)
    bounds = [
        bound
        for sent, seen, near in _looked_for(setpoints, commands, log)
        for bound in _bounds(expected_us, sent, seen, np.array(near))
    ]
    if not bounds:
        return 0.0, 0.0, 0
    low_us, high_us, count = marzullo(np.array(bounds, np.float64))
    return low_us - told_us, high_us - told_us, count


def _looked_for(
    setpoints: NDArray[np.float64], commands: constants.CommandKind, log: VehicleLog
) -> Iterator[tuple[NDArray[np.float64], Series, tuple[float, ...]]]:
    """Yield sent setpoints (k, m), their series (n, m) in the log and match tolerances (m,)."""
    if commands == "body_rates":
        yield setpoints, log.rates_setpoint, (*3 * (SAME_TURN,), SAME_THRUST)
        return
    if commands == "attitude":
        turned = [frames.quat_from_euler(*angles) for angles in setpoints[:, :3].tolist()]
        sent = _down_and_nose(np.array(turned).reshape(-1, 4))
        seen = log.attitude_setpoint
        attitude = _down_and_nose(seen.values[:, :4])
        yield (
            np.column_stack([sent, setpoints[:, 3]]),
            Series(seen.time_us, np.column_stack([attitude, seen.values[:, 4]])),
            (*4 * (SAME_TURN,), SAME_THRUST),
        )
        return
    level = log.setpoint.values
    # Speed and yaw rate do not depend on the heading, so they are equal at both ends.
    sent = np.stack([np.hypot(setpoints[:, 0], setpoints[:, 1]), setpoints[:, 3]], axis=1)
    seen_level = np.stack([np.hypot(level[:, 0], level[:, 1]), level[:, 3]], axis=1)
    yield sent, Series(log.setpoint.time_us, seen_level), (SAME_SPEED_M_S, SAME_RATE_RAD_S)
    yield sent[:, 1:], log.yaw_rate_setpoint, (SAME_RATE_RAD_S,)


def _bounds(
    expected_us: NDArray[np.float64],
    sent: NDArray[np.float64],
    seen: Series,
    near: NDArray[np.float64],
) -> list[tuple[float, float]]:
    """Return intervals [µs] after the expected times (k,) in which setpoints enter the log."""
    bounds = []
    # From the second setpoint on: a match needs a change.
    for k in range(1, len(sent)):
        if (np.abs(sent[k] - sent[k - 1]) < 2.0 * near).all():
            continue  # The log shows no change.
        window = slice(
            int(np.searchsorted(seen.time_us, expected_us[k] - FINE_US)),
            int(np.searchsorted(seen.time_us, expected_us[k] + LONGEST_LINK_US)),
        )
        same = (np.abs(seen.values[window] - sent[k]) < near).all(axis=1)
        first = int(np.argmax(same)) if same.any() else 0
        # The change happened between two log samples: both bound its time. At the first sample the
        # lower bound is missing.
        if first > 0:
            times = seen.time_us[window][first - 1 : first + 1] - expected_us[k]
            bounds.append((float(times[0]), float(times[1])))
    return bounds


def marzullo(bounds: NDArray[np.float64]) -> tuple[float, float, int]:
    """Return the interval covered by most of the intervals (n, 2), and their number."""
    edges = [(low, -1) for low in bounds[:, 0]] + [(high, 1) for high in bounds[:, 1]]
    # At equal times begins sort before ends (-1 < 1): touching intervals overlap.
    edges.sort()
    open_now, best, found = 0, 0, (0.0, 0.0)
    for i, (at, kind) in enumerate(edges):
        open_now -= kind
        # The interval of maximum overlap ends at the next edge.
        if kind == -1 and open_now > best:
            best, found = open_now, (float(at), float(edges[i + 1][0]))
    return found[0], found[1], best
