"""The vehicle's body by the batch twin's rigid-body kernel, with contacts of its own: compiled."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena, Shape
from airl_mav.arena.ground import Relief, no_relief
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import Body as BodyProfile
from airl_mav.vehicle.airframe import Airframe, airframe_of
from airl_mav.vehicle.rigid_body import accelerate, drift
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate
from firmware_sim.plant.body import FLOOR, NOTHING, Touch, walls_of
from firmware_sim.plant.contacts.box import BREAKING_SHARE, MOST, ROW
from firmware_sim.plant.contacts.convex import touch_obstacle
from firmware_sim.plant.contacts.floor import FLOOR_ID, KEPT, touch_floor
from firmware_sim.plant.contacts.ground import near_ground, touch_ground
from firmware_sim.plant.contacts.solver import resolve
from firmware_sim.plant.kinematics import WIDTH, quaternion, rates, velocity, write
from firmware_sim.plant.tours import place_at, tour_arrays

_FIRST = FLOOR_ID + 1
"""Number of the first wall or obstacle."""


class Solids(NamedTuple):
    """Walls and obstacles of an arena, n of them, of which the last m move; and its ground."""

    shape: NDArray[np.int8]  # (n,)
    center: Vector  # (n, 3) NED [m]; of those that move it is updated
    size: Vector  # (n, 3) half extents [m]
    yaw: Vector  # (n,) [rad]
    times_s: Vector  # (m, 1 + k) as `tour_arrays`
    points: Vector  # (m, k, 2)
    leg: NDArray[np.int64]  # (m,)
    relief: Relief


class State(NamedTuple):
    """What is remembered of contacts from tick to tick; updated in place."""

    kept: Vector  # (KEPT, 7) points on the floor
    many: NDArray[np.int64]  # (1,) how many
    room: Vector  # (1,) walls and obstacles are at least this far off [m]
    rows: Vector  # (MOST, ROW) contacts of the newest tick
    impulses: Vector  # (MOST,) theirs [N s]


def solids_of(arena: Arena | None) -> tuple[Solids, list[str]]:
    """Return the walls, obstacles and ground of an arena, and their names; None has none."""
    if arena is None:
        return (
            Solids(
                np.zeros(0, np.int8),
                np.zeros((0, 3)),
                np.zeros((0, 3)),
                np.zeros(0),
                np.full((0, 2), np.inf),
                np.zeros((0, 1, 2)),
                np.zeros(0, np.int64),
                no_relief(),
            ),
            [],
        )
    walls, o = walls_of(arena), arena.obstacles
    times, points = tour_arrays(arena)
    solids = Solids(
        np.concatenate([np.full(len(walls), Shape.BOX, np.int8), o.shape]),
        np.concatenate([np.array([center for _, center, _ in walls]), o.center]),
        np.concatenate([np.array([half for _, _, half in walls]), o.half_size]),
        np.concatenate([np.zeros(len(walls)), o.yaw]),
        times,
        points,
        np.zeros(len(arena.tours), np.int64),
        no_relief() if arena.ground is None else arena.ground.relief,
    )
    return solids, [name for name, _, _ in walls] + [arena.name_of(i) for i in range(len(o))]


def _greatest_speed(solids: Solids) -> float:
    """Return how fast the fastest moving obstacle is [m/s]."""
    fastest = 0.0
    for times, points in zip(solids.times_s, solids.points, strict=True):
        passed = times[1:][np.isfinite(times[1:])]
        ways = np.hypot(*np.diff(points[: len(passed)], axis=0).T)
        took = np.diff(passed)
        if len(took):
            fastest = max(fastest, float(np.max(ways / took)))
    return fastest


@kernel
def _room(solids: Solids, p: Vec, radius: float) -> float:
    """Return a distance [m] that a sphere around the vehicle surely is from walls and obstacles."""
    room: float = math.inf
    for i in range(len(solids.shape)):
        c, s = math.cos(solids.yaw[i]), math.sin(solids.yaw[i])
        dx, dy = p[0] - solids.center[i, 0], p[1] - solids.center[i, 1]
        x = max(0.0, abs(c * dx + s * dy) - solids.size[i, 0])
        y = max(0.0, abs(c * dy - s * dx) - solids.size[i, 1])
        z = max(0.0, abs(p[2] - solids.center[i, 2]) - solids.size[i, 2])
        room = min(room, math.sqrt(x * x + y * y + z * z))
    return room - radius


@kernel
def _find_contacts(
    p: Vec,
    q: Quat,
    half: Vector,
    radius: float,
    close: float,
    moving_us: int,
    solids: Solids,
    state: State,
) -> int:
    """Find what the vehicle touches; return how many contacts there are in `state.rows`."""
    count = 0
    if state.many[0] > 0 or -p[2] - radius < close:
        count = touch_floor(p, q, half, close, state.kept, state.many, state.rows, 0)
    if near_ground(solids.relief, p, radius, close):
        count = touch_ground(p, q, half, close, solids.relief, state.rows, count)
    if state.room[0] > close:
        return count
    n, moving = len(solids.shape), len(solids.leg)
    for i in range(moving):
        north, east = place_at(moving_us, solids.times_s, solids.points, solids.leg, i)
        solids.center[n - moving + i, 0] = north
        solids.center[n - moving + i, 1] = east
    state.room[0] = _room(solids, p, radius)
    if state.room[0] > close:
        return count
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
    state: State,
    row: Vector,
) -> int:
    """Move the vehicle on by one tick.

    Args:
        at: Where it is, NED [m].
        force: All forces but gravity and contacts, NED [N].
        torque: NED [N m].
        before: (16,) its motion before the tick.
        moving_us: How long what moves has been under way at the end of the tick [µs].
        airframe: (15,) as `Airframe`.
        half: (3,) half extents of the collision box [m].
        box: The half diagonal of it, and below which distance bodies are close [m].
        obstacle_speed: Of the fastest moving obstacle [m/s].
        tick_s: Length of the tick [s].
        solids: Walls and obstacles.
        state: What is remembered of contacts.
        row: (16,) overwritten with the motion after the tick.

    Returns:
        How many contacts there were, in `state.rows` and `state.impulses`.
    """
    a, q = airframe_of(airframe), quaternion(before)
    radius, close = box
    state.room[0] -= obstacle_speed * tick_s
    count = _find_contacts(at, q, half, radius, close, moving_us, solids, state)
    turn = rotate(conjugate(q), torque)
    v, spin = accelerate(velocity(before), q, rates(before), force, turn, a, tick_s)
    if count > 0:
        v, spin = resolve(v, spin, q, state.rows, count, a, tick_s, state.impulses)
    p, q_new, omega = drift(at, v, q, spin, tick_s)
    if q_new[0] < 0.0:
        q_new = (-q_new[0], -q_new[1], -q_new[2], -q_new[3])
    write(p, v, q_new, omega, before, tick_s, row)
    state.room[0] -= tick_s * math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return count


class KernelBody:
    """A rigid body of our own, free of pybullet."""

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
        self._solids, names = solids_of(arena)
        self.names: Mapping[int, str] = dict(enumerate([FLOOR, *names], start=FLOOR_ID))
        self._half = np.array([0.5 * body.width_m, 0.5 * body.width_m, 0.5 * body.height_m])
        radius = float(np.linalg.norm(self._half))
        self._box = radius, BREAKING_SHARE * radius
        self._airframe = np.array(airframe)
        self._tick_s = tick_s
        self._obstacle_speed = _greatest_speed(self._solids)
        self._state = State(
            np.zeros((KEPT, 7)),
            np.zeros(1, np.int64),
            np.full(1, -math.inf),
            np.zeros((MOST, ROW)),
            np.zeros(MOST),
        )
        self.touch = NOTHING

    def close(self) -> None:
        """Do nothing: it holds nothing that has to be released."""

    def rest(self) -> Vector:
        """Return the motion (16,) at rest on the floor at the start."""
        return self.put((0.0, 0.0, -float(self._half[2])))

    def move(self, at: Vec, force: Vec, torque: Vec, before: Vector, moving_us: int) -> Vector:
        """Move on by one tick; as `Body`."""
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

    def put(
        self,
        position: Vec,
        velocity: Vec = (0.0, 0.0, 0.0),
        quaternion: Quat = (1.0, 0.0, 0.0, 0.0),
        rates: Vec = (0.0, 0.0, 0.0),
    ) -> Vector:
        """Put it somewhere; as `Body`."""
        state = self._state
        state.many[0], state.room[0] = 0, -math.inf
        self.touch = NOTHING
        row = np.empty(WIDTH)
        before = np.array([*position, *velocity, *quaternion, *rates, 0.0, 0.0, 0.0])
        write(position, velocity, quaternion, rates, before, self._tick_s, row)
        return row
