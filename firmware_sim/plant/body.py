"""The vehicle's body among the bodies of an arena: what a plant moves, and what it touches."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from airl_mav.arena.geometry import Arena
from airl_mav.core.frames import Vector
from airl_mav.vehicle.rotation import Quat, Vec

WALL_THICKNESS_M = 0.2

FLOOR = "floor"
"""Name of the floor in a collision event."""

WALLS = ("wall-north", "wall-south", "wall-east", "wall-west")

CEILING = "ceiling"


class Touch(NamedTuple):
    """Bodies in contact with the vehicle, by number."""

    close: frozenset[int]
    """Nearer than the contact threshold: a contact that was pressed lasts as long."""
    pressed: frozenset[int]
    """Those that push it."""


NOTHING = Touch(frozenset(), frozenset())


class Body(Protocol):
    """A rigid body with the vehicle's mass, inertia and collision box, in an arena."""

    @property
    def names(self) -> Mapping[int, str]:
        """Name of each body in a collision event, by number."""

    @property
    def touch(self) -> Touch:
        """Contacts in the newest tick."""

    def move(self, at: Vec, force: Vec, torque: Vec, before: Vector, moving_us: int) -> Vector:
        """Move on by one tick.

        Args:
            at: Where it is, NED [m].
            force: All forces but gravity and contacts, NED [N].
            torque: NED [N m].
            before: (16,) its motion before the tick.
            moving_us: How long what moves has been under way at the end of the tick [µs].

        Returns:
            (16,) the motion after the tick, as `plant.kinematics`; a new array.
        """

    def follow(self, motion: Vector) -> None:
        """Take the vehicle to be in a motion (16,) that something else has computed."""

    def look_around(self) -> None:
        """Take what moves to be elsewhere: time has passed without a `move`."""

    def rest(self) -> Vector:
        """Return the motion (16,) now, the vehicle taken to be at rest or in steady flight."""

    def put(
        self, position: Vec, velocity: Vec = ..., quaternion: Quat = ..., rates: Vec = ...
    ) -> Vector:
        """Put it somewhere, free of contacts so far; return the motion (16,) there.

        Args:
            position: NED [m].
            velocity: NED [m/s].
            quaternion: Body -> NED.
            rates: Angular velocity FRD [rad/s].
        """

    def close(self) -> None:
        """Release what it holds."""


def walls_of(arena: Arena) -> list[tuple[str, Vec, Vec]]:
    """Return walls and ceiling of an arena as boxes: name, centre NED, half extents N, E, D [m].

    Their inner faces are on the bounds.
    """
    b = arena.bounds
    t, h = 0.5 * WALL_THICKNESS_M, 0.5 * b.height
    north, east = 0.5 * (b.north_min + b.north_max), 0.5 * (b.east_min + b.east_max)
    half_n, half_e = 0.5 * (b.north_max - b.north_min), 0.5 * (b.east_max - b.east_min)
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
