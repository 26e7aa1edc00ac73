"""Vehicle's body in an arena: its interface, and walls, obstacles, ground and tours as arrays."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import TOP, Arena, Relief, Shape, no_relief
from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import BodyProfile
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate
from firmware_sim.engine.dynamics import quaternion

WALL_THICKNESS_M = 0.2

FLOOR = "floor"
"""Name of the floor in a collision event."""

WALLS = ("wall-north", "wall-south", "wall-east", "wall-west")

CEILING = "ceiling"


class Touch(NamedTuple):
    """Bodies in contact with the vehicle, by number."""

    close: frozenset[int]
    """Bodies within the contact threshold; a pressed contact lasts until it leaves this set."""
    pressed: frozenset[int]
    """Bodies that push the vehicle."""


NOTHING = Touch(frozenset(), frozenset())


class PlantBody(Protocol):
    """Rigid body with the vehicle's mass, inertia and collision box, in an arena."""

    @property
    def names(self) -> Mapping[int, str]:
        """Name of each body in a collision event, by number."""

    @property
    def touch(self) -> Touch:
        """Contacts in the newest tick."""

    def move(self, at: Vec, force: Vec, torque: Vec, before: Vector, moving_us: int) -> Vector:
        """Move the body by one tick; return the motion (16,) after it, a new array.

        Position [m], force without gravity and contacts [N] and torque [N m] are NED; `before`
        (16,) is the motion before the tick (`engine.dynamics`), `moving_us` the time since the
        moving obstacles started, at the end of the tick [µs].
        """

    def follow(self, motion: Vector) -> None:
        """Set the motion (16,), computed elsewhere."""

    def look_around(self) -> None:
        """Update the moving obstacles, because time has passed without a `move`."""

    def rest(self) -> Vector:
        """Return the current motion (16,), without acceleration."""

    def put(
        self, position: Vec, velocity: Vec = ..., quaternion: Quat = ..., rates: Vec = ...
    ) -> Vector:
        """Place the body in a motion and clear its contacts; return the motion (16,).

        Position [m] and velocity [m/s] are NED, the attitude body -> NED, rates FRD [rad/s].
        """

    def close(self) -> None:
        """Release the resources of the body."""


def walls_of(arena: Arena) -> list[tuple[str, Vec, Vec]]:
    """Return walls and ceiling of an arena as boxes: name, centre NED, half extents N, E, D [m].

    The inner faces are on the bounds.
    """
    b = arena.bounds
    # `t` is half the thickness, `h` half the height.
    t, h = 0.5 * WALL_THICKNESS_M, 0.5 * b.height
    north, east = 0.5 * (b.north_min + b.north_max), 0.5 * (b.east_min + b.east_max)
    half_n, half_e = 0.5 * (b.north_max - b.north_min), 0.5 * (b.east_max - b.east_min)
    # Walls overlap at the corners, so that no gap remains.
    along_east, along_north = (t, half_e + 2 * t, h), (half_n + 2 * t, t, h)
    centers = (
        (b.north_max + t, east, -h),
        (b.north_min - t, east, -h),
        (north, b.east_max + t, -h),
        (north, b.east_min - t, -h),
    )
    halves = (along_east, along_east, along_north, along_north)
    walls: list[tuple[str, Vec, Vec]] = list(zip(WALLS, centers, halves, strict=True))
    if b.ceiling:
        over = (half_n + 2 * t, half_e + 2 * t, t)
        walls.append((CEILING, (north, east, -b.height - t), over))
    return walls


def tour_arrays(arena: Arena) -> tuple[Vector, Vector]:
    """Return the tours of an arena's n moving obstacles, with up to k waypoints.

    Returns:
        times: (n, 1 + k) period of the tour, then the times of its waypoints [s], then inf.
        points: (n, k, 2) waypoints north, east [m].
    """
    n, k = len(arena.tours), max((len(tour.times_s) for tour in arena.tours), default=1)
    times, points = np.full((n, 1 + k), np.inf), np.zeros((n, k, 2))
    for i, tour in enumerate(arena.tours):
        times[i, 0] = tour.times_s[-1]
        times[i, 1 : 1 + len(tour.times_s)] = tour.times_s
        points[i, : len(tour.points)] = tour.points
    return times, points


@kernel
def place_at(
    time_us: int, times_s: Vector, points: Vector, leg: NDArray[np.int64], i: int
) -> tuple[float, float]:
    """Return north, east [m] of moving obstacle i, `time_us` [µs] after the start of the episode.

    `times_s` and `points` are from `tour_arrays`; `leg` (n,), the index of the last waypoint
    passed, is updated.
    """
    # Tours repeat with their period.
    t = (time_us / US_PER_S) % times_s[i, 0]
    passed = times_s[i, 1:]
    # Start at the last waypoint passed; a new tour starts at the first.
    k = leg[i] if passed[leg[i]] <= t else 0
    while passed[k + 1] <= t:
        k += 1
    leg[i] = k
    # Same order of operations as numpy.interp: body and image are bit-identical.
    a, b, step = points[i, k], points[i, k + 1], passed[k + 1] - passed[k]
    north = (b[0] - a[0]) / step * (t - passed[k]) + a[0]
    east = (b[1] - a[1]) / step * (t - passed[k]) + a[1]
    return north, east


class Solids(NamedTuple):
    """Walls and obstacles of an arena: n solids, of which the last m move; and its ground."""

    shape: NDArray[np.int8]  # (n,)
    center: Vector  # (n, 3) NED [m]; updated for moving ones
    size: Vector  # (n, 3) half extents [m]
    yaw: Vector  # (n,) [rad]
    times_s: Vector  # (m, 1 + k) from `tour_arrays`
    points: Vector  # (m, k, 2)
    leg: NDArray[np.int64]  # (m,)
    relief: Relief


def solids_of(arena: Arena | None) -> tuple[Solids, list[str]]:
    """Return walls, obstacles and ground of an arena, and their names; None = no solids."""
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


def greatest_speed(solids: Solids) -> float:
    """Return the maximum speed of a moving obstacle [m/s]."""
    fastest = 0.0
    for times, points in zip(solids.times_s, solids.points, strict=True):
        # Unused entries are inf.
        passed = times[1:][np.isfinite(times[1:])]
        ways = np.hypot(*np.diff(points[: len(passed)], axis=0).T)
        took = np.diff(passed)
        if len(took):
            fastest = max(fastest, float(np.max(ways / took)))
    return fastest


@kernel
def room_among(solids: Solids, p: Vec, radius: float) -> float:
    """Return a lower bound [m] of the distance of a sphere around the vehicle to solids."""
    room: float = math.inf
    for i in range(len(solids.shape)):
        c, s = math.cos(solids.yaw[i]), math.sin(solids.yaw[i])
        dx, dy = p[0] - solids.center[i, 0], p[1] - solids.center[i, 1]
        # Distance per axis in the solid's own axes; 0 inside.
        x = max(0.0, abs(c * dx + s * dy) - solids.size[i, 0])
        y = max(0.0, abs(c * dy - s * dx) - solids.size[i, 1])
        z = max(0.0, abs(p[2] - solids.center[i, 2]) - solids.size[i, 2])
        room = min(room, math.sqrt(x * x + y * y + z * z))
    # A lower bound: a sphere contains the vehicle's box.
    return room - radius


class Room:
    """Distances from a vehicle's collision box to the bodies of an arena."""

    def __init__(self, arena: Arena | None, body: BodyProfile) -> None:
        """Store the solids of an arena (None = an endless floor) and the collision box."""
        self._solids, _ = solids_of(arena)
        relief = self._solids.relief
        self._top_m = float(relief.grid[TOP]) if len(relief.heights) else 0.0
        """Height of the highest hill [m]."""
        self._half = 0.5 * np.array([body.width_m, body.width_m, body.height_m])
        self.reach_m = math.hypot(*self._half.tolist())
        """Distance from the centre of the box to its corners [m]."""
        self.closing_m_s = greatest_speed(self._solids)
        """Maximum speed of an obstacle [m/s]."""

    def above_floor_m(self, motion: Vector) -> float:
        """Return the height of the box's lowest corner above floor and hills [m]; motion (16,)."""
        lowest_m: float = _lowest(motion, self._half)
        # Conservative: height above the highest hill, wherever it is.
        return lowest_m - self._top_m

    def among_solids_m(self, motion: Vector, moving_us: int) -> float:
        """Return a lower bound of the distance to walls and obstacles [m] in a motion (16,).

        `moving_us` is the time since the moving obstacles started [µs].
        """
        room: float = _among_solids(self._solids, motion, self.reach_m, moving_us)
        return room


@kernel
def _lowest(motion: Vector, half: Vector) -> float:
    lowest_m: float = -motion[2] - reach_along(quaternion(motion), half, (0.0, 0.0, 1.0))
    return lowest_m


@kernel
def _among_solids(solids: Solids, motion: Vector, radius: float, moving_us: int) -> float:
    n, moving = len(solids.shape), len(solids.leg)
    for i in range(moving):
        north, east = place_at(moving_us, solids.times_s, solids.points, solids.leg, i)
        solids.center[n - moving + i, 0] = north
        solids.center[n - moving + i, 1] = east
    return room_among(solids, (motion[0], motion[1], motion[2]), radius)


BREAKING_SHARE = 0.02
"""Distance below which bodies are close, as a fraction of the box's half diagonal (Bullet's
gContactBreakingThreshold)."""


@kernel
def reach_along(q: Quat, half: Vector, n: Vec) -> float:
    """Return the extent [m] of a box at attitude q from its centre along a unit vector."""
    a = rotate(conjugate(q), n)
    reach: float = abs(a[0]) * half[0] + abs(a[1]) * half[1] + abs(a[2]) * half[2]
    return reach
