"""Observations of a network: layout, camera, additional inputs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core import plugins
from airl_mav.core.fields import ProfileModel, later_field, quantity
from airl_mav.policy.layouts import INPUTS, LEAST_ROWS, SHIPPED, layout_of
from airl_mav.profiles import projections
from airl_mav.profiles.camera import Coefficients, camera_named

LayoutName = Annotated[str, plugins.part_name(plugins.LAYOUTS, SHIPPED)]

if TYPE_CHECKING:
    Told = str
else:
    Told = Literal[tuple(INPUTS)]

SAME_DEG = 0.1
"""Maximum angle between matching lenses at any position of the image [deg]."""

MOST_FRAMES = 8
"""Maximum number of images in an observation."""

Frames = Annotated[
    int,
    quantity(
        "images that the network sees: of this decision, and of so many less one before it",
        "1",
        ge=1,
        le=MOST_FRAMES,
    ),
]

GoalHeight = Annotated[
    bool,
    Field(
        description="whether `goal` has a fourth number: how far the goal lies below the vehicle;"
        " only where goals have a height, and not with layout paper"
    ),
]


Width = Annotated[int, quantity("width of the image that the network sees", "px", ge=4, le=640)]

SeenProjection = Annotated[
    projections.Projection,
    Field(
        description="how directions fall on the image: pinhole, cylindrical for a field of view of"
        " up to 360 deg, or fisheye (equidistant but for its distortion) of up to 190 deg"
    ),
]

FieldOfView = Annotated[
    float,
    quantity(
        "horizontal field of view, less than 170 with a pinhole",
        "deg",
        gt=10,
        le=projections.CYLINDER_MOST_DEG,
    ),
]

SeenDistortion = Annotated[Coefficients, quantity("coefficients k1, k2, k3, k4 of a fisheye", "1")]

Range = Annotated[
    float,
    quantity(
        "depth from which on everything looks far; rgb and grey images have no such depth",
        "m",
        gt=0.5,
        le=65,
    ),
]

CameraName = Annotated[str, AfterValidator(camera_named)]
"""Name of an additional camera."""


class SeenCamera(ProfileModel):
    """An additional camera, whose image is an input besides the main camera's."""

    height_px: int = quantity(
        "height of the image that the network sees", "px", ge=LEAST_ROWS, le=480
    )
    width_px: Width
    projection: SeenProjection = "pinhole"
    horizontal_fov_deg: FieldOfView
    distortion: SeenDistortion = later_field(projections.UNDISTORTED)
    range_m: Range
    kind: projections.CameraKind = Field(
        default="depth", description="pixel type of the camera, the prefix of the image's key"
    )
    frames: Frames = 1

    @model_validator(mode="after")
    def _sees(self) -> SeenCamera:
        fov_deg = self.horizontal_fov_deg
        projections.check_lens("horizontal_fov_deg", self.projection, fov_deg, self.distortion)
        return self

    @property
    def camera_rows(self) -> int:
        """Rows of the image that come from the camera: all."""
        return self.height_px

    @property
    def channels(self) -> int:
        """Channels of the network's image, over all frames."""
        return projections.CHANNELS[self.kind] * self.frames


class ObservationSpec(ProfileModel):
    """Inputs of a network, and the cameras that can provide them."""

    layout: LayoutName = Field(default="body", description="which arrays it takes")
    height_px: int = quantity(
        "height of the image that the network sees; less than 4 only with layout scan",
        "px",
        ge=1,
        le=480,
    )
    width_px: Width
    projection: SeenProjection = "pinhole"
    horizontal_fov_deg: FieldOfView
    distortion: SeenDistortion = later_field(projections.UNDISTORTED)
    range_m: Range
    kind: projections.CameraKind = Field(
        default="depth",
        description="pixel type of the camera and key of the image: depth, rgb or grey",
    )
    frames: Frames = 1
    in_flight: tuple[Told, ...] = Field(
        default=(),
        description="additional inputs of the network: "
        + "; ".join(f"{name}, {each.meaning}" for name, each in INPUTS.items()),
    )
    goal_height: GoalHeight = later_field(default=False)
    cameras: dict[CameraName, SeenCamera] = later_field(
        dict,
        "further cameras that the network sees by, by name; the image of camera NAME"
        " has the key KIND_NAME",
    )

    @model_validator(mode="after")
    def _fits_the_layout(self) -> ObservationSpec:
        if (problem := layout_of(self.layout).problem(self)) is not None:
            raise ValueError(problem)
        fov_deg = self.horizontal_fov_deg
        projections.check_lens("horizontal_fov_deg", self.projection, fov_deg, self.distortion)
        return self

    @property
    def camera_rows(self) -> int:
        """Rows of the image that come from the camera."""
        return self.height_px - layout_of(self.layout).strip_rows

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of the image as it goes into the network."""
        return layout_of(self.layout).image_shape(self)[1:]

    @property
    def goal_numbers(self) -> int:
        """Length of `goal` in shipped layouts."""
        return 4 if self.goal_height else 3

    @property
    def channels(self) -> int:
        """Channels of the network's image, over all frames."""
        return layout_of(self.layout).image_shape(self)[0]

    @property
    def further_keys(self) -> dict[str, str]:
        """Keys of the additional cameras' images, by camera name."""
        return {name: f"{seen.kind}_{name}" for name, seen in self.cameras.items()}


def further_mismatch(spec: ObservationSpec, cameras: Mapping[str, Intrinsics]) -> str | None:
    """Return why additional cameras, by name, cannot serve a layout, or None when they can.

    Cameras that the layout does not name are ignored.
    """
    for name, seen in spec.cameras.items():
        if name not in cameras:
            others = "".join(f", {each!r}" for each in cameras)
            return f"no camera {name!r}; there is the main one{others or ' alone'}"
        if (reason := camera_mismatch(seen, cameras[name])) is not None:
            return f"camera {name!r}: {reason}"
    return None


def camera_mismatch(spec: ObservationSpec | SeenCamera, camera: Intrinsics) -> str | None:
    """Return why a camera cannot serve a layout, or None when it can.

    The camera's kind, projection, field of view and distortion must match. Its image size must be a
    whole multiple of the network's.
    """
    if camera.kind != spec.kind:
        return f"{camera.kind} camera; accepted: {spec.kind}"
    rows, columns = spec.camera_rows, spec.width_px
    if (
        camera.width % columns
        or camera.height % rows
        or camera.width * rows != (camera.height * columns)
    ):
        return (
            f"camera {camera.width}x{camera.height} px; accepted: {columns}x{rows} px "
            "or a whole multiple"
        )
    if camera.projection != spec.projection:
        return f"{camera.projection} camera; accepted: {spec.projection}"
    fov_deg = math.degrees(camera.horizontal_fov_rad)
    if abs(fov_deg - spec.horizontal_fov_deg) > SAME_DEG:
        return (
            f"camera with a horizontal field of view of {fov_deg:.1f} deg; "
            f"accepted: {spec.horizontal_fov_deg:.1f} deg"
        )
    if (apart_deg := _apart_deg(spec, camera)) > SAME_DEG:
        return (
            f"camera with a distortion of {list(camera.distortion)}, {apart_deg:.1f} deg away;"
            f" accepted: {list(spec.distortion)}"
        )
    return None


def _apart_deg(spec: ObservationSpec | SeenCamera, camera: Intrinsics) -> float:
    """Return the maximum angle between the rays of two lenses at one image position [deg].

    Both have the same field of view. Positions run from the middle of the image to its edge.
    """
    if spec.distortion == camera.distortion:
        return 0.0
    half = 0.5 * math.radians(spec.horizontal_fov_deg)
    rim = float(projections.distorted(half, spec.distortion))
    places = np.linspace(0.0, 1.0, 65)
    theirs = projections.undistorted(
        places * (0.5 * camera.width / camera.focal), camera.distortion
    )
    apart = np.abs(projections.undistorted(places * rim, spec.distortion) - theirs)
    # Rounding may put the edge beyond the rim of either lens.
    return math.degrees(float(np.max(apart[np.isfinite(apart)])))
