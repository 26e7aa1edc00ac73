"""Domain randomisation: what is drawn anew with every episode, around a profile's values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MAX_MM, MM_PER_M
from airl_mav.envs.spec import Randomisation
from airl_mav.vehicle.airframe import Airframe

NOISE_AT_M = 10.0
"""Depth at which the noise is as declared; stereo noise grows with the square of the depth."""


def draw_airframe(nominal: Airframe, shares: Randomisation, rng: np.random.Generator) -> Airframe:
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


def noisy_depth(
    depth_mm: NDArray[np.uint16], shares: Randomisation, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return Z16 images (..., h, w) with a stereo camera's noise and missing pixels."""
    depth = depth_mm / MM_PER_M
    sd = shares.depth_noise * depth * depth / NOISE_AT_M
    noisy = np.rint(MM_PER_M * (depth + sd * rng.standard_normal(depth.shape)))
    kept = (depth_mm > 0) & (rng.random(depth.shape) >= shares.depth_dropout)
    result: NDArray[np.uint16] = np.where(kept, np.clip(noisy, 1, MAX_MM), 0).astype(np.uint16)
    return result
