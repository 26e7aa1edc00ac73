"""Observation layouts: from what the vehicle senses to the arrays that a network takes.

`body` is the default: the camera's image, and goal and velocity in the heading frame. `paper` is
Air Learning's own input as its code has it: a 154 x 256 image whose top rows draw the bearing of
the goal, and vectors in the world frame. `scan` is `body` with a level scan, as a planar lidar's,
in place of the depth image; earlier frames are carried to where the vehicle is now. All are Dicts
of the image, `velocity` and `goal`; the image's key is what the camera gives: `depth`, `rgb` or
`grey`. Any other is the user's own: a class, made without arguments, whose objects are a `Layout`.

The function that trains is the function that flies: `encode_layout` takes n vehicles at a time,
and the companion is n = 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Annotated, Any, Literal, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core import plugins
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.core.frames import heading_to_ned
from airl_mav.policy.images import NUMPY, Shrink, body_bytes, paper_bytes
from airl_mav.policy.observation import InFlight, Observation
from airl_mav.policy.scans import goes_round, scan_bytes, scans_of
from airl_mav.profiles.camera_kind import CHANNELS, KINDS, CameraKind
from airl_mav.profiles.projection import CYLINDER_MOST_DEG, Projection, check_fov

SHIPPED = ("body", "paper", "scan")
LayoutName = Annotated[str, plugins.part_name(plugins.LAYOUTS, SHIPPED)]
Encoded = dict[str, NDArray[Any]]

VELOCITY, GOAL = "velocity", "goal"
"""Keys of the shipped layouts, beside that of the image, which is the camera's kind."""


def image_key(keys: Iterable[str]) -> str:
    """Return the key of the image among those of a layout. Raises StopIteration where none is."""
    return next(key for key in keys if key in KINDS)


IN_FLIGHT = "in_flight"
"""Key of what else a network is told, where it is."""

Told = Literal["command", "latency", "age"]

TOLD: dict[Told, int] = {"command": 3, "latency": 1, "age": 1}
"""Numbers of each thing that a network may be told of the decisions."""

SPEED_SCALE_M_S = 5.0
"""`body`: velocities are divided by this, the fastest action of the paper."""

DISTANCE_SCALE_M = 20.0
"""`body`: the distance to the goal is divided by this."""

STRIP_ROWS = 10
"""`paper`: rows on top of the image that draw the bearing of the goal, the last one black."""

SEAM_SHARE = 8
"""`scan`: so many-th of the bearings of a camera that sees all round are repeated at either end, so
that a convolution sees what is behind the vehicle in one piece."""

STRIP_HALF_WIDTH = 1
"""`paper`: the bar that draws the bearing is three columns wide."""

MOST_FRAMES = 8
"""Most images that a network sees at a time."""

Frames = Annotated[
    int,
    quantity(
        "images that the network sees: of this decision, and of so many less one before it",
        "1",
        ge=1,
        le=MOST_FRAMES,
    ),
]


class ObservationSpec(ProfileModel):
    """What a network takes, and the camera that can provide it."""

    layout: LayoutName = Field(default="body", description="which arrays it takes")
    height_px: int = quantity("height of the image that the network sees", "px", ge=4, le=480)
    width_px: int = quantity("width of the image that the network sees", "px", ge=4, le=640)
    projection: Projection = Field(
        default="pinhole",
        description="how directions fall on the image: pinhole, or cylindrical for a field of view"
        " of up to 360 deg",
    )
    horizontal_fov_deg: float = quantity(
        "horizontal field of view, less than 170 with a pinhole",
        "deg",
        gt=10,
        le=CYLINDER_MOST_DEG,
    )
    range_m: float = quantity(
        "depth from which on everything looks far; rgb and grey images have no such depth",
        "m",
        gt=0.5,
        le=65,
    )
    kind: CameraKind = Field(
        default="depth",
        description="what the camera gives, and the key of the image: depth, rgb or grey",
    )
    frames: Frames = 1
    in_flight: tuple[Told, ...] = Field(
        default=(),
        description="what else the network is told: command, the newest setpoint; latency, the t2"
        " that is expected; age, of the image",
    )

    @model_validator(mode="after")
    def _camera_has_rows(self) -> ObservationSpec:
        if self.camera_rows < 1:
            raise ValueError(
                f"height_px = {self.height_px}: accepted: more than {STRIP_ROWS}, the rows of "
                "the strip of layout 'paper'"
            )
        if self.frames > 1 and self.layout == "paper":
            raise ValueError(f"frames = {self.frames}: accepted: 1 with layout 'paper'")
        if self.kind != "depth" and self.layout in ("paper", "scan"):
            raise ValueError(f"kind = {self.kind!r}: accepted: 'depth' with layout {self.layout!r}")
        check_fov("horizontal_fov_deg", self.projection, self.horizontal_fov_deg)
        return self

    @property
    def camera_rows(self) -> int:
        """Rows of the image that come from the camera."""
        return self.height_px - (STRIP_ROWS if self.layout == "paper" else 0)

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of the image as it goes into the network."""
        if self.layout != "scan":
            return self.height_px, self.width_px
        return self.frames, self.width_px + 2 * self.seam

    @property
    def seam(self) -> int:
        """Bearings of a scan that are repeated at either end."""
        whole = self.layout == "scan" and goes_round(math.radians(self.horizontal_fov_deg))
        return self.width_px // SEAM_SHARE if whole else 0

    @property
    def channels(self) -> int:
        """Channels of the image that the network sees: those of a frame, for each frame."""
        return 1 if self.layout == "scan" else CHANNELS[self.kind] * self.frames


class Box(NamedTuple):
    """Shape, type and bounds of one array of a layout, without the leading axis."""

    shape: tuple[int, ...]
    dtype: type[np.generic]
    low: float
    high: float


class Layout(Protocol):
    """A layout of the user's."""

    def boxes(self, spec: ObservationSpec) -> Mapping[str, Box]:
        """Return its arrays by key: `spec.kind` uint8 (channels, height, width), others float32."""
        ...

    def encode(self, spec: ObservationSpec, seen: Observation) -> Mapping[str, NDArray[Any]]:
        """Return those arrays for n vehicles, as `encode_layout` does: of each from its own row."""
        ...


def boxes(spec: ObservationSpec) -> dict[str, Box]:
    """Return the arrays of a layout, by key.

    Raises:
        UsageError: A layout of the user's has others than a network can take.
    """
    if spec.layout not in SHIPPED:
        return _own_boxes(spec)
    found = {
        spec.kind: Box((spec.channels, *spec.image_shape), np.uint8, 0, 255),
        VELOCITY: Box((3,), np.float32, -math.inf, math.inf),
        GOAL: Box((3,), np.float32, -math.inf, math.inf),
    }
    if spec.in_flight:
        numbers = sum(TOLD[name] for name in spec.in_flight)
        found[IN_FLIGHT] = Box((numbers,), np.float32, -math.inf, math.inf)
    return found


def camera_mismatch(spec: ObservationSpec, camera: Intrinsics) -> str | None:
    """Return why a camera cannot serve a layout, or None when it can.

    It gives what the network takes, its image is a whole multiple of the network's, projection and
    field of view are the same.
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
    if abs(fov_deg - spec.horizontal_fov_deg) > 0.1:
        return (
            f"camera with a horizontal field of view of {fov_deg:.1f} deg; "
            f"accepted: {spec.horizontal_fov_deg:.1f} deg"
        )
    return None


def encode_layout(spec: ObservationSpec, seen: Observation, shrink: Shrink = NUMPY) -> Encoded:
    """Return the arrays of a layout for n vehicles.

    Args:
        spec: The layout; its camera must fit (`camera_mismatch`).
        seen: Of n vehicles: every array has a leading axis (n,).
        shrink: What makes the network's images of the camera's; numpy by default.

    Returns:
        The image uint8, the newest frame first: `depth` (n, frames, height, width), "no return"
        where there was none yet; `rgb` (n, 3 frames, height, width) and `grey` (n, frames, height,
        width), black where there was none yet. `velocity` (n, 3) and `goal` (n, 3) float32.
        `scan`: `depth` (n, 1, frames, bearings) of `policy.scans.scan_bytes`, a row for each frame,
        with as many bearings as the image is wide, and those at either end once more for a camera
        that sees all round; earlier frames carried to the present place and heading. Else as
        `body`.
        `body`: velocity forward, right, down / 5 m/s; goal as cosine and sine of its bearing and
        its distance / 20 m. `paper`: velocity NED [m/s]; goal as north, east [m] and distance [m].
        Where the network is told more, `in_flight` (n, k) float32: forward, right / 5 m/s and yaw
        rate [rad/s]; latency [s]; age [s].

    Raises:
        ValueError: The network is told of decisions of which nobody keeps account.
        UsageError: A layout of the user's gives anything else than it says.
    """
    if spec.layout not in SHIPPED:
        return _own_arrays(spec, seen)
    distance = np.hypot(seen.goal[:, 0], seen.goal[:, 1])
    image = _scans(spec, seen, shrink) if spec.layout == "scan" else _images(spec, seen, shrink)
    if spec.layout != "paper":
        safe = np.maximum(distance, 1e-6)
        goal = np.stack(
            [seen.goal[:, 0] / safe, seen.goal[:, 1] / safe, distance / DISTANCE_SCALE_M], axis=1
        )
        velocity = seen.velocity / SPEED_SCALE_M_S
    else:
        image = np.concatenate([_bearing_strip(spec, seen)[:, None], image], axis=2)
        level = np.concatenate([seen.goal, np.zeros((len(distance), 1))], axis=1)
        goal = heading_to_ned(level, seen.yaw)
        goal[:, 2] = distance
        velocity = heading_to_ned(seen.velocity, seen.yaw)
    encoded: Encoded = {
        spec.kind: image,
        VELOCITY: velocity.astype(np.float32),
        GOAL: goal.astype(np.float32),
    }
    if spec.in_flight:
        encoded[IN_FLIGHT] = _told(spec.in_flight, seen.in_flight)
    return encoded


def _images(spec: ObservationSpec, seen: Observation, shrink: Shrink) -> NDArray[np.uint8]:
    """Return the network's images (n, channels, rows of the camera, width), the newest first."""
    rows, columns = spec.camera_rows, spec.width_px
    if spec.kind == "depth":
        bytes_of = (body_bytes if spec.layout == "body" else paper_bytes)(spec.range_m)

        def network(image: NDArray[Any]) -> NDArray[np.uint8]:
            return shrink.depth(image, rows, columns, bytes_of)[:, None]
    else:

        def network(image: NDArray[Any]) -> NDArray[np.uint8]:
            return shrink.colour(image, rows, columns)

    newest = network(seen.image)
    if spec.frames == 1:
        return newest
    blank, channels = (255 if spec.kind == "depth" else 0), CHANNELS[spec.kind]
    stack = np.full((len(newest), spec.channels, rows, columns), blank, np.uint8)
    for k, image in enumerate((seen.image, *seen.earlier[: spec.frames - 1])):
        stack[:, k * channels : (k + 1) * channels] = newest if k == 0 else network(image)
    return stack


def _scans(spec: ObservationSpec, seen: Observation, shrink: Shrink) -> NDArray[np.uint8]:
    """Return the network's scans (n, 1, frames, bearings with the seam), the newest first."""
    scans = scans_of(seen, spec.frames, spec.width_px, shrink.scanning)
    columns = np.arange(-spec.seam, spec.width_px + spec.seam) % spec.width_px
    return scan_bytes(scans, spec.range_m)[:, None, :, columns]


def _told(names: tuple[Told, ...], known: InFlight | None) -> NDArray[np.float32]:
    """Return what networks are told of the decisions of n vehicles (n, k)."""
    if known is None:
        raise ValueError(f"the network is told {', '.join(names)}, and nobody keeps account of it")
    parts = {
        "command": known.command / (SPEED_SCALE_M_S, SPEED_SCALE_M_S, 1.0),
        "latency": np.asarray(known.latency_s)[:, None],
        "age": np.asarray(known.age_s)[:, None],
    }
    return np.concatenate([parts[name] for name in names], axis=1).astype(np.float32)


def _own_boxes(spec: ObservationSpec) -> dict[str, Box]:
    """Return the arrays of a layout of the user's by key, sorted, if a network can take them."""
    found = {key: Box(*box) for key, box in sorted(_own(spec.layout).boxes(spec).items())}
    wrong = [
        f"{key} {np.dtype(box.dtype)} {box.shape}"
        for key, box in found.items()
        if len(box.shape) != (3 if key == spec.kind else 1)
        or np.dtype(box.dtype) != np.dtype(np.uint8 if key == spec.kind else np.float32)
    ]
    if wrong or spec.kind not in found:
        problem = f"its arrays are {', '.join(wrong) or ', '.join(found)}"
        wanted = f"{spec.kind} uint8 (channels, height, width), all others float32 (k,)"
        raise FieldError(
            plugins.LAYOUTS.field, spec.layout, problem=f"{problem}; accepted: {wanted}"
        )
    return found


def _own_arrays(spec: ObservationSpec, seen: Observation) -> Encoded:
    """Return what a layout of the user's makes of an observation, if it is what it says."""
    found, wanted = _own(spec.layout).encode(spec, seen), _own_boxes(spec)
    encoded = {key: np.asarray(found[key]) for key in wanted if key in found}
    n = len(seen.goal)
    for key, box in wanted.items():
        array = encoded.get(key)
        if array is None or array.shape != (n, *box.shape) or array.dtype != box.dtype:
            given = "nothing" if array is None else f"{array.dtype} {array.shape}"
            raise UsageError(
                f"layout {spec.layout!r}: gives {given} for {key!r}; accepted:"
                f" {np.dtype(box.dtype)} {(n, *box.shape)}"
            )
    return encoded


@cache
def _own(name: str) -> Layout:
    """Return a layout of the user's. Raises FieldError."""
    door = plugins.LAYOUTS
    methods = ("boxes", "encode")
    found = plugins.load_part(
        door, name, lambda made: all(callable(getattr(made, each, None)) for each in methods)
    )
    try:
        return cast("Layout", found() if isinstance(found, type) else found)
    except Exception as error:
        problem = f"cannot be made without arguments: {type(error).__name__}: {error}"
        raise FieldError(door.field, name, problem=problem) from error


def newest_frame(spec: ObservationSpec, seen: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Return a copy of the newest frame that one vehicle's network sees, as a picture.

    Args:
        spec: The layout.
        seen: Its arrays, without a leading axis.

    Returns:
        (h, w); of rgb (h, w, 3). A scan is as high as the camera's image would be.
    """
    channels = seen[spec.kind][: CHANNELS[spec.kind]]
    if spec.layout == "scan":
        scan = channels[:, :1, spec.seam : spec.seam + spec.width_px]
        channels = np.repeat(scan, spec.height_px, axis=1)
    picture: NDArray[np.uint8] = np.ascontiguousarray(np.moveaxis(channels, 0, -1))
    return picture.copy() if spec.kind == "rgb" else picture[..., 0].copy()


def ablated(encoded: Mapping[str, NDArray[Any]], key: str) -> Encoded:
    """Return the arrays with one input made zero, as the paper's sensor ablation does."""
    return {k: np.zeros_like(v) if k == key else v for k, v in encoded.items()}


def _bearing_strip(spec: ObservationSpec, seen: Observation) -> NDArray[np.uint8]:
    """Return Air Learning's strip (n, 10, width): white, a black bar at the goal's bearing.

    Bearings of -180..180 deg run from the left to the right edge; the last row is black.
    """
    n, width = len(seen.goal), spec.width_px
    bearing = np.arctan2(seen.goal[:, 1], seen.goal[:, 0])
    column = ((bearing + math.pi) / (2.0 * math.pi) * width).astype(np.int64)
    column = np.clip(column, STRIP_HALF_WIDTH, width - 1 - STRIP_HALF_WIDTH)
    strip = np.full((n, STRIP_ROWS, width), 255, np.uint8)
    strip[:, -1] = 0
    for offset in range(-STRIP_HALF_WIDTH, STRIP_HALF_WIDTH + 1):
        strip[np.arange(n), :, column + offset] = 0
    return strip
