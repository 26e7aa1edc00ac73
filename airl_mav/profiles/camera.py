"""Camera of a vehicle profile: image, mount, depth matching, image formation; their checks."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias

from pydantic import (
    BeforeValidator,
    ValidationError,
    model_validator,
)

from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import Each, ProfileModel, later_field, quantity, section
from airl_mav.profiles import projections

if TYPE_CHECKING:
    from airl_mav.faults import Fault
    from airl_mav.profiles.vehicle import SensorNoise

    Imaging: TypeAlias = Any
else:
    Imaging = section("camera.imaging")

Coefficients = Annotated[
    projections.Distortion, Each(-projections.MOST_COEFFICIENT, projections.MOST_COEFFICIENT)
]
"""Distortion coefficients of a fisheye."""


class Stereo(ProfileModel):
    """Stereo matching of a depth camera with two imagers; see `airl_mav.camera.noise`."""

    baseline_m: float = quantity("distance between the imagers", "m", ge=0.01, le=1)
    focal_px: float = quantity(
        "focal length of the imagers, at the resolution that is matched", "px", ge=10, le=5000
    )
    noise_px: float = quantity("disparity noise, sd of a pixel", "px", ge=0, le=5)
    step_px: float = quantity("step of the disparity; 0: none", "px", ge=0, le=1)
    most_px: float = quantity(
        "greatest disparity that is searched: sets the least depth", "px", ge=1, le=1000
    )


class Ranging(ProfileModel):
    """Errors of a lidar or another range sensor; see `airl_mav.camera.noise`."""

    noise_m: float = quantity("noise of a range, sd", "m", ge=0, le=5, default=0.0)
    noise_share: float = quantity(
        "noise that grows with the range, sd as a share of it", "1", ge=0, le=0.5, default=0.0
    )
    lost_share: float = quantity(
        "share of returns that are lost, drawn anew with every image",
        "1",
        ge=0,
        le=0.9,
        default=0.0,
    )
    least_m: float = quantity("least depth that gives a return", "m", ge=0, le=10, default=0.0)


class Camera(ProfileModel):
    """A camera: the main one looks ahead or all round, additional ones in any direction."""

    kind: projections.CameraKind = later_field(
        "depth",
        "what its pixels are: depth; rgb, sRGB colours of 8 bits a channel; or grey,"
        " their luma (ITU-R BT.601)",
    )
    projection: projections.Projection = later_field(
        "pinhole",
        "pinhole, cylindrical for a field of view of up to 360 deg, or fisheye"
        " (equidistant but for its distortion) of up to 190 deg",
    )
    width_px: int = quantity("image width", "px", ge=8, le=640)
    height_px: int = quantity(
        "image height; less than 6, down to the one row of a planar lidar, only of a cylinder",
        "px",
        ge=1,
        le=480,
    )
    horizontal_fov_deg: float = quantity(
        "horizontal field of view, less than 170 with a pinhole",
        "deg",
        gt=10,
        le=projections.CYLINDER_MOST_DEG,
    )
    distortion: Coefficients = quantity(
        "coefficients k1, k2, k3, k4 of a fisheye, as OpenCV's fisheye calibration and ROS's"
        " equidistant model have them: theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 +"
        " k4 theta^8), which must increase over the field of view",
        "1",
        default=projections.UNDISTORTED,
        later=True,
    )
    range_m: float = quantity(
        "farthest depth returned; rgb and grey cameras see without limit", "m", gt=0.5, le=65
    )
    rate_hz: float = quantity("frames a second", "Hz", ge=1, le=125)
    forward_m: float = quantity("mount ahead of the centre of mass", "m", ge=-2, le=2)
    up_m: float = quantity("mount above the centre of mass", "m", ge=-2, le=2)
    right_m: float = quantity(
        "mount to the right of the centre of mass", "m", ge=-2, le=2, default=0.0, later=True
    )
    pitch_up_deg: float = quantity("mount angle, positive looks up", "deg", ge=-90, le=90)
    yaw_deg: float = quantity(
        "mount heading, clockwise seen from above: 0 looks along the nose, 90 to the right",
        "deg",
        ge=-180,
        le=180,
        default=0.0,
        later=True,
    )
    stereo: Stereo | None = later_field(
        None,
        "how depth is matched, of a depth camera with a pinhole; left out: depth without error",
    )
    ranging: Ranging | None = later_field(
        None, "how a lidar measures depth; left out: without error"
    )
    imaging: Imaging | None = later_field(
        None,
        "how the image of an rgb or grey camera is formed; left out: as the ray caster draws it",
    )

    @model_validator(mode="after")
    def _projects(self) -> Camera:
        field, fov_deg = "camera.horizontal_fov_deg", self.horizontal_fov_deg
        projections.check_lens(field, self.projection, fov_deg, self.distortion)
        check_rows("camera.height_px", self)
        if self.stereo is not None and not projections.PROJECTIONS[self.projection].planar:
            raise FieldError(
                "camera.stereo", self.projection, "left out where the projection is not pinhole"
            )
        check_matched("camera.kind", self)
        return self

    @property
    def period_us(self) -> int:
        """Time between two frames [µs]."""
        return round(US_PER_S / self.rate_hz)


def check_matched(field: str, camera: Camera) -> None:
    """Raise FieldError, naming the field, for tables of another kind of camera."""
    if camera.imaging is not None and camera.kind == "depth":
        raise FieldError(
            field,
            camera.kind,
            problem="with a table camera.imaging; accepted: rgb or grey with one",
        )
    if camera.imaging is not None:
        camera.imaging.check(camera)
    if camera.ranging is not None and (camera.kind != "depth" or camera.stereo is not None):
        problem = (
            "with a table camera.ranging; accepted: 'depth' with one, and without camera.stereo"
        )
        raise FieldError(field, camera.kind, problem=problem)
    if camera.stereo is not None and camera.kind != "depth":
        raise FieldError(
            field, camera.kind, problem="with a table camera.stereo; accepted: 'depth' with one"
        )


def check_rows(field: str, camera: Camera) -> None:
    """Raise FieldError, naming the field, for an image with too few rows for its projection."""
    least = projections.PROJECTIONS[camera.projection].least_rows
    if camera.height_px < least:
        accepted = f"value >= {least} px with projection {camera.projection!r}"
        raise FieldError(field, camera.height_px, accepted)


# --- additional cameras: by name, all triggered with the main one

MOST: Final = 32
"""Maximum additional cameras: their largest images fit into one frame."""

_NAME = re.compile(r"[a-z][a-z0-9_]{0,23}")

_SAY_WHICH = ("model", "name")
"""Reserved names: a table with these fields replaces the table of its base (`loading`)."""

ACCEPTED_NAME: Final = (
    "a name of a-z, 0-9 and _ that begins with a letter, 24 characters at most, but for"
    f" {' and '.join(_SAY_WHICH)}"
)


def is_camera_name(name: str) -> bool:
    """Return whether a name is valid for an additional camera."""
    return _NAME.fullmatch(name) is not None and name not in _SAY_WHICH


def camera_named(name: str) -> str:
    """Return an additional camera's name. Raises ValueError for an invalid name."""
    if not is_camera_name(name):
        raise ValueError(f"{name!r}: accepted: {ACCEPTED_NAME}")
    return name


def _each_by_itself(value: Any) -> Any:
    """Validate each camera. Raises FieldError naming a camera with contradictory fields."""
    if not isinstance(value, Mapping):
        return value
    if len(value) > MOST:
        raise FieldError("cameras", len(value), f"at most {MOST} further cameras")
    for name, table in value.items():
        if not (isinstance(name, str) and is_camera_name(name)):
            raise FieldError("cameras", name, ACCEPTED_NAME)
        if not isinstance(table, Mapping):
            continue
        try:
            Camera.model_validate(table)
        except FieldError as error:
            field = re.sub(r"^camera\b", f"cameras.{name}", error.field)
            raise FieldError(field, error.value, error.accepted, error.problem) from None
        except ValidationError:
            pass  # The vehicle's own validation reports the field.
    return value


FurtherCameras = Annotated[dict[str, Camera], BeforeValidator(_each_by_itself)]
"""Additional cameras by name."""


def with_the_rate(data: Any) -> Any:
    """Return the data of a vehicle profile, with the main camera's rate in additional cameras."""
    if not isinstance(data, Mapping):
        return data
    main, further = data.get("camera"), data.get("cameras")
    rate = main.get("rate_hz") if isinstance(main, Mapping) else getattr(main, "rate_hz", None)
    if rate is None or not isinstance(further, Mapping):
        return data
    filled = {
        name: {"rate_hz": rate, **table} if isinstance(table, Mapping) else table
        for name, table in further.items()
    }
    return {**data, "cameras": filled}


def check_rates(main: Camera, further: Mapping[str, Camera]) -> None:
    """Raise FieldError for an additional camera with another rate than the main one."""
    for name, camera in further.items():
        if camera.rate_hz != main.rate_hz:
            raise FieldError(
                f"cameras.{name}.rate_hz",
                camera.rate_hz,
                f"{main.rate_hz:g} Hz, the main camera's, or left out: all are triggered together",
            )


# --- checks against a scenario's other settings


def check_noise(
    camera: Camera,
    asked: SensorNoise,
    faults: Sequence[Fault],
    table: str = "sensors",
    further: Iterable[Camera] = (),
) -> None:
    """Raise FieldError for depth noise or faults without any depth camera."""
    if camera.kind == "depth":
        return
    measured = any(each.kind == "depth" for each in further)
    for name in ("depth_noise", "depth_dropout"):
        if (value := getattr(asked, name)) and not measured:
            raise FieldError(f"{table}.{name}", value, f"0 with a camera of kind {camera.kind!r}")
    for fault in faults:
        if (fault.part, fault.kind) == ("camera", "noise"):
            accepted = f"a depth camera; the vehicle's is of kind {camera.kind!r}"
            raise FieldError("faults", str(fault), accepted)


def check_gym_imaging(camera: Camera, name: str = "") -> None:
    """Raise FieldError for auto-exposure lag, unsupported where only decisions take frames."""
    auto = None if camera.imaging is None else camera.imaging.auto_exposure
    if auto is not None and auto.time_constant_s > 0.0:
        raise FieldError(
            f"{f'cameras.{name}' if name else 'camera'}.imaging.auto_exposure.time_constant_s",
            auto.time_constant_s,
            "0 in the vectorized simulator, which renders decision frames only; any in lockstep",
        )
