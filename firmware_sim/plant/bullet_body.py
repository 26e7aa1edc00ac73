"""The vehicle's body in pybullet."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.core.frames import (
    Vector,
    ned_to_enu,
    quat_ned_frd_to_enu_flu,
    quat_to_matrix,
    quat_wxyz_to_xyzw,
)
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
from firmware_sim.plant.body import NOTHING, Touch
from firmware_sim.plant.world import World, WorldState, pybullet

_ANY_LINK = -2
"""pybullet's filter of contacts that lets all links pass."""

_STILL: Vec = (0.0, 0.0, 0.0)
_LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)


class BulletBody:
    """A multi-body of one link in a pybullet world."""

    def __init__(
        self, arena: Arena | None, body: BodyProfile, airframe: Airframe, tick_s: float
    ) -> None:
        """Put it at rest on the floor at the start, facing north.

        Args:
            arena: Where; None = an endless floor.
            body: Its collision box.
            airframe: Its mass and inertia.
            tick_s: Length of a tick [s].
        """
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
