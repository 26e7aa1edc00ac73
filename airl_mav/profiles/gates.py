"""Gates in an arena's profile: walls with openings between start and goal."""

from __future__ import annotations

from typing import Annotated

from airl_mav.core.fields import Each, ProfileModel, quantity

GATE = "gate"
"""Name of a wall with an opening in collision reports."""

EDGE_M = 0.1
"""Minimum wall on each side of an opening, below and above it [m]."""


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
