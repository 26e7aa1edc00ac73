"""Input of an identification: a recorded flight, the vehicle's log, or both; fitted quantities."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap, t

from airl_mav.addons.recordings.recorded_flight import NAVIGATING, path_of, stamps_of
from airl_mav.black_box import mcap_file, messages
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import PAGE, UsageError
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.stamps import SETPOINT, commanded
from airl_mav.vehicle_log import MOTORS, ClockAlignment, VehicleLog, align

AIRBORNE_M = 0.8
"""Minimum height above the start position without ground effect [m]."""

LOGGED_PATH_US = 40_000
"""Step of a path from a log [µs]: the rate of a companion's recording."""

OFFBOARD = 14
"""`vehicle_status.nav_state` of PX4's Offboard (NAVIGATION_STATE_OFFBOARD)."""


@dataclass(frozen=True)
class Flown:
    """Recorded flight in the companion's time; log times for a log alone."""

    path: Trajectory
    """Path from telemetry, or from the log."""
    sent_us: NDArray[np.int64]
    """(k,) send times of the setpoints; for a log, their first log times [µs]."""
    setpoints: NDArray[np.float64]
    """(k, 4) velocity [m/s], yaw rate [rad/s]: forward, right, down; for a log north, east,
    down."""
    navigation_us: int
    """Start of steering by velocity setpoints [µs]."""
    ended_us: int
    """End of steering by velocity setpoints [µs]."""
    airborne_us: tuple[int, int]
    """Airborne interval, clear of the ground [µs]."""
    log: VehicleLog | None = None
    clocks: ClockAlignment | None = None
    """Relation of the companion's and the log's clocks; None without both."""

    @property
    def is_logged_only(self) -> bool:
        """True if only the vehicle's log is available."""
        return self.log is not None and self.clocks is None

    @property
    def told_by(self) -> str:
        """Source of the motion, as text."""
        return "the vehicle's log" if self.is_logged_only else "telemetry"

    def logged_us(self, time_us: float) -> float:
        """Return the log time of telemetry received at a flight time [µs]."""
        if self.log is None:
            raise ValueError("there is no log")
        return time_us if self.clocks is None else time_us - self.clocks.told_us


def flown_of(box: mcap_file.BlackBox, log: VehicleLog | None) -> Flown:
    """Return a recorded flight with its vehicle's log; UsageError without navigation."""
    decisions = box.all_of(messages.Decision)
    path = path_of(box)
    begun = [each.time_us for each in box.all_of(messages.Phase) if each.phase == NAVIGATING]
    if not begun or not decisions or len(path) < 2:
        raise UsageError(f"{box.path}: no decision was recorded; accepted: a flight that navigated")
    stamps = stamps_of(box)
    if SETPOINT not in stamps:
        kind = commanded(stamps).replace("_", " ")
        raise UsageError(
            f"{box.path}: its policy commanded {kind}; accepted: a flight by velocities, whose"
            " response is fitted"
        )
    sent_us, setpoints = stamps["sent_us"], np.asarray(stamps[SETPOINT], np.float64)
    after = [
        each.time_us
        for each in box.all_of(messages.Phase)
        if each.time_us >= begun[0] and each.phase != NAVIGATING
    ]
    ended_us = after[0] if after else int(path.time_us[-1])
    clocks = None if log is None else align(path, log, sent_us, setpoints)
    return Flown(
        path=path,
        sent_us=sent_us,
        setpoints=setpoints,
        navigation_us=begun[0],
        ended_us=ended_us,
        airborne_us=_airborne_us(path, begun[0], ended_us),
        log=log,
        clocks=clocks,
    )


def flown_by_log(log: VehicleLog) -> Flown:
    """Return the longest airborne stretch of a quadrotor's log; UsageError without one."""
    rotors = log.parameters.get("CA_ROTOR_COUNT", MOTORS)
    if rotors != MOTORS:
        raise UsageError(
            f"{log.path}: CA_ROTOR_COUNT {rotors:g}: accepted: {MOTORS}, a quadrotor ({PAGE})"
        )
    path = _logged_path(log)
    ground_m = float(np.median(path.position[path.time_us < path.time_us[0] + US_PER_S, 2]))
    high = path.position[:, 2] < ground_m - AIRBORNE_M
    if not high.any():
        raise UsageError(
            f"{log.path}: never {AIRBORNE_M:g} m above where it began: accepted: a log of a flight"
        )
    start_us, end_us = (int(path.time_us[each]) for each in _longest(high))
    sent_us, setpoints = _velocity_setpoints(log, start_us, end_us)
    return Flown(
        path=path,
        sent_us=sent_us,
        setpoints=setpoints,
        navigation_us=int(sent_us[0]) if len(sent_us) else start_us,
        ended_us=int(sent_us[-1]) if len(sent_us) else end_us,
        airborne_us=(start_us, end_us),
        log=log,
    )


def _logged_path(log: VehicleLog) -> Trajectory:
    """Return the estimated path at `LOGGED_PATH_US`, interpolated between log samples."""
    first_us = max(int(each.time_us[0]) for each in (log.motion, log.attitude))
    last_us = min(int(each.time_us[-1]) for each in (log.motion, log.attitude))
    times_us = np.arange(first_us, last_us, LOGGED_PATH_US)
    if len(times_us) < 2:
        raise UsageError(f"{log.path}: position and attitude are not of the same time")
    motion, turned = log.motion.at(times_us), log.attitude.at(times_us)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return Trajectory(times_us, motion[:, :3], motion[:, 3:], turned, np.zeros(len(times_us)))


def _velocity_setpoints(
    log: VehicleLog, start_us: int, end_us: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the longest run of pure velocity setpoints, because plans hide the response."""
    tracked = log.setpoint.between(start_us, end_us)
    steered = np.isfinite(tracked.values[:, :3]).all(axis=1)
    steered &= log.nav_state.newest(tracked.time_us)[:, 0] == OFFBOARD
    beside = log.more_than_velocity.newest(tracked.time_us)
    steered &= ~np.isfinite(beside).any(axis=1)
    if not steered.any():
        return np.zeros(0, np.int64), np.zeros((0, 4))
    first, last = _longest(steered)
    return tracked.time_us[first : last + 1], np.nan_to_num(tracked.values[first : last + 1])


def _longest(holds: NDArray[np.bool_]) -> tuple[int, int]:
    """Return the first and the last index of the longest true run; requires one."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(np.int8)))
    starts, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - starts))
    return int(starts[longest]), int(ends[longest]) - 1


def seconds(times_us: NDArray[np.int64], from_us: int) -> NDArray[np.float64]:
    """Return times (n,) [µs] as seconds since a start."""
    return np.asarray((times_us - from_us) / US_PER_S, np.float64)


def _airborne_us(path: Trajectory, navigation_us: int, ended_us: int) -> tuple[int, int]:
    """Return the airborne interval around the navigation [µs], or the navigation itself."""
    high = path.position[:, 2] < path.position[0, 2] - AIRBORNE_M
    at = min(int(np.searchsorted(path.time_us, navigation_us)), len(path) - 1)
    if not high[at]:
        return navigation_us, ended_us
    low_before = np.flatnonzero(~high[:at])
    low_after = np.flatnonzero(~high[at:])
    first = 0 if not len(low_before) else int(low_before[-1]) + 1
    last = len(path) - 1 if not len(low_after) else at + int(low_after[0]) - 1
    return int(path.time_us[first]), int(path.time_us[last])


Array = NDArray[np.float64]

LEVEL = 0.95
RESAMPLES = 999
BLOCK_S = 1.0
"""Length of resampled blocks: residuals closer in time may be correlated [s]."""

LEAST_BLOCKS = 4
"""Minimum number of blocks for an interval."""


@dataclass(frozen=True)
class FittedQuantity:
    """Fitted quantity."""

    key: str
    meaning: str
    unit: str
    value: float | None = None
    """Fitted value; None: not observable in this flight."""
    low: float | None = None
    high: float | None = None
    """Upper end of the 95 % interval; `low` is the lower end."""
    source: str = ""
    unobservable: str = ""
    """Reason why the quantity is unknown; "" if known."""
    profile: float | None = None
    """Value of the profile, in the same unit; None: missing."""

    @property
    def observed(self) -> bool:
        """True if the flight provides the quantity."""
        return self.value is not None

    @property
    def half_width(self) -> float | None:
        """Half the width of the interval."""
        if self.low is None or self.high is None:
            return None
        return 0.5 * (self.high - self.low)

    def found(self, ends: Iterable[float], source: str) -> FittedQuantity:
        """Return the quantity with value, low and high end of the interval, and their source."""
        value, low, high = map(float, ends)
        return replace(self, value=value, low=low, high=high, source=source)

    def without(self, why: str) -> FittedQuantity:
        """Return the quantity as not observable."""
        return replace(self, value=None, low=None, high=None, source="", unobservable=why)


def block_intervals(
    jacobian: Array, residuals: Array, times_s: Array, rng: np.random.Generator
) -> Array:
    """Return the offsets of 95 % intervals from a least-squares solution, lower and upper (2, k).

    Neighbouring residuals are correlated, so blocks of seconds are resampled. Each resample moves
    the solution by one Gauss-Newton step (one-step bootstrap). Student's t accounts for the few
    blocks. Unobservable parameters have infinite intervals.
    """
    block = np.unique(np.floor((times_s - times_s.min()) / BLOCK_S), return_inverse=True)[1]
    count = int(block.max()) + 1
    parameters = jacobian.shape[1]
    if count < LEAST_BLOCKS:
        return np.array([[-math.inf] * parameters, [math.inf] * parameters])
    slopes, squares = np.zeros((count, parameters)), np.zeros((count, parameters, parameters))
    np.add.at(slopes, block, jacobian * residuals[:, None])
    np.add.at(squares, block, jacobian[:, :, None] * jacobian[:, None, :])

    def moved(chosen: NDArray[np.int64]) -> Array:
        square = squares[chosen].sum(axis=0)
        return -np.asarray(np.linalg.lstsq(square, slopes[chosen].sum(axis=0), rcond=None)[0])

    return _widened(np.arange(count), moved, rng)


def mean_interval(values: Array, times_s: Array, rng: np.random.Generator) -> tuple[float, float]:
    """Return the 95 % interval of the mean of correlated samples (n,)."""
    ones = np.ones((len(values), 1))
    ends = block_intervals(-ones, values - values.mean(), times_s, rng)
    return float(values.mean() + ends[0, 0]), float(values.mean() + ends[1, 0])


def _widened(
    blocks: NDArray[np.int64],
    statistic: Callable[[NDArray[np.int64]], Array],
    rng: np.random.Generator,
) -> Array:
    """Return the bootstrap interval of a statistic of blocks, widened by Student's t."""
    found = bootstrap(
        (blocks,),
        statistic,
        vectorized=False,
        n_resamples=RESAMPLES,
        confidence_level=LEVEL,
        method="percentile",
        rng=rng,
    ).confidence_interval
    tail = 0.5 + 0.5 * LEVEL
    wider = t.ppf(tail, len(blocks) - 1) / t.ppf(tail, math.inf)
    return np.asarray([found.low, found.high]) * wider
