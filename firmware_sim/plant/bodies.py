"""Factory of vehicle bodies by name."""

from __future__ import annotations

from airl_mav.arena.geometry import Arena
from airl_mav.profiles.vehicle import Body as BodyProfile
from airl_mav.scenario.aircraft import PlantName
from airl_mav.vehicle.airframe import Airframe
from firmware_sim.plant.body import Body


def new_body(
    name: PlantName, arena: Arena | None, body: BodyProfile, airframe: Airframe, tick_s: float
) -> Body:
    """Return a vehicle's body at rest on the floor at the start, facing north.

    Args:
        name: Type of body.
        arena: Arena; None = an endless floor.
        body: Collision box.
        airframe: Mass and inertia.
        tick_s: Length of a tick [s].
    """
    # Local imports: pybullet is not available everywhere, and numba compiles on import.
    if name == "kernel":
        from firmware_sim.plant.kernel_body import KernelBody

        return KernelBody(arena, body, airframe, tick_s)
    from firmware_sim.plant.bullet_body import BulletBody

    return BulletBody(arena, body, airframe, tick_s)
