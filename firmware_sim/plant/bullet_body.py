"""The vehicle's body in pybullet, among those of the arena, some of which move.

A BulletClient looks up and wraps every function at every call, which costs more than most of the
functions. Code that runs at every tick calls `pybullet` itself with the client's number.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena, Shape
from airl_mav.arena.ground import Ground
from airl_mav.core.constants import GRAVITY_M_S2, TICK_S
from airl_mav.core.frames import (
    Vector,
    ned_to_enu,
    quat_from_euler,
    quat_ned_frd_to_enu_flu,
    quat_to_matrix,
    quat_wxyz_to_xyzw,
)
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import Body as BodyProfile
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.rotation import Quat, Vec
from firmware_sim.engine.kinematics import (
    POSITION,
    QUATERNION,
    RATES,
    VELOCITY,
    WIDTH,
    from_bullet,
)
from firmware_sim.plant.body import FLOOR, NOTHING, Touch, walls_of
from firmware_sim.plant.solids import place_at, tour_arrays


@contextlib.contextmanager
def silenced_output() -> Iterator[None]:
    """Point standard output and standard error at the null device for a while: for C libraries."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [(number, os.dup(number)) for number in (1, 2)]
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for number, _ in kept:
            os.dup2(null, number)
        yield
        # What C has buffered meanwhile must go the same way, not out at exit.
        ctypes.CDLL(None).fflush(None)
    finally:
        for number, copy in kept:
            os.dup2(copy, number)
            os.close(copy)
        os.close(null)


# It prints banners from C, at import and when a client connects.
with silenced_output():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

__all__ = ["NO_CLIENT", "BulletBody", "World", "connect", "pybullet"]

NO_CLIENT = -1
"""Number of a client that has been closed: every call with it raises pybullet.error."""


_idle: list[Any] = []
"""Clients of worlds that were closed: one that is emptied costs a tenth of a new one."""


def connect() -> Any:
    """Return a client of an empty physics server in this process."""
    if _idle:
        client = _idle.pop()
        client.resetSimulation()
        return client
    with silenced_output():
        return BulletClient(pybullet.DIRECT)


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

    pybullet gets a body's place only where that can matter, near the vehicle. Thirty bodies moved
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
        self.number: int = int(self.client._client)
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
            _idle.append(self.client)
            self.client, self.number = None, NO_CLIENT

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


_ANY_LINK = -2
"""pybullet's filter of contacts that lets all links pass."""

_STILL: Vec = (0.0, 0.0, 0.0)
_LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)


class BulletBody:
    """A multi-body of one link in a pybullet world."""

    def __init__(
        self, arena: Arena | None, body: BodyProfile, airframe: Airframe, tick_s: float
    ) -> None:
        """Put it at rest on the floor at the start, facing north; see `bodies.new_body`."""
        self._made_of = arena, body, airframe, tick_s
        diagonal_m = math.hypot(body.width_m, body.width_m, body.height_m)
        self.world = World(arena, 0.5 * diagonal_m, tick_s)
        self._tick_s = tick_s
        self.number = self._build(body, airframe)
        """pybullet's number of it."""
        self.touch = NOTHING

    @property
    def names(self) -> Mapping[int, str]:
        """Name of each body in a collision event, by pybullet's number."""
        return self.world.names

    def close(self) -> None:
        """Release the physics server."""
        self.world.close()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it as a new world of the same bodies, and pybullet's state of that."""
        return BulletBody, self._made_of, (self.world.state(), self.touch)

    def __setstate__(self, state: tuple[WorldState, Touch]) -> None:
        """Take over the state of the body that was pickled."""
        world, self.touch = state
        self.world.restore(world)

    def move(self, at: Vec, force: Vec, torque: Vec, before: Vector, moving_us: int) -> Vector:
        """Move on by one tick; as `Body`."""
        world, number = self.world, self.number
        client = world.number
        here = (at[1], at[0], -at[2])
        pushed, turned = (force[1], force[0], -force[2]), (torque[1], torque[0], -torque[2])
        pybullet.applyExternalForce(number, -1, pushed, here, pybullet.WORLD_FRAME, client)
        pybullet.applyExternalTorque(number, -1, turned, pybullet.WORLD_FRAME, client)
        world.move_obstacles(moving_us, before)
        pybullet.stepSimulation(client)
        contacts = pybullet.getContactPoints(number, -1, _ANY_LINK, _ANY_LINK, client)
        close, pressed = set(), set()
        for contact in contacts:
            # Index 2 is body B, index 9 the normal force: 0 = close but not touching.
            close.add(contact[2])
            if contact[9] > 0.0:
                pressed.add(contact[2])
        if close != self.touch.close or pressed != self.touch.pressed:
            self.touch = Touch(frozenset(close), frozenset(pressed)) if close else NOTHING
        return self._read(before)

    def put(
        self,
        position: Vec,
        velocity: Vec = _STILL,
        quaternion: Quat = _LEVEL,
        rates: Vec = _STILL,
    ) -> Vector:
        """Put it somewhere; as `Body`."""
        self.follow(np.array([*position, *velocity, *quaternion, *rates]))
        return self.rest()

    def look_around(self) -> None:
        """Do nothing: every `move` puts what moves where it is."""

    def follow(self, motion: Vector) -> None:
        """Take the vehicle to be in a motion (>= 13,); as `Body`."""
        client, number = self.world.client, self.number
        quaternion = motion[QUATERNION]
        attitude = quat_wxyz_to_xyzw(quat_ned_frd_to_enu_flu(quaternion))
        client.resetBasePositionAndOrientation(number, ned_to_enu(motion[POSITION]), attitude)
        spin = ned_to_enu(quat_to_matrix(quaternion) @ motion[RATES])
        client.resetBaseVelocity(number, ned_to_enu(motion[VELOCITY]), spin)
        self.touch = NOTHING

    def rest(self) -> Vector:
        """Return the motion (16,), the vehicle taken to be at rest or in steady flight."""
        return self._read(None)

    def _read(self, before: Vector | None) -> Vector:
        """Return pybullet's state as a row; without what was before, nothing accelerates."""
        client, number = self.world.number, self.number
        at, orientation = pybullet.getBasePositionAndOrientation(number, client)
        linear, angular = pybullet.getBaseVelocity(number, client)
        row = np.empty(WIDTH)
        if before is None:
            before = row
            before[3], before[4], before[5] = linear[1], linear[0], -linear[2]
        from_bullet(at, orientation, linear, angular, before, self._tick_s, row)
        return row

    def _build(self, body: BodyProfile, airframe: Airframe) -> int:
        client = self.world.client
        half = (0.5 * body.width_m, 0.5 * body.width_m, 0.5 * body.height_m)
        shape = client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half)
        number = client.createMultiBody(
            baseMass=airframe.mass,
            baseCollisionShapeIndex=shape,
            basePosition=(0.0, 0.0, half[2]),
            # Facing north: forward = +y of ENU, a quarter turn about up.
            baseOrientation=(0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)),
        )
        client.changeDynamics(
            number,
            -1,
            localInertiaDiagonal=(
                airframe.inertia_xx,
                airframe.inertia_yy,
                airframe.inertia_zz,
            ),
            linearDamping=0.0,
            angularDamping=0.0,
            restitution=0.0,
            lateralFriction=0.8,
            rollingFriction=0.0,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
        )
        return int(number)
