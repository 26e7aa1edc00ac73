"""Broad phase: distance from the vehicle to all solids."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.arena.ground import TOP
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import Body
from firmware_sim.engine.kinematics import quaternion
from firmware_sim.plant.contacts.box import reach_along
from firmware_sim.plant.solids import Solids, greatest_speed, place_at, room_among, solids_of


class Room:
    """Distances from a vehicle's collision box to the bodies of an arena."""

    def __init__(self, arena: Arena | None, body: Body) -> None:
        """Store the solids of an arena (None = an endless floor) and the collision box."""
        self._solids, _ = solids_of(arena)
        relief = self._solids.relief
        self._top_m = float(relief.grid[TOP]) if len(relief.heights) else 0.0
        """Height of the highest hill [m]."""
        self._half = 0.5 * np.array([body.width_m, body.width_m, body.height_m])
        self.reach_m = math.hypot(*self._half.tolist())
        """Distance from the centre of the box to its corners [m]."""
        self.closing_m_s = greatest_speed(self._solids)
        """Maximum speed of an obstacle [m/s]."""

    def above_floor_m(self, motion: Vector) -> float:
        """Return the height of the box's lowest corner above floor and hills [m]; motion (16,)."""
        lowest_m: float = _lowest(motion, self._half)
        return lowest_m - self._top_m

    def among_solids_m(self, motion: Vector, moving_us: int) -> float:
        """Return a lower bound of the distance to walls and obstacles [m].

        Args:
            motion: (16,) motion of the vehicle.
            moving_us: Time since the moving obstacles started [µs].
        """
        room: float = _among_solids(self._solids, motion, self.reach_m, moving_us)
        return room


@kernel
def _lowest(motion: Vector, half: Vector) -> float:
    lowest_m: float = -motion[2] - reach_along(quaternion(motion), half, (0.0, 0.0, 1.0))
    return lowest_m


@kernel
def _among_solids(solids: Solids, motion: Vector, radius: float, moving_us: int) -> float:
    n, moving = len(solids.shape), len(solids.leg)
    for i in range(moving):
        north, east = place_at(moving_us, solids.times_s, solids.points, solids.leg, i)
        solids.center[n - moving + i, 0] = north
        solids.center[n - moving + i, 1] = east
    return room_among(solids, (motion[0], motion[1], motion[2]), radius)
