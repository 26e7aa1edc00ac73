"""Drag and wind, from the acceleration across the body's axis.

With the drag D per mass, k = D / m, and the wind w, the air brakes a velocity v by k (v - w). The
rotors push along the body's axis only. Both fits are linear in k and k w.

The vehicle's log holds the acceleration that is felt, along the body's x and y axes:

    a = -k R' (v - w) + b + c (w_y, -w_x)

R' turns from NED to the body's axes. b is the accelerometer's bias, with a normal prior. Several
headings tell it from the wind. w_x and w_y are the rates of roll and pitch. Rotors above the centre
of mass feel their wind. A sample that is a mean is turned by them. (PX4's own estimator tells
drag from wind so: EKF2_DRAG_CTRL.)

Telemetry has no accelerometer. There the lean of the vehicle accelerates it.

    v' = g + f z - k (v - w)

z is the body's up axis, f the thrust per mass, from the vertical part of the equation. The level
part is averaged over windows of half a second. An error of the attitude looks like wind while the
heading stays. It is estimated as a bias along the body's axes with a normal prior. That is of the
profile's accelerometer until the vehicle has manoeuvred, and smaller after. So the interval of the
wind is wide where the flight is short, or the drag small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.latency.percentiles import integrated_time
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.refitting.flown import Flown
from airl_mav.refitting.quantity import Array, FittedQuantity
from airl_mav.vehicle_log.ulog import VehicleLog

WINDOW = 13
"""Samples of a window: half a second of telemetry."""

SETTLE_US = 2 * US_PER_S
"""After so long in navigation an estimator has told tilt and bias apart [µs]."""

SETTLED_SHARE = 0.4
"""What is left of an accelerometer's bias in the attitude then, and along the axis of thrust."""

LEARNT_SHARE = 0.6
"""What is left of it in what the estimator has corrected until the flight's end. Chosen on the
first twenty flights of benchmarks/bench_refit.py and 24 of PX4 1.16."""

BY_RATE_M_S = 0.1
"""How much of a rate the accelerometer may feel as acceleration [m/s² for 1 rad/s]. A thrust of 1 g
that is turned by a sample's time of 4 ms is 0.04, drag of 0.2 1/s on rotors 10 cm up 0.02."""

OFF_M_S, OFF_S = 0.03, 4.0
"""An estimator's velocity is off by so much along an axis [m/s], and for so long by about the same
[s]. That is what PX4 1.16 estimated in twelve simulated flights whose truth is known. The
accelerometer's equations take it for wind."""

SKEW_S = 0.01
"""By how much attitude and velocity in telemetry may be of different moments [s]."""

UNSEEN = 2.0
"""Errors of an estimator and gusts change slower than a short flight shows. The variance is so many
times that which the rows show. Chosen on the first twenty flights of benchmarks/bench_refit.py."""

LEAST_ROWS = 4 * WINDOW
LEAST_FELT = 40
"""Samples of the accelerometer: two seconds of what PX4 logs by default."""
DRAWS = 4000
"""Of the posterior distribution: wind is a ratio."""

WIDEST_DRAG, WIDEST_WIND_M_S = 0.2, 1.0
"""Half widths of intervals, of the drag as a share, from which on nothing is observable."""

ITERATIONS = 4
"""For the noise of the rows, and for quadratic drag, which needs the wind."""

_DRAG, _NORTH, _EAST = 0, 1, 2
_AIR = 3
"""Parameters of the air: k, k w north, k w east; biases follow."""


DRAG = FittedQuantity("drag_1_s", "drag per mass", "1/s")
WIND = (
    FittedQuantity("wind_north_m_s", "wind towards north", "m/s"),
    FittedQuantity("wind_east_m_s", "wind towards east", "m/s"),
)


@dataclass(frozen=True)
class Air:
    """What the air did."""

    drag_1_s: FittedQuantity
    wind_north_m_s: FittedQuantity
    wind_east_m_s: FittedQuantity
    quadratic_1_m: float
    """Quadratic drag per mass, as the profile has it."""

    @property
    def wind(self) -> tuple[float, float] | None:
        """Steady wind towards north, east [m/s]; None: not observable."""
        north, east = self.wind_north_m_s.value, self.wind_east_m_s.value
        return None if north is None or east is None else (north, east)

    def along_thrust(self, velocity: Array, quaternion: Array) -> Array:
        """Return drag per mass along body down (n,) [m/s²], of NED velocities and attitudes."""
        north, east = self.wind or (0.0, 0.0)
        against = velocity - np.array([north, east, 0.0])
        linear = self.drag_1_s.value or 0.0
        speed = np.linalg.norm(against, axis=1, keepdims=True)
        force = -(linear + self.quadratic_1_m * speed) * against
        down = _rotation(quaternion)[:, :, 2]
        return np.asarray(np.sum(force * down, axis=1))


@dataclass(frozen=True)
class _Rows:
    """Equations of accelerations: what is left = matrix @ parameters."""

    matrix: Array
    """(n, 2, 3 + others)."""
    left: Array
    """(n, 2) [m/s²]."""
    velocity: Array
    """(n, 3) NED [m/s], for quadratic drag."""
    axes: Array
    """(n, 2, 3) how a force NED enters the two equations."""
    prior: tuple[float, ...]
    """Standard deviations of the others: biases [m/s²]; what is felt of rates [m/s], or how early
    the lean is [s]."""
    off: float = 0.0
    """How much slow errors of the velocity weigh as noise of single samples [m²/s²]."""


def fit_air(flown: Flown, vehicle: VehicleProfile, rng: np.random.Generator) -> Air:
    """Fit drag and wind; the profile gives accelerometer and quadratic drag."""
    mass_kg = vehicle.body.mass_kg
    quadratic_1_m = vehicle.drag.quadratic_n_s2_m2 / mass_kg
    known = vehicle.drag.linear_n_s_m / mass_kg
    bias_m_s2 = vehicle.sensors.imu.accel_bias_m_s2
    source = "accelerometer, velocity and attitude in the vehicle's log"
    rows = _felt_rows(flown, bias_m_s2)
    if rows is None:
        source = f"lean and acceleration in {flown.told_by}"
        rows = _lean_rows(flown, bias_m_s2)
    if rows is None:
        return _nothing("the flight is too short", known, quadratic_1_m)
    middle, covariance = _posterior(rows, quadratic_1_m)
    drawn = rng.multivariate_normal(middle[:_AIR], covariance[:_AIR, :_AIR], DRAWS)
    drag = _estimate(replace(DRAG, profile=known), middle[_DRAG], drawn[:, _DRAG], source)
    half = drag.half_width or 0.0
    if middle[_DRAG] <= 0.0 or half > WIDEST_DRAG * middle[_DRAG]:
        why = (
            f"drag {middle[_DRAG]:.3f} +- {half:.3f} 1/s: too little of the flight is fast, or the"
            " drag is too small"
        )
        return _nothing(why, known, quadratic_1_m)
    wind = [
        _estimate(of, middle[i] / middle[_DRAG], drawn[:, i] / drawn[:, _DRAG], source)
        for of, i in zip(WIND, (_NORTH, _EAST), strict=True)
    ]
    if (half := max(each.half_width or 0.0 for each in wind)) > WIDEST_WIND_M_S:
        why = (
            f"known to {half:.1f} m/s, {WIDEST_WIND_M_S:g} or better is needed: against this drag"
            " an error of the attitude looks like it"
        )
        wind = [each.without(why) for each in WIND]
    return Air(drag, wind[0], wind[1], quadratic_1_m)


def _nothing(why: str, known: float, quadratic_1_m: float) -> Air:
    north, east = WIND
    drag = replace(DRAG, profile=known)
    return Air(drag.without(why), north.without(why), east.without(why), quadratic_1_m)


def _estimate(of: FittedQuantity, value: float, drawn: Array, source: str) -> FittedQuantity:
    return of.found((value, *np.quantile(drawn, (0.025, 0.975))), source)


def _felt_rows(flown: Flown, bias_m_s2: float) -> _Rows | None:
    """Return the equations of the accelerometer across the body's axis, if logged.

    The raw data are corrected by the estimator's final bias, as its bias changes while it learns.
    """
    log = flown.log
    if log is None:
        return None
    start_us, end_us = (flown.logged_us(each) for each in flown.airborne_us)
    felt = log.raw_specific_force.between(start_us, end_us)
    if len(felt) < LEAST_FELT or not len(log.raw_rates):
        return None
    velocity = log.motion.at(felt.time_us)[:, 3:]
    axes = _rotation(log.attitude.at(felt.time_us)).transpose(0, 2, 1)[:, :2]
    braked = -np.einsum("nij,nj->ni", axes, velocity)
    biases = [np.broadcast_to(each, braked.shape) for each in np.eye(2)]
    by_rate = log.raw_rates.at(felt.time_us)[:, [1, 0]] * np.array([1.0, -1.0])
    matrix = np.stack([braked, axes[:, :, 0], axes[:, :, 1], *biases, by_rate], axis=2)
    learnt = _learnt_bias(log, flown.logged_us(flown.navigation_us) + SETTLE_US, end_us)
    sigma_m_s2 = bias_m_s2 if learnt is None else LEARNT_SHARE * bias_m_s2
    across = felt.values[:, :2] - (0.0 if learnt is None else learnt[:2])
    prior = (sigma_m_s2, sigma_m_s2, BY_RATE_M_S)
    sample_s = (felt.time_us[-1] - felt.time_us[0]) / US_PER_S / (len(felt) - 1)
    # Of a first-order Gauss-Markov process.
    off = OFF_M_S**2 * 2.0 * OFF_S / sample_s
    return _Rows(matrix, across, velocity, axes, prior, off)


def _learnt_bias(log: VehicleLog, start_us: float, end_us: float) -> Array | None:
    """Return the accelerometer's bias (3,) that the estimator has learnt of a flight [m/s²]."""
    corrected = log.specific_force.between(start_us, end_us)
    if len(corrected) < LEAST_FELT:
        return None
    measured = log.raw_specific_force.at(corrected.time_us)
    return np.asarray(np.mean(measured - corrected.values, axis=0))


def _lean_rows(flown: Flown, bias_m_s2: float) -> _Rows | None:
    """Return the equations of telemetry: velocity gained in a window against lean and drag.

    In oscillating flight, a lean that is early by d looks like a drag of d w², w the angular
    frequency. So d is estimated, too.
    """
    path = flown.path.between(*flown.airborne_us)
    if len(path) < LEAST_ROWS:
        return None
    turn = _rotation(path.quaternion)
    time_s = (path.time_us - path.time_us[:1]) / US_PER_S
    lean = turn[:, :2, 2] / turn[:, 2:, 2]
    sinking = path.velocity[:, 2:]
    carried = (GRAVITY_M_S2 - _rate(sinking, time_s)) * lean
    braked = sinking * lean - path.velocity[:, :2]
    early = (path.time_us < flown.navigation_us + SETTLE_US)[:, None]
    biases = [turn[:, :2, axis] * when for when in (early, ~early) for axis in (0, 1)]
    length_s = time_s[WINDOW:] - time_s[:-WINDOW]

    def mean(values: Array) -> Array:
        steps = 0.5 * (values[1:] + values[:-1]) * np.diff(time_s)[:, None]
        sums = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
        return np.asarray((sums[WINDOW:] - sums[:-WINDOW]) / length_s[:, None])

    gained = (path.velocity[WINDOW:, :2] - path.velocity[:-WINDOW, :2]) / length_s[:, None]
    ones = np.ones(len(length_s))
    nothing = np.zeros(len(length_s))
    wind = [np.stack([ones, nothing], axis=1), np.stack([nothing, ones], axis=1)]
    skewed = [mean(_rate(carried, time_s))]
    matrix = np.stack([mean(braked), *wind, *map(mean, biases), *skewed], axis=2)
    middle = slice(WINDOW // 2, WINDOW // 2 + len(length_s))
    axes = np.zeros((len(length_s), 2, 3))
    axes[:, 0, 0] = axes[:, 1, 1] = 1.0
    axes[:, :, 2] = -lean[middle]
    settled_m_s2 = SETTLED_SHARE * bias_m_s2
    prior = (bias_m_s2, bias_m_s2, settled_m_s2, settled_m_s2, SKEW_S)
    return _Rows(matrix, gained + mean(carried), path.velocity[middle], axes, prior)


def _posterior(rows: _Rows, quadratic_1_m: float) -> tuple[Array, Array]:
    """Return mean and covariance of the parameters; rows count by their autocorrelation time."""
    held = np.concatenate([[np.inf] * _AIR, rows.prior])
    matrix = rows.matrix.reshape(-1, len(held))
    middle: Array = np.zeros(len(held))
    covariance: Array = np.eye(len(held))
    noise = 1.0
    for step in range(ITERATIONS):
        left = rows.left - _quadratic(rows, middle, quadratic_1_m)
        if step:
            error = left - rows.matrix @ middle
            slow = max(1.0, *(integrated_time(each) for each in error.T))
            noise = UNSEEN * float(np.mean(error**2)) * slow + middle[_DRAG] ** 2 * rows.off
        precision = np.diag(held**-2.0) + matrix.T @ matrix / noise
        covariance = np.asarray(np.linalg.inv(precision), np.float64)
        middle = np.asarray(covariance @ matrix.T @ left.reshape(-1) / noise, np.float64)
    return middle, covariance


def _quadratic(rows: _Rows, middle: Array, quadratic_1_m: float) -> Array:
    """Return what quadratic drag does to the rows (n, 2) in the wind found so far [m/s²]."""
    if quadratic_1_m == 0.0 or middle[_DRAG] <= 0.0:
        return np.zeros_like(rows.left)
    wind = np.array([*middle[_NORTH : _EAST + 1] / middle[_DRAG], 0.0])
    against = rows.velocity - wind
    force = -quadratic_1_m * np.linalg.norm(against, axis=1, keepdims=True) * against
    return np.asarray(np.einsum("nij,nj->ni", rows.axes, force))


def _rotation(quaternion: Array) -> Array:
    """Return the matrices (n, 3, 3), body to world, of quaternions (n, 4) [w, x, y, z]."""
    return np.asarray(Rotation.from_quat(quaternion, scalar_first=True).as_matrix())


def _rate(values: Array, time_s: NDArray[np.float64]) -> Array:
    return np.asarray(np.gradient(values, time_s, axis=0))
