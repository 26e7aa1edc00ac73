"""Thrust per mass, from motor commands and the accelerometer along the body's axis.

The accelerometer measures thrust / m less the drag's part. Motor commands are the share of maximum
thrust. So their ratio is thrust_max / m. Means over the flight cancel rotor lag and vibration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.flight.statistics import QUANTILE
from airl_mav.profiles.vehicle import CORNERS, VehicleProfile
from airl_mav.refitting.air import SETTLED_SHARE, Air
from airl_mav.refitting.flown import Flown
from airl_mav.refitting.quantity import Array, FittedQuantity, mean_interval, unobserved
from airl_mav.vehicle_log.ulog import VehicleLog

Known = Literal["thrust", "mass"]
"""Which of the two the profile is right about."""

LEAST_SAMPLES = 20
WIDEST = 0.15
"""Half width of the interval of the ratio, as a share, from which on it is not observable."""


@dataclass(frozen=True)
class Thrust:
    """What the rotors had to carry."""

    ratio_m_s2: FittedQuantity
    """Greatest thrust per mass."""
    hover: FittedQuantity
    """Thrust in a hover as a share of the greatest."""
    mass_kg: FittedQuantity
    """Take-off mass; not observable where the profile is right about the mass."""
    thrust_max_n: FittedQuantity
    """Of one rotor; not observable where the profile is right about the thrust."""


def fit_thrust(
    flown: Flown, vehicle: VehicleProfile, air: Air, known: Known, rng: np.random.Generator
) -> Thrust:
    """Fit maximum thrust per mass, and from it whichever of mass and thrust is not `known`."""
    ratio = vehicle.thrust_n / vehicle.body.mass_kg
    blank = unobserved("thrust_per_mass_m_s2", "thrust per mass", "m/s²", "", ratio)
    return thrust_of(_ratio(flown, vehicle, air, blank, rng), vehicle, known)


def thrust_of(found: FittedQuantity, vehicle: VehicleProfile, known: Known) -> Thrust:
    """Return mass and thrust of a vehicle from its maximum thrust per mass [m/s²]."""
    ratio = vehicle.thrust_n / vehicle.body.mass_kg
    values = found.value, found.low, found.high
    if found.value is None:
        why = found.unobservable
        return Thrust(
            found,
            unobserved("hover_thrust", "hover thrust, share", "1", why, GRAVITY_M_S2 / ratio),
            unobserved("mass_kg", "take-off mass", "kg", why, vehicle.body.mass_kg),
            unobserved("thrust_max_n", "thrust of a rotor", "N", why, vehicle.rotor.thrust_max_n),
        )
    numbers = np.array(values, np.float64)
    low_last = [0, 2, 1]
    hover = (GRAVITY_M_S2 / numbers)[low_last]
    mass = (vehicle.thrust_n / numbers)[low_last]
    rotor = numbers * vehicle.body.mass_kg / len(CORNERS)
    only = "only thrust per mass is observable; {} is taken from the profile"
    heard = Thrust(
        found,
        _of("hover_thrust", "hover thrust, share", "1", hover, found.source, GRAVITY_M_S2 / ratio),
        _of("mass_kg", "take-off mass", "kg", mass, found.source, vehicle.body.mass_kg),
        _of(
            *("thrust_max_n", "thrust of a rotor", "N", rotor, found.source),
            vehicle.rotor.thrust_max_n,
        ),
    )
    if known == "thrust":
        other = heard.thrust_max_n
        why = only.format("the thrust")
        held = unobserved(other.key, other.meaning, other.unit, why, other.profile)
        return Thrust(found, heard.hover, heard.mass_kg, held)
    other, why = heard.mass_kg, only.format("the mass")
    held = unobserved(other.key, other.meaning, other.unit, why, other.profile)
    return Thrust(found, heard.hover, held, heard.thrust_max_n)


def _of(
    key: str, meaning: str, unit: str, values: Array, source: str, known: float
) -> FittedQuantity:
    value, low, high = map(float, values)
    return FittedQuantity(key, meaning, unit, value, low, high, source, "", known)


def _ratio(
    flown: Flown, vehicle: VehicleProfile, air: Air, blank: FittedQuantity, rng: np.random.Generator
) -> FittedQuantity:
    log = flown.log

    def without(why: str) -> FittedQuantity:
        return unobserved(blank.key, blank.meaning, blank.unit, why, blank.profile)

    if log is None:
        return without("a black box holds no motor outputs: give the vehicle's log")
    start_us, end_us = (flown.logged_us(each) for each in flown.airborne_us)
    motors = log.motors.between(start_us, end_us)
    force = log.specific_force if len(log.specific_force) else log.raw_specific_force
    felt = force.between(start_us, end_us)
    if min(len(motors), len(felt)) < LEAST_SAMPLES:
        return without("the log holds no motor outputs or no accelerations in flight")
    share = np.mean(_shares(motors.values, log, vehicle), axis=1)
    dragged = air.along_thrust(log.motion.at(felt.time_us)[:, 3:], log.attitude.at(felt.time_us))
    carried = dragged - felt.values[:, 2]
    shared = np.interp(felt.time_us, motors.time_us, share)
    value = float(carried.mean() / shared.mean())
    # The ratio's error by its linearisation: that of the mean of what is left over.
    left = carried - value * shared
    low, high = mean_interval(left, felt.time_us / US_PER_S, rng)
    bias_m_s2 = QUANTILE * SETTLED_SHARE * vehicle.sensors.imu.accel_bias_m_s2
    low, high = -math.hypot(low, bias_m_s2), math.hypot(high, bias_m_s2)
    low, high = (value + end / float(shared.mean()) for end in (low, high))
    if 0.5 * (high - low) > WIDEST * value:
        return without(f"known to {0.5 * (high - low) / value:.0%}; {WIDEST:.0%} is needed")
    source = "motor commands and accelerometer in the vehicle's log"
    return FittedQuantity(
        blank.key, blank.meaning, blank.unit, value, low, high, source, "", blank.profile
    )


def _shares(commands: Array, log: VehicleLog, vehicle: VehicleProfile) -> Array:
    """Return motor commands (n, 4) as shares of maximum thrust.

    PX4's actuator_motors are thrusts where THR_MDL_FAC describes the motors' curve. Only its
    outputs are bent (src/lib/mixer_module/functions/FunctionMotors.hpp).
    """
    curve = 0.0 if log.parameters.get("THR_MDL_FAC") else vehicle.rotor.thrust_curve
    u = np.clip(commands, 0.0, 1.0)
    return np.asarray(curve * u * u + (1.0 - curve) * u)
