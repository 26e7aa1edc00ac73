"""Fit of a vehicle's response to setpoints: dead time, time constants of velocity and yaw rate.

The model of `airl_mav.prediction`, driven by the sent setpoints and the flown heading.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares
from scipy.signal import lfilter

from airl_mav.addons.identification.flown import (
    Array,
    FittedQuantity,
    Flown,
    block_intervals,
    seconds,
)
from airl_mav.core import constants, frames
from airl_mav.flight.statistics import QUANTILE
from airl_mav.profiles.vehicle import Response

STEP_S = 0.004
"""Time step of the model [s], equal to the flight controller's."""

TELEMETRY_AGE_S = 0.010
"""Mean age of the newest telemetry, received 50 times a second [s]; the maximum is twice this."""

DEAD_TIMES_S = (0.05, 0.15, 0.3)
"""Initial values of the searches: the cost has several local minima [s]."""

LEAST_CHANGE_M_S, LEAST_CHANGE_RAD_S = 1.0, 0.2
"""Minimum RMS change between setpoints; below, noise hides the response."""

DIFFERENCES = (0.02, 0.02, 0.02)
"""Relative steps of the numerical derivatives: the model is piecewise linear in the dead time."""

TIMES = {
    "dead_time_s": "dead time",
    "velocity_time_s": "velocity's time constant",
    "yaw_rate_time_s": "yaw rate's time constant",
}

LEAST_DECISIONS = 8
WIDEST_S, WIDEST_SHARE = 0.05, 0.4
"""Maximum half width of an observable dead time [s], and of a time constant as a share."""


@dataclass(frozen=True)
class ResponseFit:
    """Response parameters of a vehicle."""

    dead_time_s: FittedQuantity
    velocity_time_s: FittedQuantity
    yaw_rate_time_s: FittedQuantity

    def response(self, drag_1_s: float, known: Response | None) -> Response | None:
        """Return the table for a profile, unobserved values from `known`; None if unknown."""
        found = {name: getattr(self, name).value for name in TIMES}
        held = {} if known is None else known.model_dump()
        merged = {name: held.get(name) if value is None else value for name, value in found.items()}
        if any(value is None for value in merged.values()):
            return None
        turn_dead_s = held.get("yaw_rate_dead_time_s", merged["dead_time_s"])
        rest = {"yaw_rate_dead_time_s": turn_dead_s, "drag_1_s": drag_1_s}
        return Response.model_validate(merged | rest)


@dataclass(frozen=True)
class _Driven:
    """Inputs and reference data of the model."""

    grid_s: Array
    """(m,) steps of the model [s]."""
    commands: Array
    """(m, 4) newest sent setpoint, as in `Flown`."""
    heading: Array
    """(m,) flown heading [rad], unwrapped."""
    times_s: Array
    """(n,) sample times [s]."""
    velocity: Array
    """(n, 2) north, east [m/s]."""
    turned: Array
    """(n,) heading [rad], unwrapped."""
    begun_m_s: tuple[float, float]


def fit_response(flown: Flown, known: Response | None, rng: np.random.Generator) -> ResponseFit:
    """Fit the response of a flight's vehicle; without its log the dead time includes the link."""
    held = {} if known is None else known.model_dump()
    dead, lag, turn = (
        FittedQuantity(key, meaning, "s", profile=held.get(key)) for key, meaning in TIMES.items()
    )
    if (why := _too_little(flown)) is not None:
        return ResponseFit(dead.without(why), lag.without(why), turn.without(why))
    driven = _driven(flown)
    return ResponseFit(
        *_velocity(driven, flown, (dead, lag), rng), _yaw_rate(driven, flown, turn, rng)
    )


def _too_little(flown: Flown) -> str | None:
    if flown.is_logged_only and not len(flown.sent_us):
        return "the log holds no flight by velocity setpoints in Offboard"
    if len(flown.sent_us) < LEAST_DECISIONS:
        return f"{len(flown.sent_us)} decisions; {LEAST_DECISIONS} are needed"
    rms = _rms(_changes(flown)[:, :2])
    if rms < LEAST_CHANGE_M_S:
        return f"setpoints change by {rms:.2f} m/s; {LEAST_CHANGE_M_S:g} are needed"
    return None


def _changes(flown: Flown) -> Array:
    """Return the steps of the setpoints (n, 4): from the previous decision, or a log's mean."""
    if flown.is_logged_only:
        return np.asarray(flown.setpoints - flown.setpoints.mean(axis=0))
    return np.diff(flown.setpoints, axis=0)


def _rms(vectors: Array) -> float:
    """Return the root mean square length of vectors (n, k)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _driven(flown: Flown) -> _Driven:
    path, from_us = flown.path, flown.navigation_us
    inside = (path.time_us >= from_us - constants.US_PER_S // 2) & (path.time_us <= flown.ended_us)
    times_s = seconds(path.time_us[inside], from_us)
    heading = np.unwrap(frames.quats_to_euler(path.quaternion[inside])[2])
    velocity = path.velocity[inside, :2]
    grid_s = np.arange(min(times_s[0], 0.0), times_s[-1], STEP_S)
    newest = np.searchsorted(seconds(flown.sent_us, from_us), grid_s, side="right") - 1
    sent = np.where(newest[:, None] >= 0, flown.setpoints[np.maximum(newest, 0)], 0.0)
    navigated = times_s >= 0.0
    return _Driven(
        grid_s,
        sent,
        np.interp(grid_s, times_s, heading),
        times_s[navigated],
        velocity[navigated],
        heading[navigated],
        (float(velocity[0, 0]), float(velocity[0, 1])),
    )


def _velocity(
    driven: _Driven,
    flown: Flown,
    known: tuple[FittedQuantity, FittedQuantity],
    rng: np.random.Generator,
) -> tuple[FittedQuantity, FittedQuantity]:
    """Fit dead time and time constant to the velocities north and east together.

    A companion's setpoints are in the heading frame, so the heading's time, their arrival, is a
    third parameter. Logged setpoints are in the world frame.
    """
    grid = driven.grid_s

    def residuals(of: Array) -> Array:
        dead_s, lag_s, turned_s = of
        forward, right = (np.interp(grid - dead_s, grid, driven.commands[:, k]) for k in (0, 1))
        wanted = forward + 1j * right
        if not flown.is_logged_only:
            wanted = wanted * np.exp(1j * np.interp(grid - turned_s, grid, driven.heading))
        model = _lagged(wanted, lag_s, complex(*driven.begun_m_s))
        at = (
            np.interp(driven.times_s, grid, model.real),
            np.interp(driven.times_s, grid, model.imag),
        )
        return np.concatenate([at[0] - driven.velocity[:, 0], at[1] - driven.velocity[:, 1]])

    starts = [(dead_s, 0.4, dead_s) for dead_s in DEAD_TIMES_S]
    found = _best(residuals, starts, high=(2.0, 5.0, 0.6))
    ends = block_intervals(found.jac, found.fun, np.tile(driven.times_s, 2), rng)
    dead, lag = known
    shift_s, unsure_s, source = _link_share(flown)
    low_s, high_s = (math.hypot(end, unsure_s) for end in ends[:, 0])
    value = float(found.x[0]) - shift_s
    dead = dead.found((value, value - low_s, value + high_s), source)
    lag = _time_constant(lag, found, ends, f"velocity in {flown.told_by}")
    return _known_to(dead, WIDEST_S), lag


def _link_share(flown: Flown) -> tuple[float, float, str]:
    """Return the round trip's part outside the vehicle [s], 95 % interval and source."""
    if flown.is_logged_only:
        # A change appears in the next sample: half a sample period later on average.
        step_s = float(np.median(np.diff(flown.sent_us))) / constants.US_PER_S
        changed = int(np.count_nonzero(np.any(np.diff(flown.setpoints, axis=0), axis=1)))
        unsure_s = QUANTILE * step_s / math.sqrt(12.0 * max(changed, 1))
        return (
            -0.5 * step_s,
            unsure_s,
            "setpoints and velocity in the vehicle's log"
            f" (a setpoint is logged every {1e3 * step_s:.0f} ms, half of it is added)",
        )
    clocks = flown.clocks
    if clocks is not None and clocks.accepted_range_us is not None:
        low_us, high_us = clocks.accepted_range_us
        round_trip_us = clocks.round_trip_us or 0.0
        return (
            round_trip_us / constants.US_PER_S,
            0.5 * (high_us - low_us) / constants.US_PER_S,
            "setpoints sent and velocity in telemetry, by the flight controller's clock"
            f" ({round_trip_us / constants.US_PER_MS:.0f} ms of link and telemetry taken off)",
        )
    return (
        TELEMETRY_AGE_S,
        TELEMETRY_AGE_S,
        "setpoints sent and velocity in telemetry; the link's time is in it"
        f" (taken off: {1e3 * TELEMETRY_AGE_S:.0f} ms, the mean age of telemetry)",
    )


def _yaw_rate(
    driven: _Driven, flown: Flown, known: FittedQuantity, rng: np.random.Generator
) -> FittedQuantity:
    """Fit the time constant of the yaw rate to the heading, with a separate dead time."""
    rms = _rms(_changes(flown)[:, 3:])
    if rms < LEAST_CHANGE_RAD_S:
        why = f"yaw rates change by {rms:.2f} rad/s; {LEAST_CHANGE_RAD_S:g} are needed"
        return known.without(why)
    grid = driven.grid_s

    def residuals(of: Array) -> Array:
        dead_s, lag_s, offset = of
        wanted = np.interp(grid - dead_s, grid, driven.commands[:, 3])
        heading = np.cumsum(_lagged(wanted, lag_s, 0.0).real) * STEP_S
        return np.asarray(np.interp(driven.times_s, grid, heading) - driven.turned + offset)

    starts = [(dead_s, 0.1, float(driven.turned[0])) for dead_s in DEAD_TIMES_S]
    found = _best(residuals, starts, high=(2.0, 5.0, math.inf), free=2)
    ends = block_intervals(found.jac, found.fun, driven.times_s, rng)
    return _time_constant(known, found, ends, f"heading in {flown.told_by}")


def _lagged(wanted: NDArray[np.complex128] | Array, lag_s: float, begun: complex) -> Array:
    """Return the first-order response to a setpoint (m,) with a time constant [s], from `begun`."""
    left = math.exp(-STEP_S / lag_s)
    start = np.array([begun], np.complex128)
    return np.asarray(lfilter([0.0, 1.0 - left], [1.0, -left], wanted + 0j, zi=start)[0])


def _best(
    residuals: Callable[[Array], Array],
    starts: list[tuple[float, float, float]],
    high: tuple[float, float, float],
    free: int = 3,
) -> OptimizeResult:
    """Return the best of several least-squares starts; the first `free` parameters are positive."""
    low = [0.0, 0.01, 0.0]
    low[free:] = [-math.inf] * (3 - free)
    found = [
        least_squares(
            residuals, start, bounds=(low, high), diff_step=DIFFERENCES, x_scale=(0.1, 0.2, 0.1)
        )
        for start in starts
    ]
    return min(found, key=lambda each: float(each.cost))


def _time_constant(
    known: FittedQuantity, found: OptimizeResult, ends: Array, source: str
) -> FittedQuantity:
    """Return the second parameter of a solution with its interval."""
    value = float(found.x[1])
    fitted = known.found((value, value + ends[0, 1], value + ends[1, 1]), source)
    return _known_to(fitted, max(WIDEST_S, WIDEST_SHARE * value))


def _known_to(estimate: FittedQuantity, widest: float) -> FittedQuantity:
    """Return an estimate, marked as not observable if its interval is too wide."""
    half = estimate.half_width
    if half is not None and half <= widest:
        return estimate
    known = "not at all" if half is None or not math.isfinite(half) else f"to {half:.3f} s"
    why = f"known {known}; {widest:.3f} s or better is needed"
    return replace(estimate, value=None, low=None, high=None, unobservable=why)
