"""Airframe constants as one typed row for kernels, and their domain randomization."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.conditions import Spread
from airl_mav.profiles.vehicle import VehicleProfile


class Airframe(NamedTuple):
    """Constants of body, rotors and drag; SI. Fields as in `profiles.vehicle`."""

    mass: float
    inertia_xx: float
    inertia_yy: float
    inertia_zz: float
    arm_forward: float
    arm_right: float
    thrust_max: float
    torque_per_thrust: float
    rotor_time_constant: float
    thrust_curve: float
    drag_linear: float
    drag_quadratic: float
    drag_angular: float
    com_forward: float
    com_right: float

    @classmethod
    def from_profile(cls, profile: VehicleProfile) -> Airframe:
        """Collect the constants of a vehicle profile."""
        body, rotor, drag = profile.body, profile.rotor, profile.drag
        return cls(
            body.mass_kg,
            body.inertia_xx_kg_m2,
            body.inertia_yy_kg_m2,
            body.inertia_zz_kg_m2,
            rotor.arm_forward_m,
            rotor.arm_right_m,
            rotor.thrust_max_n,
            rotor.torque_per_thrust_m,
            rotor.time_constant_s,
            rotor.thrust_curve,
            drag.linear_n_s_m,
            drag.quadratic_n_s2_m2,
            drag.angular_n_m_s,
            body.com_forward_m,
            body.com_right_m,
        )


@kernel
def airframe_of(row: Vector) -> Airframe:
    """Return the airframe of a row (15,): kernels accept an array far faster than a tuple."""
    r = row
    return Airframe(
        r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7],
        r[8], r[9], r[10], r[11], r[12], r[13], r[14],
    )  # fmt: skip


def spreads(shares: Spread) -> bool:
    """Return True if any airframe differs from the nominal one."""
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
