"""Drag and wind, from the acceleration across the body's axis; thrust per mass, along it.

With the drag D per mass, k = D / m, and the wind w, the air brakes a velocity v by k (v - w). The
rotors push along the body's axis only. Both fits are linear in k and k w.

The vehicle's log contains the specific force along the body's x and y axes:

    a = -k R' (v - w) + b + c (w_y, -w_x)

R' rotates from NED to the body's axes. b is the accelerometer's bias, with a normal prior. Several
headings separate the bias from the wind. w_x and w_y are the rates of roll and pitch. c covers the
airflow at rotors above the centre of mass, and the rotation during an averaged sample. (PX4's
estimator separates drag from wind in this way: EKF2_DRAG_CTRL.)

Telemetry has no accelerometer. There the lean of the vehicle gives the acceleration:

    v' = g + f z - k (v - w)

z is the body's up axis, f the thrust per mass, from the vertical part of the equation. The level
part is averaged over windows of half a second. An attitude error resembles wind at a constant
heading. It is estimated as a bias along the body's axes with a normal prior: the profile's
accelerometer bias until the vehicle has manoeuvred, and a smaller one after. The wind's interval is
therefore wide for a short flight or a small drag.

Along the axis, the accelerometer measures thrust / m minus the drag's part. Motor commands are
shares of maximum thrust, so their ratio is thrust_max / m. Means over the flight cancel rotor lag
and vibration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from airl_mav.addons.identification.flown import Array, FittedQuantity, Flown, mean_interval
from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.flight.statistics import QUANTILE
from airl_mav.latency.stages import integrated_time
from airl_mav.profiles.vehicle import CORNERS, VehicleProfile
from airl_mav.vehicle_log import VehicleLog

WINDOW = 13
"""Samples of a window: half a second of telemetry."""

SETTLE_US = 2 * US_PER_S
"""Navigation time after which an estimator separates tilt and bias [µs]."""

SETTLED_SHARE = 0.4
"""Share of the accelerometer's bias that then remains in the attitude and along the thrust."""

LEARNT_SHARE = 0.6
"""Share that remains after correction by the estimator's final value. Chosen on the first twenty
flights of benchmarks/bench_identify.py and 24 of PX4 1.16."""

BY_RATE_M_S = 0.1
"""Acceleration per rate in the accelerometer [m/s² for 1 rad/s]. A thrust of 1 g turned by a 4 ms
sample gives 0.04, drag of 0.2 1/s on rotors 10 cm up 0.02."""

OFF_M_S, OFF_S = 0.03, 4.0
"""Error of an estimator's velocity along an axis [m/s], and its correlation time [s], as estimated
by PX4 1.16 in twelve simulated flights with known truth. The accelerometer's equations attribute
this error to wind."""

SKEW_S = 0.01
"""Time skew between attitude and velocity in telemetry [s]."""

UNSEEN = 2.0
"""Variance factor for estimator errors and gusts that vary slower than a short flight. Chosen on
the first twenty flights of benchmarks/bench_identify.py."""

LEAST_ROWS = 4 * WINDOW
LEAST_FELT = 40
"""Minimum samples of the accelerometer: two seconds at PX4's default logging rate."""
DRAWS = 4000
"""Draws from the posterior distribution: wind is a ratio."""

WIDEST_DRAG, WIDEST_WIND_M_S = 0.2, 1.0
"""Maximum half widths of observable intervals, of the drag as a share."""

ITERATIONS = 4
"""Iterations for the noise of the rows, and for quadratic drag, which depends on the wind."""

_DRAG, _NORTH, _EAST = 0, 1, 2
_AIR = 3
"""Number of air parameters: k, k w north, k w east; biases follow."""


DRAG = FittedQuantity("drag_1_s", "drag per mass", "1/s")
WIND = (
    FittedQuantity("wind_north_m_s", "wind towards north", "m/s"),
    FittedQuantity("wind_east_m_s", "wind towards east", "m/s"),
)


@dataclass(frozen=True)
class Air:
    """Fitted drag and wind."""

    drag_1_s: FittedQuantity
    wind_north_m_s: FittedQuantity
    wind_east_m_s: FittedQuantity
    quadratic_1_m: float
    """Quadratic drag per mass, from the profile."""

    @property
    def wind(self) -> tuple[float, float] | None:
        """Steady wind towards north, east [m/s]; None: not observable."""
        north, east = self.wind_north_m_s.value, self.wind_east_m_s.value
        return None if north is None or east is None else (north, east)

    def along_thrust(self, velocity: Array, quaternion: Array) -> Array:
        """Return drag per mass along body down (n,) [m/s²], for NED velocities and attitudes."""
        north, east = self.wind or (0.0, 0.0)
        against = velocity - np.array([north, east, 0.0])
        linear = self.drag_1_s.value or 0.0
        speed = np.linalg.norm(against, axis=1, keepdims=True)
        force = -(linear + self.quadratic_1_m * speed) * against
        down = _rotation(quaternion)[:, :, 2]
        return np.asarray(np.sum(force * down, axis=1))


@dataclass(frozen=True)
class _Rows:
    """Equations of accelerations: left = matrix @ parameters."""

    matrix: Array
    """(n, 2, 3 + others)."""
    left: Array
    """(n, 2) [m/s²]."""
    velocity: Array
    """(n, 3) NED [m/s], for quadratic drag."""
    axes: Array
    """(n, 2, 3) projection of a NED force into the two equations."""
    prior: tuple[float, ...]
    """Standard deviations of the other parameters: biases [m/s²]; rate effect [m/s], or the lead
    time of the lean [s]."""
    off: float = 0.0
    """Weight of slow velocity errors as noise of single samples [m²/s²]."""


def fit_air(flown: Flown, vehicle: VehicleProfile, rng: np.random.Generator) -> Air:
    """Fit drag and wind; the profile provides accelerometer and quadratic drag."""
    mass_kg = vehicle.body.mass_kg
    quadratic_1_m = vehicle.drag.quadratic_n_s2_m2 / mass_kg
    known = vehicle.drag.linear_n_s_m / mass_kg
    bias_m_s2 = vehicle.sensors.imu.accel_bias_m_s2
    source = "accelerometer, velocity and attitude in the vehicle's log"
    # The accelerometer is preferred: it measures drag directly, without the derivative of a
    # velocity.
    rows = _felt_rows(flown, bias_m_s2)
    if rows is None:
        source = f"lean and acceleration in {flown.told_by}"
        rows = _lean_rows(flown, bias_m_s2)
    if rows is None:
        return _nothing("the flight is too short", known, quadratic_1_m)
    middle, covariance = _posterior(rows, quadratic_1_m)
    # Wind is a ratio of two normal variables, without a closed form of its quantiles.
    drawn = rng.multivariate_normal(middle[:_AIR], covariance[:_AIR, :_AIR], DRAWS)
    drag = _estimate(replace(DRAG, profile=known), middle[_DRAG], drawn[:, _DRAG], source)
    half = drag.half_width or 0.0
    # An uncertain drag makes the wind meaningless: it is divided by the drag.
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

    The raw data are corrected by the estimator's final bias, because the bias changes during
    learning.
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
    # Drag is proportional to the velocity in body axes.
    braked = -np.einsum("nij,nj->ni", axes, velocity)
    biases = [np.broadcast_to(each, braked.shape) for each in np.eye(2)]
    # Pitch rate acts forward, roll rate to the left.
    by_rate = log.raw_rates.at(felt.time_us)[:, [1, 0]] * np.array([1.0, -1.0])
    matrix = np.stack([braked, axes[:, :, 0], axes[:, :, 1], *biases, by_rate], axis=2)
    learnt = _learnt_bias(log, flown.logged_us(flown.navigation_us) + SETTLE_US, end_us)
    # Without a learnt bias the whole bias of the profile remains possible.
    sigma_m_s2 = bias_m_s2 if learnt is None else LEARNT_SHARE * bias_m_s2
    across = felt.values[:, :2] - (0.0 if learnt is None else learnt[:2])
    prior = (sigma_m_s2, sigma_m_s2, BY_RATE_M_S)
    sample_s = (felt.time_us[-1] - felt.time_us[0]) / US_PER_S / (len(felt) - 1)
    # Of a first-order Gauss-Markov process.
    off = OFF_M_S**2 * 2.0 * OFF_S / sample_s
    return _Rows(matrix, across, velocity, axes, prior, off)


def _learnt_bias(log: VehicleLog, start_us: float, end_us: float) -> Array | None:
    """Return the accelerometer's bias (3,) learnt by the estimator in a flight [m/s²]."""
    corrected = log.specific_force.between(start_us, end_us)
    if len(corrected) < LEAST_FELT:
        return None
    measured = log.raw_specific_force.at(corrected.time_us)
    return np.asarray(np.mean(measured - corrected.values, axis=0))


def _lean_rows(flown: Flown, bias_m_s2: float) -> _Rows | None:
    """Return the equations of telemetry: velocity gained in a window against lean and drag.

    In oscillating flight, a lean that is early by d looks like a drag of d w², w the angular
    frequency. Therefore d is also estimated.
    """
    path = flown.path.between(*flown.airborne_us)
    if len(path) < LEAST_ROWS:
        return None
    turn = _rotation(path.quaternion)
    time_s = (path.time_us - path.time_us[:1]) / US_PER_S
    # Horizontal thrust as a share of vertical thrust.
    lean = turn[:, :2, 2] / turn[:, 2:, 2]
    sinking = path.velocity[:, 2:]
    carried = (GRAVITY_M_S2 - _rate(sinking, time_s)) * lean
    braked = sinking * lean - path.velocity[:, :2]
    # Two biases: the estimator's error shrinks during the first seconds.
    early = (path.time_us < flown.navigation_us + SETTLE_US)[:, None]
    biases = [turn[:, :2, axis] * when for when in (early, ~early) for axis in (0, 1)]
    length_s = time_s[WINDOW:] - time_s[:-WINDOW]

    def mean(values: Array) -> Array:
        # Trapezoidal rule, as telemetry is not evenly spaced.
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
    # No prior for drag and wind: the flight alone determines them.
    held = np.concatenate([[np.inf] * _AIR, rows.prior])
    matrix = rows.matrix.reshape(-1, len(held))
    middle: Array = np.zeros(len(held))
    covariance: Array = np.eye(len(held))
    noise = 1.0
    # Noise and quadratic drag depend on the fit, which depends on them: a few rounds settle both.
    for step in range(ITERATIONS):
        left = rows.left - _quadratic(rows, middle, quadratic_1_m)
        if step:
            error = left - rows.matrix @ middle
            # Correlated rows carry less information than their number.
            slow = max(1.0, *(integrated_time(each) for each in error.T))
            noise = UNSEEN * float(np.mean(error**2)) * slow + middle[_DRAG] ** 2 * rows.off
        precision = np.diag(held**-2.0) + matrix.T @ matrix / noise
        covariance = np.asarray(np.linalg.inv(precision), np.float64)
        middle = np.asarray(covariance @ matrix.T @ left.reshape(-1) / noise, np.float64)
    return middle, covariance


def _quadratic(rows: _Rows, middle: Array, quadratic_1_m: float) -> Array:
    """Return the effect of quadratic drag on the rows (n, 2) in the current wind [m/s²]."""
    # Without drag the wind is undefined.
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


Known = Literal["thrust", "mass"]
"""Quantity that the profile has right."""

LEAST_SAMPLES = 20
WIDEST = 0.15
"""Maximum half width of an observable ratio's interval, as a share."""


@dataclass(frozen=True)
class Thrust:
    """Fitted thrust and mass."""

    hover: FittedQuantity
    """Thrust in a hover as a share of maximum thrust."""
    ratio_m_s2: FittedQuantity
    """Maximum thrust per mass."""
    mass_kg: FittedQuantity
    """Take-off mass; not observable if the profile's mass is taken as known."""
    thrust_max_n: FittedQuantity
    """Maximum thrust of one rotor; not observable if the profile's thrust is taken as known."""


def fit_thrust(
    flown: Flown, vehicle: VehicleProfile, air: Air, known: Known, rng: np.random.Generator
) -> Thrust:
    """Fit maximum thrust per mass, and from it the quantity other than `known`."""
    ratio = vehicle.thrust_n / vehicle.body.mass_kg
    blank = FittedQuantity("thrust_per_mass_m_s2", "thrust per mass", "m/s²", profile=ratio)
    return thrust_of(_ratio(flown, vehicle, air, blank, rng), vehicle, known)


def thrust_of(found: FittedQuantity, vehicle: VehicleProfile, known: Known) -> Thrust:
    """Return mass and thrust of a vehicle from its maximum thrust per mass [m/s²]."""
    mass_kg, rotor_n = vehicle.body.mass_kg, vehicle.rotor.thrust_max_n
    share = GRAVITY_M_S2 / (vehicle.thrust_n / mass_kg)
    hover = FittedQuantity("hover_thrust", "hover thrust, share", "1", profile=share)
    mass = FittedQuantity("mass_kg", "take-off mass", "kg", profile=mass_kg)
    rotor = FittedQuantity("thrust_max_n", "thrust of a rotor", "N", profile=rotor_n)
    if found.value is None or found.low is None or found.high is None:
        why = found.unobservable
        return Thrust(hover.without(why), found, mass.without(why), rotor.without(why))
    ends = np.array([found.value, found.low, found.high])
    # Inverse quantities: the upper end of the ratio is their lower end.
    low_last = ends[[0, 2, 1]]
    hover = hover.found(GRAVITY_M_S2 / low_last, found.source)
    only = "only thrust per mass is observable; the {} is taken from the profile"
    if known == "thrust":
        mass = mass.found(vehicle.thrust_n / low_last, found.source)
        return Thrust(hover, found, mass, rotor.without(only.format(known)))
    rotor = rotor.found(ends * mass_kg / len(CORNERS), found.source)
    return Thrust(hover, found, mass.without(only.format(known)), rotor)


def _ratio(
    flown: Flown, vehicle: VehicleProfile, air: Air, blank: FittedQuantity, rng: np.random.Generator
) -> FittedQuantity:
    log = flown.log
    if log is None:
        return blank.without("a black box holds no motor outputs: give the vehicle's log")
    start_us, end_us = (flown.logged_us(each) for each in flown.airborne_us)
    motors = log.motors.between(start_us, end_us)
    # Corrected by the estimator's bias if logged.
    force = log.specific_force if len(log.specific_force) else log.raw_specific_force
    felt = force.between(start_us, end_us)
    if min(len(motors), len(felt)) < LEAST_SAMPLES:
        return blank.without("the log holds no motor outputs or no accelerations in flight")
    share = np.mean(_shares(motors.values, log, vehicle), axis=1)
    dragged = air.along_thrust(log.motion.at(felt.time_us)[:, 3:], log.attitude.at(felt.time_us))
    carried = dragged - felt.values[:, 2]
    shared = np.interp(felt.time_us, motors.time_us, share)
    value = float(carried.mean() / shared.mean())
    # Error of the ratio, linearised: the error of the mean residual.
    left = carried - value * shared
    low, high = mean_interval(left, felt.time_us / US_PER_S, rng)
    # Independent of the sampling error, so both add as squares.
    bias_m_s2 = QUANTILE * SETTLED_SHARE * vehicle.sensors.imu.accel_bias_m_s2
    low, high = -math.hypot(low, bias_m_s2), math.hypot(high, bias_m_s2)
    low, high = (value + end / float(shared.mean()) for end in (low, high))
    if 0.5 * (high - low) > WIDEST * value:
        return blank.without(f"known to {0.5 * (high - low) / value:.0%}; {WIDEST:.0%} is needed")
    source = "motor commands and accelerometer in the vehicle's log"
    return blank.found((value, low, high), source)


def _shares(commands: Array, log: VehicleLog, vehicle: VehicleProfile) -> Array:
    """Return motor commands (n, 4) as shares of maximum thrust.

    PX4's actuator_motors are thrusts if THR_MDL_FAC describes the motors' curve. Only its outputs
    are curved (src/lib/mixer_module/functions/FunctionMotors.hpp).
    """
    curve = 0.0 if log.parameters.get("THR_MDL_FAC") else vehicle.rotor.thrust_curve
    u = np.clip(commands, 0.0, 1.0)
    return np.asarray(curve * u * u + (1.0 - curve) * u)
