"""Assets made of parts: trees, lamp posts, fences, window frames.

A part is a box, a cylinder or a sphere like every other obstacle, so that cameras, contacts,
planners and renderers treat it as one. Shipped assets have common sizes in round numbers.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import (
    Field,
)

from airl_mav.core.fields import ProfileModel, later_field, optional, quantity
from airl_mav.profiles.loading import CheckedFile

MOST_TRIANGLES = 200_000
"""Maximum triangles of a mesh."""

GREATEST_M = 50.0
"""Maximum distance of a corner from its asset's position, along each axis [m]."""


class MeshFile(CheckedFile):
    """Triangles that cameras render in place of the parts; collisions use the parts."""

    file: str = Field(
        min_length=1,
        description="the triangles, as `airl asset` writes them (.npz); a path from the profile's"
        " folder",
    )


MOST_PARTS = 128
"""Maximum parts of an asset: every ray and every contact checks each part."""


class _Placed(ProfileModel):
    """Position of a part relative to the asset's position on the floor."""

    forward_m: float = quantity(
        "of its middle, ahead of the asset's place", "m", ge=-10, le=10, default=0
    )
    right_m: float = quantity(
        "of its middle, right of the asset's place", "m", ge=-10, le=10, default=0
    )
    bottom_m: float = quantity(
        "height of its underside above the floor", "m", ge=0, le=50, default=0
    )
    material: str | None = optional(
        "a material by name; left out: one that is drawn for the whole asset"
    )

    @property
    def yaw_rad(self) -> float:
        """Heading in the asset [rad]; 0 for round parts."""
        return 0.0


class BoxPart(_Placed):
    """A box."""

    shape: Literal["box"]
    length_m: float = quantity("along the asset's own forward axis", "m", ge=0.01, le=20)
    width_m: float = quantity("across it", "m", ge=0.01, le=20)
    height_m: float = quantity("from its underside up", "m", ge=0.01, le=50)
    yaw_deg: float = quantity(
        "heading of its length in the asset", "deg", ge=-180, le=180, default=0
    )

    @property
    def half_size_m(self) -> tuple[float, float, float]:
        """Half extents along the box's axes [m], as `Obstacles.half_size`."""
        return 0.5 * self.length_m, 0.5 * self.width_m, 0.5 * self.height_m

    @property
    def yaw_rad(self) -> float:
        """Heading in the asset [rad]."""
        return math.radians(self.yaw_deg)


class CylinderPart(_Placed):
    """An upright cylinder."""

    shape: Literal["cylinder"]
    radius_m: float = quantity("radius", "m", ge=0.01, le=10)
    height_m: float = quantity("from its underside up", "m", ge=0.01, le=50)

    @property
    def half_size_m(self) -> tuple[float, float, float]:
        """Radius twice and half the height [m], as `Obstacles.half_size`."""
        return self.radius_m, self.radius_m, 0.5 * self.height_m


class SpherePart(_Placed):
    """A sphere."""

    shape: Literal["sphere"]
    radius_m: float = quantity("radius", "m", ge=0.01, le=10)

    @property
    def half_size_m(self) -> tuple[float, float, float]:
        """Radius three times [m], as `Obstacles.half_size`."""
        return self.radius_m, self.radius_m, self.radius_m


Part = Annotated[BoxPart | CylinderPart | SpherePart, Field(discriminator="shape")]


class Asset(ProfileModel):
    """An asset of parts at fixed relative positions."""

    parts: Annotated[tuple[Part, ...], Field(min_length=1, max_length=MOST_PARTS)] = Field(
        description="boxes, cylinders and spheres, each with its shape, place and size"
    )
    mesh: MeshFile | None = later_field(
        None,
        "triangles that cameras see in place of the parts; its material is that of the first part",
    )

    @property
    def top_m(self) -> float:
        """Height of the highest point above the floor [m]."""
        return max(part.bottom_m + 2.0 * part.half_size_m[2] for part in self.parts)


def _box(
    length: float, width: float, height: float, forward: float, right: float, bottom: float
) -> BoxPart:
    return BoxPart(
        shape="box",
        length_m=length,
        width_m=width,
        height_m=height,
        forward_m=forward,
        right_m=right,
        bottom_m=bottom,
    )


def _post(
    radius: float, height: float, forward: float = 0.0, right: float = 0.0, bottom: float = 0.0
) -> CylinderPart:
    return CylinderPart(
        shape="cylinder",
        radius_m=radius,
        height_m=height,
        forward_m=forward,
        right_m=right,
        bottom_m=bottom,
    )


def _ball(radius: float, forward: float, right: float, bottom: float) -> SpherePart:
    return SpherePart(
        shape="sphere", radius_m=radius, forward_m=forward, right_m=right, bottom_m=bottom
    )


def _of(material: str, *parts: Part) -> tuple[Part, ...]:
    """Return parts of a material."""
    return tuple(part.model_copy(update={"material": material}) for part in parts)


ASSETS: dict[str, Asset] = {
    "tree": Asset(
        parts=(
            *_of("bark", _post(0.14, 2.4)),
            *_of(
                "foliage",
                _ball(0.95, 0.0, 0.0, 2.2),
                _ball(0.7, 0.6, 0.3, 1.9),
                _ball(0.65, -0.5, 0.5, 2.1),
                _ball(0.6, -0.1, -0.65, 1.9),
            ),
        )
    ),
    "lamp-post": Asset(
        parts=_of(
            "steel", _post(0.06, 4.0), _box(1.0, 0.06, 0.06, 0.5, 0, 3.94), _ball(0.16, 1, 0, 3.7)
        )
    ),
    "chair": Asset(
        parts=_of(
            "wood",
            *(_box(0.05, 0.05, 0.42, x, y, 0.0) for x in (-0.2, 0.2) for y in (-0.2, 0.2)),
            _box(0.45, 0.45, 0.04, 0, 0, 0.42),
            _box(0.04, 0.45, 0.48, -0.205, 0, 0.46),
        )
    ),
    "rock": Asset(
        parts=_of(
            "concrete",
            _ball(1.0, 0.0, 0.0, 0.0),
            _ball(0.75, 0.7, 0.3, 0.0),
            _ball(0.8, -0.3, -0.6, 0.5),
        )
    ),
    "wire": Asset(
        parts=(
            *_of("bark", _post(0.1, 4.5, right=-4.0), _post(0.1, 4.5, right=4.0)),
            *_of("steel", *(_box(0.02, 8.0, 0.02, 0.0, 0.0, z) for z in (2.4, 3.2, 4.0))),
        )
    ),
    "fence": Asset(
        parts=_of(
            "wood",
            *(_post(0.05, 3.0, right=y) for y in (-3.0, -1.5, 0.0, 1.5, 3.0)),
            *(_box(0.03, 6.0, 0.1, 0.0, 0.0, z) for z in (0.3, 0.9, 1.5, 2.1, 2.7)),
        )
    ),
    "pylon": Asset(
        parts=_of(
            "steel",
            *(_post(0.05, 4.6, x, y) for x in (-0.4, 0.4) for y in (-0.4, 0.4)),
            *(_box(0.9, 0.05, 0.05, 0.0, y, z) for y in (-0.4, 0.4) for z in (1.2, 2.4, 3.6)),
            *(_box(0.05, 0.9, 0.05, x, 0.0, z) for x in (-0.4, 0.4) for z in (1.2, 2.4, 3.6)),
            _box(0.12, 3.6, 0.12, 0.0, 0.0, 4.0),
        )
    ),
    "window-frame": Asset(
        parts=_of(
            "plaster",
            _box(0.2, 4.0, 1.6, 0.0, 0.0, 0.0),
            _box(0.2, 1.1, 1.8, 0.0, -1.45, 1.6),
            _box(0.2, 1.1, 1.8, 0.0, 1.45, 1.6),
            _box(0.2, 4.0, 0.6, 0.0, 0.0, 3.4),
        )
    ),
}
"""Assets available in every arena. They extend across their forward axis; `wire` has three wires
between two poles, and the opening of `window-frame`, 1.8 m each way, is at flight height."""
