"""Where a flight's energy went: staying up, moving, manoeuvring, and the onboard computer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from airl_mav.core.constants import US_PER_S
from airl_mav.flight.trajectory import Trajectory
from airl_mav.profiles.vehicle import Power


@dataclass(frozen=True)
class EnergySplit:
    """The energy of a part of a flight [J]; the airframe's three parts add up to all of it."""

    time_s: float
    hover_j: float
    """Staying up: the power model's constant and its payload term."""
    motion_j: float
    """What the speed adds, horizontal and vertical. Below 0 where moving saves power: a rotor in
    forward flight needs less than one in a hover."""
    manoeuvre_j: float
    """All the rest: accelerating and braking, the wind, and what keeps the power above 0."""
    computer_j: float

    @property
    def airframe_j(self) -> float:
        """Return the vehicle's energy without its computer [J]."""
        return self.hover_j + self.motion_j + self.manoeuvre_j


def split_energy(
    path: Trajectory, start_us: int, end_us: int, power: Power, computer_watts: float
) -> EnergySplit:
    """Split the energy between two simulated times after the terms of the vehicle's power model.

    The recording holds the whole power, integrated at every tick, and the speed at 50 Hz. So the
    constant terms are exact, those of the speed are integrated over the samples (trapezoid), and
    those of the acceleration are what is left: a 50 Hz recording cannot give them by itself.

    Args:
        path: The flight.
        start_us: Start [µs].
        end_us: End [µs].
        power: The vehicle's power model.
        computer_watts: Power of the onboard computer [W].
    """
    part = path.between(start_us, end_us)
    time_s = max(0.0, (end_us - start_us) / US_PER_S)
    if len(part) < 2:
        return EnergySplit(time_s, 0.0, 0.0, 0.0, computer_watts * time_s)
    steps_s = np.diff(part.time_us) / US_PER_S
    airframe_j = float(np.sum(part.power_w[1:] * steps_s))
    hover_w = power.b9_hover + power.b7_payload * power.payload_g
    hover_j = hover_w * float(steps_s.sum())
    level = np.hypot(part.velocity[:, 0], part.velocity[:, 1])
    moving_w = power.b1_vxy * level + power.b4_vz * np.abs(part.velocity[:, 2])
    motion_j = float(np.sum(0.5 * (moving_w[1:] + moving_w[:-1]) * steps_s))
    return EnergySplit(
        time_s, hover_j, motion_j, airframe_j - hover_j - motion_j, computer_watts * time_s
    )


def add_up(splits: list[EnergySplit]) -> EnergySplit:
    """Return the sum of several flights."""
    return EnergySplit(
        *(
            sum(getattr(split, name) for split in splits)
            for name in ("time_s", "hover_j", "motion_j", "manoeuvre_j", "computer_j")
        )
    )
