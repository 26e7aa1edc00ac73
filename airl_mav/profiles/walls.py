"""Gates, and rooms with doors, of an arena specification."""

from __future__ import annotations

import math
from typing import Annotated

from airl_mav.core.fields import Each, ProfileModel, quantity

GATE = "gate"
"""Name of a wall with an opening in collision reports."""


class Gates(ProfileModel):
    """Walls from the west to the east wall, each with an opening, between the start and the goal.

    They stand one behind the other, and are as high as the walls of the arena. Ranges are
    [minimum, maximum], drawn uniformly, one by one.
    """

    count: Annotated[tuple[int, int], Each(0, 20, ascending=True)] = quantity(
        "how many", "1", default=(0, 0)
    )
    first_m: Annotated[tuple[float, float], Each(1, 500, ascending=True)] = quantity(
        "way from the start to the middle of the first", "m", default=(7.0, 8.0)
    )
    spacing_m: Annotated[tuple[float, float], Each(1, 500, ascending=True)] = quantity(
        "way from the middle of one to that of the next", "m", default=(9.0, 10.0)
    )
    lateral_m: Annotated[tuple[float, float], Each(-500, 500, ascending=True)] = quantity(
        "place of the middle of an opening, east of the start", "m", default=(-4.0, 4.0)
    )
    middle_m: Annotated[tuple[float, float], Each(0.2, 50, ascending=True)] = quantity(
        "height of the middle of an opening above the floor", "m", default=(2.0, 3.0)
    )
    width_m: Annotated[tuple[float, float], Each(0.2, 50, ascending=True)] = quantity(
        "width of an opening", "m", default=(2.0, 3.0)
    )
    height_m: Annotated[tuple[float, float], Each(0.2, 50, ascending=True)] = quantity(
        "height of an opening", "m", default=(1.6, 2.4)
    )
    thickness_m: float = quantity("of these walls", "m", ge=0.05, le=5, default=0.2)

    @property
    def last_m(self) -> float:
        """Maximum distance from the start to the north side of a gate [m]; 0 = no gates."""
        if self.count[1] == 0:
            return 0.0
        behind = (self.count[1] - 1) * self.spacing_m[1]
        return self.first_m[1] + behind + 0.5 * self.thickness_m


def check_gates(
    gates: Gates, *, west_m: float, east_m: float, height_m: float, free_m: float
) -> None:
    """Raise ValueError for gates that do not fit an arena's size.

    `west_m` and `east_m` are from the start to the walls of `height_m`; `free_m` is free around the
    start.
    """
    nearest = free_m + 0.5 * gates.thickness_m
    if gates.first_m[0] < nearest:
        raise ValueError(
            f"gates.first_m = {list(gates.first_m)}: accepted: value >= {nearest:g} m"
            " (start.clearance_m)"
        )
    if gates.count[1] > 1 and gates.spacing_m[0] <= gates.thickness_m:
        raise ValueError(
            f"gates.spacing_m = {list(gates.spacing_m)}: accepted: value > "
            f"{gates.thickness_m:g} m (gates.thickness_m)"
        )
    half = 0.5 * gates.width_m[1] + EDGE_M
    west, east = half - west_m, east_m - half
    if not west <= gates.lateral_m[0] <= gates.lateral_m[1] <= east:
        raise ValueError(
            f"gates.lateral_m = {list(gates.lateral_m)}: accepted: {west:g} <= value <= "
            f"{east:g} m (an opening of gates.width_m {gates.width_m[1]:g}, and {EDGE_M:g} m of"
            " wall on either side)"
        )
    half = 0.5 * gates.height_m[1] + EDGE_M
    if not half <= gates.middle_m[0] <= gates.middle_m[1] <= height_m - half:
        raise ValueError(
            f"gates.middle_m = {list(gates.middle_m)}: accepted: {half:g} <= value <= "
            f"{height_m - half:g} m (an opening of gates.height_m {gates.height_m[1]:g}, and "
            f"{EDGE_M:g} m of wall below and above, size.height_m {height_m:g})"
        )


ROOM_WALL = "room-wall"
"""Name of a wall between rooms, and of its lintels, in collision reports."""


EDGE_M = 0.1
"""Minimum wall on each side of a door or of a gate's opening, below and above it [m]."""


HEADROOM_M = 0.5
"""Minimum height of a door, and of a ceiling, above the flight altitude [m]."""


class Rooms(ProfileModel):
    """Walls that divide the arena into rooms; every room is reachable through doors.

    The walls are as high as the arena's. Ranges are [minimum, maximum], drawn uniformly.
    """

    count: Annotated[tuple[int, int], Each(0, 100, ascending=True)] = quantity(
        "how many rooms, beside the corridor; [0, 0]: the arena is not divided",
        "1",
        default=(0, 0),
    )
    least_side_m: float = quantity("least side of a room", "m", ge=1, le=100, default=5)
    thickness_m: float = quantity("of the walls", "m", ge=0.05, le=2, default=0.2)
    door_width_m: Annotated[tuple[float, float], Each(0.3, 20, ascending=True)] = quantity(
        "width of a door, drawn for each", "m", default=(1.6, 2.4)
    )
    door_height_m: Annotated[tuple[float, float], Each(0.3, 50, ascending=True)] = quantity(
        "height of a door, drawn for each; above it the wall goes on, and not where it is as high"
        " as the walls",
        "m",
        default=(3.2, 3.6),
    )
    door_clearance_m: float = quantity(
        "free way before and behind a door, for standing and moving obstacles",
        "m",
        ge=0,
        le=20,
        default=1.5,
    )
    extra_doors: float = quantity(
        "share of the neighbouring rooms without a door between them that get one as well; 0: one"
        " way leads from each room to each other, 1: neighbours have a door",
        "1",
        ge=0,
        le=1,
        default=0.25,
    )
    corridor_width_m: float | None = quantity(
        "width of a corridor along the longer side of the arena, on which every room opens; left"
        " out: there is none",
        "m",
        ge=1,
        le=50,
        default=None,
    )

    @property
    def drawn(self) -> bool:
        """True if the arena has rooms."""
        return self.count[1] > 0

    def slots(self, length_m: float) -> int:
        """Return the number of rooms of the minimum side in a row of a length [m]."""
        # The tolerance accepts exact fits in spite of rounding.
        return max(0, math.floor((length_m + self.thickness_m) / self._step_m + 1e-9))

    @property
    def _step_m(self) -> float:
        return self.least_side_m + self.thickness_m


def check_rooms(
    rooms: Rooms, *, north_m: float, east_m: float, height_m: float, flight_altitude_m: float
) -> None:
    """Raise ValueError for rooms that do not fit an arena's size.

    The floor is `north_m` x `east_m`; a vehicle must fit through doors at the flight altitude.
    """
    if rooms.count[0] == 0:
        raise ValueError(
            f"rooms.count = {list(rooms.count)}: accepted: 1 <= value, or [0, 0] for none"
        )
    _check_doors(rooms, height_m, flight_altitude_m)
    most, where = _most(rooms, max(north_m, east_m), min(north_m, east_m))
    if rooms.count[1] > most:
        raise ValueError(
            f"rooms.count = {list(rooms.count)}: accepted: value <= {most}, as many of "
            f"rooms.least_side_m {rooms.least_side_m:g} as fit {where} (size.north_m {north_m:g}, "
            f"size.east_m {east_m:g})"
        )
    if rooms.corridor_width_m is not None and rooms.count[0] < 2:
        raise ValueError(
            f"rooms.count = {list(rooms.count)}: accepted: 2 <= value, one on each side of the"
            " corridor"
        )


def _check_doors(rooms: Rooms, height_m: float, flight_altitude_m: float) -> None:
    low, high = flight_altitude_m + HEADROOM_M, height_m
    if not low <= rooms.door_height_m[0] <= rooms.door_height_m[1] <= high:
        raise ValueError(
            f"rooms.door_height_m = {list(rooms.door_height_m)}: accepted: {low:g} <= value <= "
            f"{high:g} m ({HEADROOM_M:g} m above flight_altitude_m {flight_altitude_m:g}, up to "
            "size.height_m)"
        )
    widest = rooms.least_side_m - 2.0 * EDGE_M
    if rooms.door_width_m[1] > widest:
        raise ValueError(
            f"rooms.door_width_m = {list(rooms.door_width_m)}: accepted: value <= {widest:g} m "
            f"(rooms.least_side_m {rooms.least_side_m:g}, and {EDGE_M:g} m of wall on either side)"
        )


def _most(rooms: Rooms, longer_m: float, shorter_m: float) -> tuple[int, str]:
    """Return the number of rooms that always fit into a floor, and their arrangement."""
    along = rooms.slots(longer_m)
    if rooms.corridor_width_m is None:
        return along * rooms.slots(shorter_m), "side by side"
    beside = shorter_m - rooms.corridor_width_m - 2.0 * rooms.thickness_m
    fits = beside >= 2.0 * rooms.least_side_m - 1e-9
    return (
        2 * along if fits else 0,
        f"on both sides of a corridor {rooms.corridor_width_m:g} m wide",
    )
