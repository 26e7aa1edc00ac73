"""Collision box of the vehicle, and the row format of its contacts."""

from __future__ import annotations

from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate

ROW = 8
"""Number of values in a contact row: arm from the vehicle's centre NED [m], normal NED from the
other body to the vehicle, distance [m], and owner (`FLOOR_ID`, and so on)."""

MOST = 32
"""Maximum number of contacts."""

BREAKING_SHARE = 0.02
"""Distance below which bodies are close, as a fraction of the box's half diagonal (Bullet's
gContactBreakingThreshold)."""


@kernel
def corner_of(k: int, half: Vector) -> Vec:
    """Return corner k, 0 to 7, of a box with half extents (3,) [m], in box axes."""
    return (
        half[0] if k & 1 else -half[0],
        half[1] if k & 2 else -half[1],
        half[2] if k & 4 else -half[2],
    )


@kernel
def reach_along(q: Quat, half: Vector, n: Vec) -> float:
    """Return the extent [m] of a box at attitude q from its centre along a unit vector."""
    a = rotate(conjugate(q), n)
    reach: float = abs(a[0]) * half[0] + abs(a[1]) * half[1] + abs(a[2]) * half[2]
    return reach


@kernel
def note(rows: Vector, count: int, arm: Vec, normal: Vec, distance: float, owner: int) -> int:
    """Write a contact to row `count`, if there is room; return the new count."""
    if count == MOST:
        return count
    row = rows[count]
    row[0], row[1], row[2] = arm
    row[3], row[4], row[5] = normal
    row[6], row[7] = distance, owner
    return count + 1
