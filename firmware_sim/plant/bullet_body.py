"""Vehicle body in pybullet, among the fixed and moving bodies of the arena.

A BulletClient looks up and wraps every function at every call, which takes longer than most of the
functions. Code that runs every tick calls `pybullet` directly with the client's number.
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

from airl_mav.arena.geometry import Arena, Ground, Shape
from airl_mav.core import frames
from airl_mav.core.constants import GRAVITY_M_S2, TICK_S
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import BodyProfile as BodyProfile
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.rotation import Quat, Vec
from firmware_sim.engine import dynamics
from firmware_sim.plant.body import FLOOR, NOTHING, Touch, place_at, tour_arrays, walls_of


@contextlib.contextmanager
def silenced_output() -> Iterator[None]:
    """Redirect standard output and standard error of C libraries to the null device."""
    # Flush Python's buffers first, or their content goes to the null device.
    sys.stdout.flush()
    sys.stderr.flush()
    # C libraries write to descriptors 1 and 2, not to sys.stdout.
    kept = [(number, os.dup(number)) for number in (1, 2)]
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for number, _ in kept:
            os.dup2(null, number)
        yield
        # Flush C buffers here; otherwise their content is printed at exit.
        ctypes.CDLL(None).fflush(None)
    finally:
        for number, copy in kept:
            os.dup2(copy, number)
            os.close(copy)
        os.close(null)


# pybullet prints banners from C, at import and when a client connects.
with silenced_output():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

__all__ = ["NO_CLIENT", "BulletBody", "BulletWorld", "connect", "pybullet"]

NO_CLIENT = -1
"""Number of a closed client; every call with it raises pybullet.error."""


_idle: list[Any] = []
"""Clients of closed worlds. Resetting a client takes a tenth of the time of a new one."""


def connect() -> Any:
    """Return a client of an empty physics server in this process."""
    if _idle:
        client = _idle.pop()
        client.resetSimulation()
        return client
    with silenced_output():
        return BulletClient(pybullet.DIRECT)


MARGIN_M = 0.5
"""Distance beyond contact within which bodies are updated [m]. pybullet detects contacts before it
moves the vehicle, and 2 cm around it: nearly all of this distance is a safety margin."""

Xyzw = tuple[float, float, float, float]
"""Quaternion of pybullet."""


@kernel
def _due(
    time_us: int,
    vehicle: frames.Vector,
    times_s: frames.Vector,
    points: frames.Vector,
    leg: NDArray[np.int64],
    reach: frames.Vector,
    place: frames.Vector,
    due: NDArray[np.int64],
) -> int:
    """Find moving obstacles near the vehicle, by their current or by their last updated position.

    `vehicle` is north, east [m], `reach` (n,) the maximum horizontal distance of a possible contact
    [m], the next three are arguments of `place_at`. Updates `place` (n, 2), north, east of the
    bodies found, writes their indices to `due`, and returns their number.
    """
    count = 0
    for i in range(len(leg)):
        north, east = place_at(time_us, times_s, points, leg, i)
        north_off, east_off = north - vehicle[0], east - vehicle[1]
        # Also the stored position: a body left near the vehicle must be moved away.
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
    """Moving obstacles of one arena.

    pybullet receives a body's position only near the vehicle. Moving thirty bodies every tick would
    take as long as the rest of the plant.
    """

    def __init__(
        self, arena: Arena, bodies: Sequence[int], attitudes: Sequence[Xyzw], radius_m: float
    ) -> None:
        """Store the bodies, which are at the arena's positions for time 0, and their attitudes.

        `radius_m` is the maximum distance of any part of the vehicle from its centre [m].
        """
        obstacles, first, n = arena.obstacles, arena.n_static, len(bodies)
        self._bodies, self._attitudes = list(bodies), list(attitudes)
        self._times_s, self._points = tour_arrays(arena)
        half = obstacles.half_size[first:]
        is_box = obstacles.shape[first:] == Shape.BOX
        # Boxes may have any heading: use their horizontal diagonal.
        bounding = np.where(is_box, np.hypot(half[:, 0], half[:, 1]), half[:, 0])
        self._reach = bounding + radius_m + MARGIN_M
        self._place = np.array(obstacles.center[first:, :2], order="C")
        self._up: list[float] = (-obstacles.center[first:, 2]).tolist()
        self._leg = np.zeros(n, np.int64)
        self._due = np.zeros(n, np.int64)

    def __len__(self) -> int:
        """Return the number of moving obstacles."""
        return len(self._bodies)

    def move(self, time_us: int, vehicle: frames.Vector, client: int) -> None:
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
    """Return pybullet's attitude of a level body with heading `yaw` [rad], 0 = north."""
    return frames.quat_wxyz_to_xyzw(
        frames.quat_ned_frd_to_enu_flu(frames.quat_from_euler(0.0, 0.0, yaw))
    )


LEVEL = facing(0.0)

UNTURNED: Xyzw = (0.0, 0.0, 0.0, 1.0)
"""Attitude of a body with a shape in ENU."""


class WorldState(NamedTuple):
    """State of a pybullet world."""

    bullet: bytes
    """Content of pybullet's `saveBullet` file."""
    movers: Movers | None
    """Moving obstacles; None = the arena has none."""


class BulletWorld:
    """pybullet world with floor, hills, walls and obstacles. ENU inside, NED outside."""

    def __init__(
        self, arena: Arena | None, vehicle_radius_m: float, tick_s: float = TICK_S
    ) -> None:
        """Build the bodies of an arena; None = an endless floor.

        `vehicle_radius_m` is the maximum distance of any part of the vehicle from its centre [m];
        `tick_s` is the time step of the physics [s].
        """
        self.client: Any = connect()
        self.number: int = int(self.client._client)
        """Number of the client, for direct calls of pybullet's functions."""
        self.client.setGravity(0.0, 0.0, -GRAVITY_M_S2)
        self.client.setTimeStep(tick_s)
        self.names: dict[int, str] = {}
        """Name of each body in a collision event."""
        self._movers: Movers | None = None
        # Body 0 is the floor, with or without an arena.
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
        """Return the state, including contacts."""
        # pybullet saves its state only to files.
        with TemporaryDirectory() as folder:
            path = Path(folder) / "world.bullet"
            with silenced_output():
                self.client.saveBullet(str(path))
            return WorldState(path.read_bytes(), self._movers)

    def restore(self, state: WorldState) -> None:
        """Load the state of another world with the same bodies."""
        with TemporaryDirectory() as folder:
            path = Path(folder) / "world.bullet"
            path.write_bytes(state.bullet)
            with silenced_output():
                self.client.restoreState(fileName=str(path))
        self._movers = state.movers

    def close(self) -> None:
        """Release the physics server."""
        if self.number != NO_CLIENT:
            # Keep the client: the next world resets it.
            _idle.append(self.client)
            self.client, self.number = None, NO_CLIENT

    def move_obstacles(self, time_us: int, vehicle: frames.Vector) -> None:
        """Move the moving obstacles to their positions `time_us` [µs] after the start.

        Bodies far from the vehicle, at (>= 2,) NED [m], are not updated: contacts are impossible.
        """
        if self._movers is not None:
            self._movers.move(time_us, vehicle, self.number)

    def _add(self, shape: int, center: frames.Vector, attitude: Xyzw, name: str) -> int:
        body = self.client.createMultiBody(
            baseMass=0.0,
            baseCollisionShapeIndex=shape,
            basePosition=frames.ned_to_enu(center),
            baseOrientation=attitude,
            # A rigid body at rest takes no time per step. A multi-body, pybullet's default, runs
            # Featherstone's algorithm every step, and an awake one gets a new bounding box.
            useMaximalCoordinates=True,
        )
        self.client.changeDynamics(body, -1, activationState=pybullet.ACTIVATION_STATE_SLEEP)
        self.names[body] = name
        return int(body)

    def _add_ground(self, ground: Ground) -> None:
        shape = self.client.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=frames.ned_to_enu(ground.points).tolist(),
            indices=ground.faces.ravel().tolist(),
            flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
        )
        body = self._add(shape, np.zeros(3), UNTURNED, FLOOR)
        # With the default margin, bodies rest a millimetre above the triangles.
        self.client.changeDynamics(body, -1, collisionMargin=0.0)

    def _box(self, half: tuple[float, float, float]) -> int:
        return int(self.client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half))

    def _add_walls(self, arena: Arena) -> None:
        # The axes of a box are forward, left, up.
        for name, center, half in walls_of(arena):
            self._add(self._box(half), np.array(center), LEVEL, name)

    def _add_obstacles(self, arena: Arena) -> tuple[list[int], list[Xyzw]]:
        """Return the bodies and attitudes of the obstacles."""
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
"""pybullet's contact filter value for all links."""

_STILL: Vec = (0.0, 0.0, 0.0)
_LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)


class BulletBody:
    """Multi-body with one link in a pybullet world."""

    def __init__(
        self, arena: Arena | None, body: BodyProfile, airframe: Airframe, tick_s: float
    ) -> None:
        """Place the body at rest on the floor at the start, facing north; see `plant.new_body`."""
        self._made_of = arena, body, airframe, tick_s
        diagonal_m = math.hypot(body.width_m, body.width_m, body.height_m)
        self.world = BulletWorld(arena, 0.5 * diagonal_m, tick_s)
        self._tick_s = tick_s
        self.number = self._build(body, airframe)
        """Number of the body in pybullet."""
        self.touch = NOTHING

    @property
    def names(self) -> Mapping[int, str]:
        """Name of each body in a collision event, by pybullet's number."""
        return self.world.names

    def close(self) -> None:
        """Release the physics server."""
        self.world.close()

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the pickle state: a new world of the same bodies, with pybullet's state."""
        return BulletBody, self._made_of, (self.world.state(), self.touch)

    def __setstate__(self, state: tuple[WorldState, Touch]) -> None:
        """Load the state of the pickled body."""
        world, self.touch = state
        self.world.restore(world)

    def move(
        self, at: Vec, force: Vec, torque: Vec, before: frames.Vector, moving_us: int
    ) -> frames.Vector:
        """Move the body by one tick; see `PlantBody`."""
        world, number = self.world, self.number
        client = world.number
        # NED to ENU: swap the first two axes, negate the third.
        here = (at[1], at[0], -at[2])
        pushed, turned = (force[1], force[0], -force[2]), (torque[1], torque[0], -torque[2])
        pybullet.applyExternalForce(number, -1, pushed, here, pybullet.WORLD_FRAME, client)
        pybullet.applyExternalTorque(number, -1, turned, pybullet.WORLD_FRAME, client)
        # Obstacles move before the step, so that contacts use their new position.
        world.move_obstacles(moving_us, before)
        pybullet.stepSimulation(client)
        contacts = pybullet.getContactPoints(number, -1, _ANY_LINK, _ANY_LINK, client)
        close, pressed = set(), set()
        for contact in contacts:
            # Index 2 is body B, index 9 the normal force: 0 = close but not touching.
            close.add(contact[2])
            if contact[9] > 0.0:
                pressed.add(contact[2])
        # Reuse the object while contacts last: most ticks change nothing.
        if close != self.touch.close or pressed != self.touch.pressed:
            self.touch = Touch(frozenset(close), frozenset(pressed)) if close else NOTHING
        return self._read(before)

    def put(
        self,
        position: Vec,
        velocity: Vec = _STILL,
        quaternion: Quat = _LEVEL,
        rates: Vec = _STILL,
    ) -> frames.Vector:
        """Place the body in a motion; see `PlantBody`."""
        self.follow(np.array([*position, *velocity, *quaternion, *rates]))
        return self.rest()

    def look_around(self) -> None:
        """Do nothing: every `move` updates the moving obstacles."""

    def follow(self, motion: frames.Vector) -> None:
        """Set the motion (>= 13,) of the body; see `PlantBody`."""
        client, number = self.world.client, self.number
        quaternion = motion[dynamics.QUATERNION]
        attitude = frames.quat_wxyz_to_xyzw(frames.quat_ned_frd_to_enu_flu(quaternion))
        client.resetBasePositionAndOrientation(
            number, frames.ned_to_enu(motion[dynamics.POSITION]), attitude
        )
        spin = frames.ned_to_enu(frames.quat_to_matrix(quaternion) @ motion[dynamics.RATES])
        client.resetBaseVelocity(number, frames.ned_to_enu(motion[dynamics.VELOCITY]), spin)
        self.touch = NOTHING

    def rest(self) -> frames.Vector:
        """Return the motion (16,), without acceleration."""
        return self._read(None)

    def _read(self, before: frames.Vector | None) -> frames.Vector:
        """Return pybullet's state as a row; zero acceleration without `before`."""
        client, number = self.world.number, self.number
        at, orientation = pybullet.getBasePositionAndOrientation(number, client)
        linear, angular = pybullet.getBaseVelocity(number, client)
        row = np.empty(dynamics.WIDTH)
        # Without a motion before, difference from the current velocity: zero acceleration.
        if before is None:
            before = row
            before[3], before[4], before[5] = linear[1], linear[0], -linear[2]
        dynamics.from_bullet(at, orientation, linear, angular, before, self._tick_s, row)
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
            # Drag is modelled outside; damping in pybullet would add to it.
            linearDamping=0.0,
            angularDamping=0.0,
            restitution=0.0,
            # pybullet multiplies it with the other body's 0.5; see `kernel_body.FRICTION`.
            lateralFriction=0.8,
            rollingFriction=0.0,
            # A sleeping body does not move.
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
        )
        return int(number)
