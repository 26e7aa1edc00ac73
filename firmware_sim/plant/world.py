"""The arena as pybullet bodies, with their names for collision events."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from airl_mav.arena.geometry import Arena, Shape
from airl_mav.arena.ground import Ground
from airl_mav.core.constants import GRAVITY_M_S2, TICK_S
from airl_mav.core.frames import (
    Vector,
    ned_to_enu,
    quat_from_euler,
    quat_ned_frd_to_enu_flu,
    quat_wxyz_to_xyzw,
)
from firmware_sim.plant.body import FLOOR, walls_of
from firmware_sim.plant.bullet import NO_CLIENT, connect, number_of, pybullet, silenced_output
from firmware_sim.plant.movers import Movers, Xyzw


def facing(yaw: float) -> Xyzw:
    """Return pybullet's attitude of a level body that faces `yaw` [rad], 0 = north."""
    return quat_wxyz_to_xyzw(quat_ned_frd_to_enu_flu(quat_from_euler(0.0, 0.0, yaw)))


LEVEL = facing(0.0)

UNTURNED: Xyzw = (0.0, 0.0, 0.0, 1.0)
"""That of a body whose shape is given in ENU."""


class WorldState(NamedTuple):
    """State of a pybullet world."""

    bullet: bytes
    """File of pybullet's `saveBullet`."""
    movers: Movers | None
    """Moving obstacles; None = the arena has none."""


class World:
    """A pybullet world: floor, hills, walls, obstacles. ENU inside, NED outside."""

    def __init__(
        self, arena: Arena | None, vehicle_radius_m: float, tick_s: float = TICK_S
    ) -> None:
        """Build the bodies of an arena; None = an endless floor.

        No part of the vehicle is further from its centre than `vehicle_radius_m` [m]; `tick_s` is
        the time step of the physics [s].
        """
        self.client: Any = connect()
        self.number: int = number_of(self.client)
        """Of the client, for direct calls of pybullet's functions."""
        self.client.setGravity(0.0, 0.0, -GRAVITY_M_S2)
        self.client.setTimeStep(tick_s)
        self.names: dict[int, str] = {}
        """Name of each body in a collision event."""
        self._movers: Movers | None = None
        floor = self.client.createCollisionShape(pybullet.GEOM_PLANE)
        self._add(floor, np.zeros(3), LEVEL, FLOOR)
        if arena is not None:
            if arena.ground is not None:
                self._add_ground(arena.ground)
            self._add_walls(arena)
            bodies, attitudes = self._add_obstacles(arena)
            if arena.tours:
                first = arena.n_static
                self._movers = Movers(arena, bodies[first:], attitudes[first:], vehicle_radius_m)

    def state(self) -> WorldState:
        """Return the state, contacts included."""
        with TemporaryDirectory() as folder:
            path = Path(folder) / "world.bullet"
            with silenced_output():
                self.client.saveBullet(str(path))
            return WorldState(path.read_bytes(), self._movers)

    def restore(self, state: WorldState) -> None:
        """Take over the state of another world of the same bodies."""
        with TemporaryDirectory() as folder:
            path = Path(folder) / "world.bullet"
            path.write_bytes(state.bullet)
            with silenced_output():
                self.client.restoreState(fileName=str(path))
        self._movers = state.movers

    def close(self) -> None:
        """Release the physics server."""
        if self.number != NO_CLIENT:
            self.client.disconnect()
            self.number = NO_CLIENT

    def move_obstacles(self, time_us: int, vehicle: Vector) -> None:
        """Move what moves to where it is `time_us` [µs] after the start of the episode.

        Far from the vehicle, at (>= 2,) NED [m], bodies may stay behind: nothing can touch them.
        """
        if self._movers is not None:
            self._movers.move(time_us, vehicle, self.number)

    def _add(self, shape: int, center: Vector, attitude: Xyzw, name: str) -> int:
        body = self.client.createMultiBody(
            baseMass=0.0,
            baseCollisionShapeIndex=shape,
            basePosition=ned_to_enu(center),
            baseOrientation=attitude,
            # A rigid body at rest costs nothing per step. A multi-body, pybullet's default, goes
            # through Featherstone's algorithm each time; one that is awake gets a new bounding box.
            useMaximalCoordinates=True,
        )
        self.client.changeDynamics(body, -1, activationState=pybullet.ACTIVATION_STATE_SLEEP)
        self.names[body] = name
        return int(body)

    def _add_ground(self, ground: Ground) -> None:
        shape = self.client.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=ned_to_enu(ground.points).tolist(),
            indices=ground.faces.ravel().tolist(),
            flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
        )
        body = self._add(shape, np.zeros(3), UNTURNED, FLOOR)
        # Without it everything stands a millimetre above the triangles.
        self.client.changeDynamics(body, -1, collisionMargin=0.0)

    def _box(self, half: tuple[float, float, float]) -> int:
        return int(self.client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half))

    def _add_walls(self, arena: Arena) -> None:
        # A box's own axes are forward, left, up.
        for name, center, half in walls_of(arena):
            self._add(self._box(half), np.array(center), LEVEL, name)

    def _add_obstacles(self, arena: Arena) -> tuple[list[int], list[Xyzw]]:
        """Return the obstacles' bodies and attitudes."""
        o = arena.obstacles
        bodies, attitudes = [], []
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
            attitudes.append(facing(float(o.yaw[i])))
            bodies.append(self._add(shape, o.center[i], attitudes[i], arena.name_of(i)))
        return bodies, attitudes
