"""What the pixels of a camera's image are: depth, colour, or shades of grey."""

from __future__ import annotations

from typing import Final, Literal, get_args

CameraKind = Literal["depth", "rgb", "grey"]
"""`depth`: uint16 (h, w), Z16 in millimetres. `rgb`: uint8 (h, w, 3), sRGB. `grey`: uint8
(h, w, 1), luma of the sRGB numbers."""

Renderer = Literal["raycast", "mitsuba"]
"""What draws images: the ray caster, or Mitsuba's path tracer, its reference for colour."""

SLOW: Final[frozenset[Renderer]] = frozenset({"mitsuba"})
"""Renderers that take longer for an image than a tick has."""

KINDS: Final[tuple[CameraKind, ...]] = get_args(CameraKind)

CHANNELS: Final[dict[CameraKind, int]] = {"depth": 1, "rgb": 3, "grey": 1}
"""Channels of the image that a network is given."""


def shape_of(kind: CameraKind, height: int, width: int) -> tuple[int, ...]:
    """Return the shape of a camera's image: (h, w) of depth, (h, w, channels) of colour."""
    return (height, width) if kind == "depth" else (height, width, CHANNELS[kind])
