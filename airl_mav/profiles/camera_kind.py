"""Kinds of cameras: the content of their pixels, and their projection."""

from __future__ import annotations

from typing import Final, Literal, get_args

from airl_mav.core.errors import FieldError

CameraKind = Literal["depth", "rgb", "grey"]
"""`depth`: uint16 (h, w), Z16 in millimetres. `rgb`: uint8 (h, w, 3), sRGB. `grey`: uint8
(h, w, 1), luma of the sRGB numbers."""

Renderer = Literal["raycast", "mitsuba"]
"""Renderer of images: the ray caster, or Mitsuba's path tracer as the reference for colour."""

SLOW: Final[frozenset[Renderer]] = frozenset({"mitsuba"})
"""Renderers that need longer than a tick for an image."""

KINDS: Final[tuple[CameraKind, ...]] = get_args(CameraKind)

CHANNELS: Final[dict[CameraKind, int]] = {"depth": 1, "rgb": 3, "grey": 1}
"""Channels of a network's image."""


def shape_of(kind: CameraKind, height: int, width: int) -> tuple[int, ...]:
    """Return the shape of a camera's image: (h, w) for depth, (h, w, channels) for colour."""
    return (height, width) if kind == "depth" else (height, width, CHANNELS[kind])


Projection = Literal["pinhole", "cylindrical", "fisheye"]
"""Projection of directions to the image; `camera.intrinsics.Intrinsics` has the formulas."""

PROJECTIONS: tuple[Projection, ...] = get_args(Projection)

PINHOLE_BELOW_DEG, CYLINDER_MOST_DEG, FISHEYE_MOST_DEG = 170.0, 360.0, 190.0
"""Limit of a pinhole's horizontal field of view, exclusive, and of the others, inclusive [deg].

A fisheye sees up to half its field of view from the optical axis, in any direction."""


def check_fov(field: str, projection: Projection, horizontal_fov_deg: float) -> None:
    """Raise FieldError, naming the field, for a field of view [deg] beyond a projection's limit."""
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
