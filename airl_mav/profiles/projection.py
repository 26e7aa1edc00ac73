"""How directions fall on a camera's image, and how wide an image can be."""

from __future__ import annotations

from typing import Literal, get_args

from airl_mav.core.errors import FieldError

Projection = Literal["pinhole", "cylindrical", "fisheye"]
"""How directions fall on the image; `camera.intrinsics.Intrinsics` has the formulas."""

PROJECTIONS: tuple[Projection, ...] = get_args(Projection)

PINHOLE_BELOW_DEG, CYLINDER_MOST_DEG, FISHEYE_MOST_DEG = 170.0, 360.0, 190.0
"""Horizontal field of view that a pinhole stays below, and that the others may have [deg].

A fisheye sees nothing that is farther from its optical axis than half of it, in any direction."""


def check_fov(field: str, projection: Projection, horizontal_fov_deg: float) -> None:
    """Raise FieldError, of this name, for a field of view [deg] that a projection cannot have."""
    beyond = {
        "pinhole": horizontal_fov_deg >= PINHOLE_BELOW_DEG,
        "cylindrical": horizontal_fov_deg > CYLINDER_MOST_DEG,
        "fisheye": horizontal_fov_deg > FISHEYE_MOST_DEG,
    }
    if beyond[projection]:
        raise FieldError(
            field,
            horizontal_fov_deg,
            f"value < {PINHOLE_BELOW_DEG:g} deg with projection 'pinhole', value <="
            f" {CYLINDER_MOST_DEG:g} deg with 'cylindrical', value <= {FISHEYE_MOST_DEG:g} deg with"
            " 'fisheye'",
        )
