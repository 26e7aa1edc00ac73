"""Moving obstacles: their positions, and their pybullet bodies near the vehicle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena, Shape
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from firmware_sim.plant.bullet import pybullet
from firmware_sim.plant.tours import place_at, tour_arrays

MARGIN_M = 0.5
"""Bodies are updated within this distance beyond contact. pybullet detects contacts before it moves
the vehicle, and 2 cm around it: nearly all of this is a margin."""

Xyzw = tuple[float, float, float, float]
"""pybullet's quaternion."""


@kernel
def _due(
    time_us: int,
    vehicle: Vector,
    times_s: Vector,
    points: Vector,
    leg: NDArray[np.int64],
    reach: Vector,
    place: Vector,
    due: NDArray[np.int64],
) -> int:
    """Find the movers that could touch the vehicle, or whose bodies stand where they could.

    Args:
        time_us: Since the start of the episode [µs].
        vehicle: (>= 2,) north, east [m].
        times_s: (n, 1 + k) period of the tour; then when its way-points are passed [s].
        points: (n, k, 2) way-points north, east [m].
        leg: (n,) the way-point passed last; updated.
        reach: (n,) what could touch is nearer than this, seen from above [m].
        place: (n, 2) north, east of the bodies [m]; updated for those that are due.
        due: (n,) overwritten with the numbers of those that are due.

    Returns:
        How many are due.
    """
    count = 0
    for i in range(len(leg)):
        north, east = place_at(time_us, times_s, points, leg, i)
        north_off, east_off = north - vehicle[0], east - vehicle[1]
        north_stands, east_stands = place[i, 0] - vehicle[0], place[i, 1] - vehicle[1]
        away = min(
            north_off * north_off + east_off * east_off,
            north_stands * north_stands + east_stands * east_stands,
        )
        if away < reach[i] * reach[i]:
            place[i, 0], place[i, 1] = north, east
            due[count] = i
            count += 1
    return count


class Movers:
    """The moving obstacles of one arena.

    pybullet gets a body's place only where that can matter, near the vehicle: thirty bodies moved
    at every tick would cost as much as all the rest of the plant.
    """

    def __init__(
        self, arena: Arena, bodies: Sequence[int], attitudes: Sequence[Xyzw], radius_m: float
    ) -> None:
        """Take the bodies, which stand where the arena has them at time 0.

        Args:
            arena: Tours and sizes.
            bodies: pybullet's numbers of its moving obstacles, in the arena's order.
            attitudes: Of the bodies, FLU -> ENU.
            radius_m: No part of the vehicle is further from its centre than this [m].
        """
        obstacles, first, n = arena.obstacles, arena.n_static, len(bodies)
        self._bodies, self._attitudes = list(bodies), list(attitudes)
        self._times_s, self._points = tour_arrays(arena)
        half = obstacles.half_size[first:]
        is_box = obstacles.shape[first:] == Shape.BOX
        bounding = np.where(is_box, np.hypot(half[:, 0], half[:, 1]), half[:, 0])
        self._reach = bounding + radius_m + MARGIN_M
        self._place = np.array(obstacles.center[first:, :2], order="C")
        self._up: list[float] = (-obstacles.center[first:, 2]).tolist()
        self._leg = np.zeros(n, np.int64)
        self._due = np.zeros(n, np.int64)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._bodies)

    def move(self, time_us: int, vehicle: Vector, client: int) -> None:
        """Update bodies near a vehicle at (>= 2,) NED [m], `time_us` [µs] after the start."""
        due, place = self._due, self._place
        count = _due(
            time_us, vehicle, self._times_s, self._points, self._leg, self._reach, place, due
        )
        for i in due[:count].tolist() if count else ():
            north, east = place[i].tolist()
            pybullet.resetBasePositionAndOrientation(
                self._bodies[i], (east, north, self._up[i]), self._attitudes[i], client
            )
