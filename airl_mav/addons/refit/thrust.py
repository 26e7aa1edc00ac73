"""Thrust per mass, from motor commands and the accelerometer along the body's axis.

The accelerometer measures thrust / m minus the drag's part. Motor commands are shares of maximum
thrust, so their ratio is thrust_max / m. Means over the flight cancel rotor lag and vibration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from airl_mav.addons.refit.air import SETTLED_SHARE, Air
from airl_mav.addons.refit.flown import Flown
from airl_mav.addons.refit.quantity import Array, FittedQuantity, mean_interval
from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.flight.statistics import QUANTILE
from airl_mav.profiles.vehicle import CORNERS, VehicleProfile
from airl_mav.vehicle_log import VehicleLog

Known = Literal["thrust", "mass"]
"""Quantity that the profile has right."""

LEAST_SAMPLES = 20
WIDEST = 0.15
"""Maximum half width of an observable ratio's interval, as a share."""


@dataclass(frozen=True)
class Thrust:
    """Fitted thrust and mass."""

    ratio_m_s2: FittedQuantity
    """Maximum thrust per mass."""
    hover: FittedQuantity
    """Thrust in a hover as a share of maximum thrust."""
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
        return Thrust(found, hover.without(why), mass.without(why), rotor.without(why))
    ends = np.array([found.value, found.low, found.high])
    low_last = ends[[0, 2, 1]]
    hover = hover.found(GRAVITY_M_S2 / low_last, found.source)
    only = "only thrust per mass is observable; the {} is taken from the profile"
    if known == "thrust":
        mass = mass.found(vehicle.thrust_n / low_last, found.source)
        return Thrust(found, hover, mass, rotor.without(only.format(known)))
    rotor = rotor.found(ends * mass_kg / len(CORNERS), found.source)
    return Thrust(found, hover, mass.without(only.format(known)), rotor)


def _ratio(
    flown: Flown, vehicle: VehicleProfile, air: Air, blank: FittedQuantity, rng: np.random.Generator
) -> FittedQuantity:
    log = flown.log
    if log is None:
        return blank.without("a black box holds no motor outputs: give the vehicle's log")
    start_us, end_us = (flown.logged_us(each) for each in flown.airborne_us)
    motors = log.motors.between(start_us, end_us)
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
