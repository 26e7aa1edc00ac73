"""Vehicle body with the vectorized simulator's rigid-body kernel and built-in contacts.

Contact impulses are Bullet's sequential impulses. Rows, their order, the two friction directions in
one cone and the constants match btMultiBodyConstraintSolver in pybullet's configuration. A vehicle
on the floor moves the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.profiles.vehicle import BodyProfile as BodyProfile
from airl_mav.vehicle.airframe import Airframe, accelerate, airframe_of, drift
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate
from firmware_sim.addons.kernel_plant import ground_contact
from firmware_sim.addons.kernel_plant.convex import MOST, ROW, touch_obstacle
from firmware_sim.engine.dynamics import WIDTH, quaternion, rates, velocity, write
from firmware_sim.plant.body import (
    BREAKING_SHARE,
    FLOOR,
    NOTHING,
    Solids,
    Touch,
    greatest_speed,
    place_at,
    room_among,
    solids_of,
)

FRICTION = 0.4
"""Friction coefficient: the vehicle's 0.8 times pybullet's default of 0.5 for other bodies."""

ITERATIONS = 50
ENOUGH = 1e-7
"""Tolerance: iterations end when all velocity changes are below its square root [m²/s²]."""

ERP = 0.08
"""Fraction of a penetration removed per tick (m_erp2)."""

SLOP_M = 1e-5
"""Linear slop (m_linearSlop) [m]."""

_WIDTH = 16
"""Number of values in a row: direction, arm x direction, velocities per unit impulse (linear,
angular), 1 / (direction . response), right-hand side, impulse so far."""


@kernel
def _sides(n: Vec) -> tuple[Vec, Vec]:
    """Return two unit vectors normal to n and to each other; on the floor south, then east."""
    # Same choice as Bullet's btPlaneSpace1, to match its friction directions.
    if abs(n[2]) > math.sqrt(0.5):
        k = 1.0 / math.sqrt(n[0] * n[0] + n[2] * n[2])
        a = (n[2] * k, 0.0, -n[0] * k)
    else:
        k = 1.0 / math.sqrt(n[0] * n[0] + n[1] * n[1])
        a = (-n[1] * k, n[0] * k, 0.0)
    x, y, z = a
    return a, (n[1] * z - n[2] * y, n[2] * x - n[0] * z, n[0] * y - n[1] * x)


@kernel
def _describe(
    row: Vector, d: Vec, arm: Vec, v: Vec, spin: Vec, q: Quat, airframe: Airframe
) -> float:
    """Fill a row for direction d at an arm; return the velocity along it [m/s]."""
    t = (
        arm[1] * d[2] - arm[2] * d[1],
        arm[2] * d[0] - arm[0] * d[2],
        arm[0] * d[1] - arm[1] * d[0],
    )
    # The inertia is diagonal in body axes: rotate, divide, rotate back.
    b = rotate(conjugate(q), t)
    turned = (b[0] / airframe.inertia_xx, b[1] / airframe.inertia_yy, b[2] / airframe.inertia_zz)
    w = rotate(q, turned)
    m = airframe.mass
    row[0], row[1], row[2] = d
    row[3], row[4], row[5] = t
    row[6], row[7], row[8] = d[0] / m, d[1] / m, d[2] / m
    row[9], row[10], row[11] = w
    # Velocity along d per unit impulse at this arm.
    response = 1.0 / m + t[0] * w[0] + t[1] * w[1] + t[2] * w[2]
    row[12] = 1.0 / response
    row[14] = 0.0
    return (
        d[0] * v[0] + d[1] * v[1] + d[2] * v[2] + t[0] * spin[0] + t[1] * spin[1] + t[2] * spin[2]
    )


@kernel
def _wanted(row: Vector, change: Vector) -> float:
    """Return the remaining impulse [N s] of a row after a velocity change (6,)."""
    along = 0.0
    for i in range(6):
        along += row[i] * change[i]
    left: float = row[13] - along * row[12]
    return left


@kernel
def _push(row: Vector, change: Vector, impulse: float) -> None:
    """Add the effect of an impulse [N s] along a row to the velocity change (6,)."""
    for i in range(6):
        change[i] += row[6 + i] * impulse


@kernel
def _rub(a: Vector, b: Vector, change: Vector, limit: float) -> float:
    """Solve both friction directions of a contact in a cone; return the velocity's change."""
    more_a, more_b = _wanted(a, change), _wanted(b, change)
    sum_a, sum_b = a[14] + more_a, b[14] + more_b
    # Both directions share one friction cone.
    if sum_a * sum_a + sum_b * sum_b >= limit * limit:
        # Bullet limits each direction by the angle of the impulse.
        angle = math.atan2(sum_a, sum_b)
        most_a, most_b = abs(limit * math.sin(angle)), abs(limit * math.cos(angle))
        sum_a = min(max(sum_a, -most_a), most_a)
        sum_b = min(max(sum_b, -most_b), most_b)
        more_a, more_b = sum_a - a[14], sum_b - b[14]
    a[14], b[14] = sum_a, sum_b
    _push(a, change, more_a)
    _push(b, change, more_b)
    changed: float = more_a / a[12] + more_b / b[12]
    return changed


@large_kernel
def resolve(
    v: Vec,
    spin: Vec,
    q: Quat,
    contacts: Vector,
    count: int,
    airframe: Airframe,
    tick_s: float,
    impulses: Vector,
) -> tuple[Vec, Vec]:
    """Return velocity [m/s] and angular velocity [rad/s] of a body without motion into contacts.

    `v` and `spin` are the velocities after the tick's forces, `contacts` (MOST, ROW) are rows of
    `convex.ROW`; writes the normal impulses (MOST,) [N s].
    """
    rows = np.zeros((3 * count, _WIDTH))
    change = np.zeros(6)
    for j in range(count):
        c = contacts[j]
        arm, n = (c[0], c[1], c[2]), (c[3], c[4], c[5])
        # Three rows per contact: normal, then two friction directions.
        one, two = _sides(n)
        closing = _describe(rows[3 * j], n, arm, v, spin, q, airframe)
        distance = c[6] + SLOP_M
        # An open gap may close within the tick; a penetration is removed slowly.
        share = 1.0 if distance > 0.0 else ERP
        aim = -closing - distance * share / tick_s
        rows[3 * j, 13] = aim * rows[3 * j, 12]
        for k in range(2):
            row = rows[3 * j + 1 + k]
            side = _describe(row, one if k == 0 else two, arm, v, spin, q, airframe)
            # Friction aims at no sliding.
            row[13] = -side * row[12]
    for _ in range(ITERATIONS):
        most = 0.0
        for j in range(count):
            row = rows[3 * j]
            before = row[14]
            # The right-hand side is the row's total impulse; `change` is the effect so far.
            row[14] = max(0.0, before + _wanted(row, change))
            _push(row, change, row[14] - before)
            most = max(most, ((row[14] - before) / row[12]) ** 2)
        # Friction after all normals: its limit depends on the normal impulse.
        for j in range(count):
            limit = FRICTION * rows[3 * j, 14]
            rubbed = _rub(rows[3 * j + 1], rows[3 * j + 2], change, limit)
            most = max(most, rubbed * rubbed)
        # Converged: the largest change of any row is small enough.
        if most <= ENOUGH:
            break
    for j in range(count):
        impulses[j] = rows[3 * j, 14]
    return (
        (v[0] + change[0], v[1] + change[1], v[2] + change[2]),
        (spin[0] + change[3], spin[1] + change[4], spin[2] + change[5]),
    )


_FIRST = ground_contact.FLOOR_ID + 1
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
        count = ground_contact.touch_floor(p, q, half, close, state.kept, state.many, state.rows, 0)
    if ground_contact.near_ground(solids.relief, p, radius, close):
        count = ground_contact.touch_ground(p, q, half, close, solids.relief, state.rows, count)
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
    """Move the vehicle by one tick; arguments up to `moving_us` as `PlantBody.move`.

    `half` (3,) are the half extents of the collision box [m], `box` its half diagonal and the
    distance below which bodies are close [m], `obstacle_speed` is the maximum of moving obstacles
    [m/s].

    Writes the motion after the tick to `row` (16,). Returns the number of contacts, in `state.rows`
    and `state.impulses`.
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
        self.names: Mapping[int, str] = dict(
            enumerate([FLOOR, *names], start=ground_contact.FLOOR_ID)
        )
        self._half = np.array([0.5 * body.width_m, 0.5 * body.width_m, 0.5 * body.height_m])
        radius = float(np.linalg.norm(self._half))
        """Half diagonal of the collision box [m]."""
        self._box = radius, BREAKING_SHARE * radius
        self._airframe = np.array(airframe)
        self._tick_s = tick_s
        self._obstacle_speed = greatest_speed(self._solids)
        self._state = ContactState(
            np.zeros((ground_contact.KEPT, 7)),
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
