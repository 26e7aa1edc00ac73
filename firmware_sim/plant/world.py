"""The arena as pybullet bodies, and who touched whom."""

from __future__ import annotations

from typing import Any

import numpy as np

from airl_mav.arena.geometry import Arena, Shape
from airl_mav.constants import GRAVITY_M_S2, TICK_S
from airl_mav.frames import (
    Vector,
    ned_to_enu,
    quat_from_euler,
    quat_ned_frd_to_enu_flu,
    quat_wxyz_to_xyzw,
)
from firmware_sim.plant.bullet import connect, pybullet

WALL_THICKNESS_M = 0.2

FLOOR = "floor"
"""Name of the floor in a collision event."""


class World:
    """A pybullet world: floor, walls, obstacles. ENU inside, NED outside."""

    def __init__(self, arena: Arena | None) -> None:
        """Build the bodies of an arena; None = an endless floor."""
        self.client: Any = connect()
        self.client.setGravity(0.0, 0.0, -GRAVITY_M_S2)
        self.client.setTimeStep(TICK_S)
        self.names: dict[int, str] = {}
        """What each body is called in a collision event."""
        self._movers: list[int] = []
        self._arena = arena
        floor = self.client.createCollisionShape(pybullet.GEOM_PLANE)
        self._add(floor, np.zeros(3), 0.0, FLOOR)
        if arena is not None:
            self._add_walls(arena)
            self._add_obstacles(arena)

    def close(self) -> None:
        """Release the physics server."""
        self.client.disconnect()

    def move_obstacles(self, time_us: int) -> None:
        """Put the moving obstacles where they are `time_us` after the start of the episode."""
        if self._arena is None or not self._movers:
            return
        centers = self._arena.centers_at(time_us)[self._arena.n_static :]
        for body, center in zip(self._movers, ned_to_enu(centers), strict=True):
            self.client.resetBasePositionAndOrientation(body, center, (0.0, 0.0, 0.0, 1.0))

    def _add(self, shape: int, center: Vector, yaw: float, name: str) -> int:
        attitude = quat_ned_frd_to_enu_flu(quat_from_euler(0.0, 0.0, yaw))
        body = self.client.createMultiBody(
            baseMass=0.0,
            baseCollisionShapeIndex=shape,
            basePosition=ned_to_enu(center),
            baseOrientation=quat_wxyz_to_xyzw(attitude),
        )
        self.names[body] = name
        return int(body)

    def _box(self, half: tuple[float, float, float]) -> int:
        return int(self.client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half))

    def _add_walls(self, arena: Arena) -> None:
        b = arena.bounds
        t, h = 0.5 * WALL_THICKNESS_M, 0.5 * b.height
        north, east = 0.5 * (b.north_min + b.north_max), 0.5 * (b.east_min + b.east_max)
        half_n, half_e = 0.5 * (b.north_max - b.north_min), 0.5 * (b.east_max - b.east_min)
        # Inner faces stand on the bounds. A box's own axes are forward, left, up.
        along_east, along_north = (t, half_e + 2 * t, h), (half_n + 2 * t, t, h)
        self._add(self._box(along_east), np.array([b.north_max + t, east, -h]), 0.0, "wall-north")
        self._add(self._box(along_east), np.array([b.north_min - t, east, -h]), 0.0, "wall-south")
        self._add(self._box(along_north), np.array([north, b.east_max + t, -h]), 0.0, "wall-east")
        self._add(self._box(along_north), np.array([north, b.east_min - t, -h]), 0.0, "wall-west")

    def _add_obstacles(self, arena: Arena) -> None:
        o = arena.obstacles
        for i in range(len(o)):
            x, y, z = (float(v) for v in o.half_size[i])
            if o.shape[i] == Shape.BOX:
                shape = self._box((x, y, z))
            elif o.shape[i] == Shape.CYLINDER:
                shape = self.client.createCollisionShape(
                    pybullet.GEOM_CYLINDER, radius=x, height=2 * z
                )
            else:
                shape = self.client.createCollisionShape(pybullet.GEOM_SPHERE, radius=x)
            moving = i >= arena.n_static
            kind = Shape(int(o.shape[i])).name.lower()
            name = f"{'moving' if moving else 'static'}-{kind}-{i}"
            body = self._add(shape, o.center[i], float(o.yaw[i]), name)
            if moving:
                self._movers.append(body)
