"""Broad phase: how far the vehicle is from everything that it can touch."""

from __future__ import annotations

from airl_mav.arena.geometry import Arena
from airl_mav.arena.ground import TOP
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from firmware_sim.plant.solids import Solids, greatest_speed, room_among, solids_of
from firmware_sim.plant.tours import place_at


class Room:
    """Bodies of an arena, for distances to a sphere around the vehicle."""

    def __init__(self, arena: Arena | None, radius_m: float) -> None:
        """Take an arena, None = an endless floor, and the radius of the sphere [m]."""
        self._solids, _ = solids_of(arena)
        self._radius_m = radius_m
        self.closing_m_s = greatest_speed(self._solids)
        """Greatest speed of an obstacle [m/s]."""

    def measure(self, motion: Vector, moving_us: int) -> float:
        """Return a distance that nothing is nearer than [m].

        Args:
            motion: (16,) of the vehicle.
            moving_us: How long what moves has been under way [µs].
        """
        solids = self._solids
        top_m = solids.relief.grid[TOP] if len(solids.relief.heights) else 0.0
        above_m = -motion[2] - self._radius_m - top_m
        return min(self.measure_solids(motion, moving_us), float(above_m))

    def measure_solids(self, motion: Vector, moving_us: int) -> float:
        """Return a distance that no wall and no obstacle is nearer than [m]; as `measure`."""
        room: float = _measure(self._solids, motion, self._radius_m, moving_us)
        return room


@kernel
def _measure(solids: Solids, motion: Vector, radius: float, moving_us: int) -> float:
    n, moving = len(solids.shape), len(solids.leg)
    for i in range(moving):
        north, east = place_at(moving_us, solids.times_s, solids.points, solids.leg, i)
        solids.center[n - moving + i, 0] = north
        solids.center[n - moving + i, 1] = east
    return room_among(solids, (motion[0], motion[1], motion[2]), radius)
