"""How directions fall on a camera's image, and how wide an image can be."""

from __future__ import annotations

from typing import Literal, get_args

from airl_mav.core.errors import FieldError

Projection = Literal["pinhole", "cylindrical"]
"""How directions fall on the image; `camera.intrinsics.Intrinsics` has the formulas."""

PROJECTIONS: tuple[Projection, ...] = get_args(Projection)

PINHOLE_BELOW_DEG, CYLINDER_MOST_DEG = 170.0, 360.0
"""Horizontal field of view that a pinhole stays below, and that a cylinder may have [deg]."""


def check_fov(field: str, projection: Projection, horizontal_fov_deg: float) -> None:
    """Raise FieldError, of this name, for a field of view [deg] that a projection cannot have."""
    if projection == "pinhole" and horizontal_fov_deg >= PINHOLE_BELOW_DEG:
        raise FieldError(
            field,
            horizontal_fov_deg,
            f"value < {PINHOLE_BELOW_DEG:g} deg with projection 'pinhole', value <="
            f" {CYLINDER_MOST_DEG:g} deg with 'cylindrical'",
        )
