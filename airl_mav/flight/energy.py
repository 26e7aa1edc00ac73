"""Power of steady level flight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.vehicle.airframe import Airframe, airframe_of
from airl_mav.vehicle.power import PowerModel, level_power_w, power_model_of


def level_powers_w(vehicle: VehicleProfile, speeds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the powers (n,) of steady level flight in calm air at speeds (n,) [m/s]; 0: hover."""
    airframe = np.array(Airframe.from_profile(vehicle))
    return _level_powers(speeds, airframe, np.array(PowerModel.from_profile(vehicle)))


@kernel
def _level_powers(speeds: Vector, airframe: Vector, model: Vector) -> NDArray[np.float64]:
    a, m = airframe_of(airframe), power_model_of(model)
    powers = np.empty(len(speeds))
    for i in range(len(speeds)):
        powers[i] = level_power_w(speeds[i], a, m)
    return powers
