"""Energy of a flight by use: hover, motion, manoeuvres and onboard computer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.flight.trajectory import Trajectory
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.vehicle.airframe import Airframe, airframe_of
from airl_mav.vehicle.power import PowerModel, level_power_w, power_model_of


@dataclass(frozen=True)
class EnergySplit:
    """Energy of a part of a flight [J]; the airframe's three parts add up to its total."""

    time_s: float
    hover_j: float
    """Energy of a hover at the mass of this flight."""
    motion_j: float
    """Energy of steady level flight in calm air at the flight's speed, minus a hover. Negative if
    moving saves power: a rotor needs less power in forward flight than in a hover."""
    manoeuvre_j: float
    """Remaining energy: acceleration, braking, climb, descent and wind."""
    computer_j: float

    @property
    def airframe_j(self) -> float:
        """Return the vehicle's energy without its computer [J]."""
        return self.hover_j + self.motion_j + self.manoeuvre_j


def split_energy(
    path: Trajectory, start_us: int, end_us: int, vehicle: VehicleProfile, computer_watts: float
) -> EnergySplit:
    """Split the energy between two simulated times [µs] by the vehicle's power model.

    The recording contains the total power, integrated at every tick, and the speed at 50 Hz. Hover
    energy is therefore exact. The additional energy of horizontal motion is integrated over the
    samples (trapezoid). Manoeuvres are the rest: a 50 Hz recording cannot resolve them.
    """
    part = path.between(start_us, end_us)
    time_s = max(0.0, (end_us - start_us) / US_PER_S)
    if len(part) < 2:
        return EnergySplit(time_s, 0.0, 0.0, 0.0, computer_watts * time_s)
    steps_s = np.diff(part.time_us) / US_PER_S
    airframe_j = float(np.sum(part.power_w[1:] * steps_s))
    speeds = np.hypot(part.velocity[:, 0], part.velocity[:, 1])
    level_w = level_powers_w(vehicle, np.append(speeds, 0.0))
    hover_w = float(level_w[-1])
    hover_j = hover_w * float(steps_s.sum())
    moving_w = level_w[:-1] - hover_w
    motion_j = float(np.sum(0.5 * (moving_w[1:] + moving_w[:-1]) * steps_s))
    return EnergySplit(
        time_s, hover_j, motion_j, airframe_j - hover_j - motion_j, computer_watts * time_s
    )


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


def add_up(splits: list[EnergySplit]) -> EnergySplit:
    """Return the sum of several flights."""
    return EnergySplit(
        *(
            sum(getattr(split, name) for split in splits)
            for name in ("time_s", "hover_j", "motion_j", "manoeuvre_j", "computer_j")
        )
    )
