"""Interface of the vehicle's body in an arena: motion and contacts."""

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
        """Move the body by one tick.

        Args:
            at: Position, NED [m].
            force: All forces except gravity and contacts, NED [N].
            torque: NED [N m].
            before: (16,) motion before the tick.
            moving_us: Time since the moving obstacles started, at the end of the tick [µs].

        Returns:
            (16,) motion after the tick, see `engine.dynamics`; a new array.
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

        Args:
            position: NED [m].
            velocity: NED [m/s].
            quaternion: Body -> NED.
            rates: Angular velocity FRD [rad/s].
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
