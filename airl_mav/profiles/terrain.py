"""Terrain in an arena's profile: hills that rise above the floor."""

from __future__ import annotations

import math
from typing import Annotated

from airl_mav.core.fields import Each, ProfileModel, quantity

LEAST_RELIEF_M = 0.2
"""Minimum height of the highest hill [m]."""

MOST_CELLS = 16_384
"""Maximum cells of the ground's grid: two triangles each."""

FINEST_M = 0.25
"""Minimum side of a cell [m]."""

CELLS_A_HILL = 12
"""Cells across a hill, where the floor is small enough."""

LEAST_CELLS_A_HILL = 5
"""Minimum cells across a hill."""


class Terrain(ProfileModel):
    """Hills on the floor. The ground is never below the floor."""

    relief_m: Annotated[tuple[float, float], Each(0, 50, ascending=True)] = quantity(
        "height of the highest hill above the floor, drawn from [least, greatest]; [0, 0]: there"
        " are none",
        "m",
        default=(0.0, 0.0),
    )
    scale_m: float = quantity("width of a hill, on average", "m", ge=2, le=250, default=15)
    flat_m: float = quantity(
        "radius around the start in which the ground is level; beyond it hills begin to rise",
        "m",
        ge=1,
        le=250,
        default=4,
    )

    @property
    def drawn(self) -> bool:
        """True if the arena has hills."""
        return self.relief_m[1] > 0.0

    def pitch_m(self, north_m: float, east_m: float) -> float:
        """Return the side of the ground's cells on a floor of these sides [m]."""
        coarse = math.sqrt(north_m * east_m / MOST_CELLS)
        return max(FINEST_M, self.scale_m / CELLS_A_HILL, coarse)


def check_terrain(
    terrain: Terrain,
    *,
    north_m: float,
    east_m: float,
    height_m: float,
    start_m: tuple[float, float],
) -> None:
    """Raise ValueError for hills that do not fit an arena's size.

    The floor is `north_m` x `east_m`; `start_m` is the start's distance from the south and the west
    wall.
    """
    least, greatest = terrain.relief_m
    # Obstacles need some height between the highest hill and the top of the walls.
    if least < LEAST_RELIEF_M or greatest > height_m - LEAST_RELIEF_M:
        raise ValueError(
            f"terrain.relief_m = {list(terrain.relief_m)}: accepted: {LEAST_RELIEF_M:g} <= value <="
            f" {height_m - LEAST_RELIEF_M:g} m ({LEAST_RELIEF_M:g} m less than size.height_m, the"
            " walls), or [0, 0] for a flat floor"
        )
    finest = LEAST_CELLS_A_HILL * terrain.pitch_m(north_m, east_m)
    if terrain.scale_m < finest:
        raise ValueError(
            f"terrain.scale_m = {terrain.scale_m:g}: accepted: value >= {finest:.3g} m on a floor "
            f"of {north_m:g} x {east_m:g} m (the ground has {MOST_CELLS} cells at most, "
            f"{LEAST_CELLS_A_HILL} across a hill)"
        )
    # Hills reach their full height one scale beyond the level area.
    south, west = start_m
    farthest = math.hypot(max(south, north_m - south), max(west, east_m - west))
    most = farthest - terrain.scale_m
    if terrain.flat_m > most:
        raise ValueError(
            f"terrain.flat_m = {terrain.flat_m:g}: accepted: value <= {most:.3g} m, "
            f"terrain.scale_m {terrain.scale_m:g} less than it is from the start to the farthest "
            "corner"
        )
