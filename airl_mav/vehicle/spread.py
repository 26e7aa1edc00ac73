"""Aircraft that are not quite as their profile says."""

from __future__ import annotations

import numpy as np

from airl_mav.profiles.conditions import Spread
from airl_mav.vehicle.airframe import Airframe


def spreads(shares: Spread) -> bool:
    """Return whether any airframe differs from the nominal one."""
    return any((shares.mass, shares.thrust, shares.drag, shares.rotor_lag))


def draw_airframe(nominal: Airframe, shares: Spread, rng: np.random.Generator) -> Airframe:
    """Return an airframe of one episode; every quantity uniform within its share."""
    mass, thrust, drag, lag = (
        1.0 + share * rng.uniform(-1.0, 1.0)
        for share in (shares.mass, shares.thrust, shares.drag, shares.rotor_lag)
    )
    return nominal._replace(
        mass=nominal.mass * mass,
        inertia_xx=nominal.inertia_xx * mass,
        inertia_yy=nominal.inertia_yy * mass,
        inertia_zz=nominal.inertia_zz * mass,
        thrust_max=nominal.thrust_max * thrust,
        drag_linear=nominal.drag_linear * drag,
        drag_quadratic=nominal.drag_quadratic * drag,
        drag_angular=nominal.drag_angular * drag,
        rotor_time_constant=nominal.rotor_time_constant * lag,
    )
