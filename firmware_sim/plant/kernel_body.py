"""Vehicle body with the vectorized simulator's rigid-body kernel and built-in contacts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import BodyProfile as BodyProfile
from airl_mav.vehicle.airframe import Airframe, accelerate, airframe_of, drift
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate
from firmware_sim.engine.dynamics import WIDTH, quaternion, rates, velocity, write
from firmware_sim.plant.body import FLOOR, NOTHING, Touch
from firmware_sim.plant.contacts.convex import BREAKING_SHARE, MOST, ROW, touch_obstacle
from firmware_sim.plant.contacts.ground_contact import (
    FLOOR_ID,
    KEPT,
    near_ground,
    touch_floor,
    touch_ground,
)
from firmware_sim.plant.contacts.solver import resolve
from firmware_sim.plant.solids import Solids, greatest_speed, place_at, room_among, solids_of

_FIRST = FLOOR_ID + 1
"""Number of the first wall or obstacle."""


class ContactState(NamedTuple):
    """Contacts stored between ticks; updated in place."""

    kept: Vector  # points on the floor
    many: NDArray[np.int64]  # (1,) number of these points
    room: Vector  # (1,) minimum distance to walls and obstacles [m]
    rows: Vector  # (MOST, ROW) contacts of the newest tick
    impulses: Vector  # (MOST,) impulses of the contacts [N s]


@kernel
def _find_contacts(
    p: Vec,
    q: Quat,
    half: Vector,
    radius: float,
    close: float,
    moving_us: int,
    solids: Solids,
    state: ContactState,
) -> int:
    """Find the vehicle's contacts; return the number of contacts in `state.rows`."""
    count = 0
    # Stored floor points must be updated even when the vehicle has left the floor.
    if state.many[0] > 0 or -p[2] - radius < close:
        count = touch_floor(p, q, half, close, state.kept, state.many, state.rows, 0)
    if near_ground(solids.relief, p, radius, close):
        count = touch_ground(p, q, half, close, solids.relief, state.rows, count)
    # `room` is a lower bound: no solid can be close yet.
    if state.room[0] > close:
        return count
    n, moving = len(solids.shape), len(solids.leg)
    for i in range(moving):
        north, east = place_at(moving_us, solids.times_s, solids.points, solids.leg, i)
        solids.center[n - moving + i, 0] = north
        solids.center[n - moving + i, 1] = east
    state.room[0] = room_among(solids, p, radius)
    if state.room[0] > close:
        return count
    # Only solids whose bounding sphere is near need the exact test.
    for i in range(n):
        center = (solids.center[i, 0], solids.center[i, 1], solids.center[i, 2])
        size = (solids.size[i, 0], solids.size[i, 1], solids.size[i, 2])
        reach = math.sqrt(size[0] ** 2 + size[1] ** 2 + size[2] ** 2) + radius + close
        away = (p[0] - center[0]) ** 2 + (p[1] - center[1]) ** 2 + (p[2] - center[2]) ** 2
        if away < reach * reach:
            count = touch_obstacle(
                solids.shape[i],
                size,
                center,
                solids.yaw[i],
                p,
                q,
                half,
                close,
                state.rows,
                count,
                _FIRST + i,
            )
    return count


@kernel
def advance(
    at: Vec,
    force: Vec,
    torque: Vec,
    before: Vector,
    moving_us: int,
    airframe: Vector,
    half: Vector,
    box: tuple[float, float],
    obstacle_speed: float,
    tick_s: float,
    solids: Solids,
    state: ContactState,
    row: Vector,
) -> int:
    """Move the vehicle by one tick.

    Args:
        at: Position, NED [m].
        force: All forces except gravity and contacts, NED [N].
        torque: NED [N m].
        before: (16,) motion before the tick.
        moving_us: Time since the moving obstacles started, at the end of the tick [µs].
        airframe: (15,) fields of `Airframe`.
        half: (3,) half extents of the collision box [m].
        box: Half diagonal of the box, and distance below which bodies are close [m].
        obstacle_speed: Maximum speed of a moving obstacle [m/s].
        tick_s: Length of the tick [s].
        solids: Walls and obstacles.
        state: Contacts stored between ticks.
        row: (16,) output: motion after the tick.

    Returns:
        Number of contacts, in `state.rows` and `state.impulses`.
    """
    a, q = airframe_of(airframe), quaternion(before)
    radius, close = box
    # Obstacles may approach: reduce the room before the search.
    state.room[0] -= obstacle_speed * tick_s
    count = _find_contacts(at, q, half, radius, close, moving_us, solids, state)
    # Contacts see the velocity after all other forces.
    turn = rotate(conjugate(q), torque)
    v, spin = accelerate(velocity(before), q, rates(before), force, turn, a, tick_s)
    if count > 0:
        v, spin = resolve(v, spin, q, state.rows, count, a, tick_s, state.impulses)
    p, q_new, omega = drift(at, v, q, spin, tick_s)
    if q_new[0] < 0.0:
        q_new = (-q_new[0], -q_new[1], -q_new[2], -q_new[3])
    write(p, v, q_new, omega, before, tick_s, row)
    # The vehicle's own motion uses up the room, too.
    state.room[0] -= tick_s * math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return count


class KernelBody:
    """Built-in rigid body without pybullet."""

    def __init__(
        self, arena: Arena | None, body: BodyProfile, airframe: Airframe, tick_s: float
    ) -> None:
        """Place the body at rest on the floor at the start, facing north; see `plant.new_body`."""
        self._solids, names = solids_of(arena)
        self.names: Mapping[int, str] = dict(enumerate([FLOOR, *names], start=FLOOR_ID))
        self._half = np.array([0.5 * body.width_m, 0.5 * body.width_m, 0.5 * body.height_m])
        radius = float(np.linalg.norm(self._half))
        """Half diagonal of the collision box [m]."""
        self._box = radius, BREAKING_SHARE * radius
        self._airframe = np.array(airframe)
        self._tick_s = tick_s
        self._obstacle_speed = greatest_speed(self._solids)
        self._state = ContactState(
            np.zeros((KEPT, 7)),
            np.zeros(1, np.int64),
            # -inf: the first tick measures the room.
            np.full(1, -math.inf),
            np.zeros((MOST, ROW)),
            np.zeros(MOST),
        )
        self.touch = NOTHING

    def close(self) -> None:
        """Do nothing: the body has no resources to release."""

    def rest(self) -> Vector:
        """Return the motion (16,) at rest on the floor at the start."""
        return self.put((0.0, 0.0, -float(self._half[2])))

    def move(self, at: Vec, force: Vec, torque: Vec, before: Vector, moving_us: int) -> Vector:
        """Move the body by one tick; see `PlantBody`."""
        row = np.empty(WIDTH)
        state = self._state
        count = advance(
            at,
            force,
            torque,
            before,
            moving_us,
            self._airframe,
            self._half,
            self._box,
            self._obstacle_speed,
            self._tick_s,
            self._solids,
            state,
            row,
        )
        if count:
            owners = state.rows[:count, 7].astype(int).tolist()
            pushed = state.impulses[:count].tolist()
            self.touch = Touch(
                frozenset(owners),
                frozenset(o for o, impulse in zip(owners, pushed, strict=True) if impulse > 0.0),
            )
        else:
            self.touch = NOTHING
        return row

    def look_around(self) -> None:
        """Update the moving obstacles; see `PlantBody`."""
        self._state.room[0] = -math.inf

    def follow(self, motion: Vector) -> None:
        """Reset the contacts for a new motion; see `PlantBody`."""
        del motion  # `move` receives it
        self._state.many[0], self._state.room[0] = 0, -math.inf

    def put(
        self,
        position: Vec,
        velocity: Vec = (0.0, 0.0, 0.0),
        quaternion: Quat = (1.0, 0.0, 0.0, 0.0),
        rates: Vec = (0.0, 0.0, 0.0),
    ) -> Vector:
        """Place the body in a motion; see `PlantBody`."""
        state = self._state
        state.many[0], state.room[0] = 0, -math.inf
        self.touch = NOTHING
        row = np.empty(WIDTH)
        before = np.array([*position, *velocity, *quaternion, *rates, 0.0, 0.0, 0.0])
        write(position, velocity, quaternion, rates, before, self._tick_s, row)
        return row
