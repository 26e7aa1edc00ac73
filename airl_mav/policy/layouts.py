"""Observation layouts: from what the vehicle senses to the arrays that a network takes.

`body` is the default: a depth image, and goal and velocity in the heading frame. `paper` is Air
Learning's own input as its code has it: a 154 x 256 image whose top rows draw the bearing of the
goal, and vectors in the world frame. Both are Dicts of `depth`, `velocity` and `goal`. Any other is
the user's own: a class, made without arguments, whose objects are a `Layout`.

The function that trains is the function that flies: `encode_layout` takes n vehicles at a time,
and the companion is n = 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import Annotated, Any, Literal, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from airl_mav.camera.frame import MAX_MM, MM_PER_M
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core import plugins
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.core.frames import heading_to_ned
from airl_mav.policy.observation import InFlight, Observation
from airl_mav.profiles.projection import CYLINDER_MOST_DEG, Projection, check_fov

SHIPPED = ("body", "paper")
LayoutName = Annotated[str, plugins.part_name(plugins.LAYOUTS, SHIPPED)]
Encoded = dict[str, NDArray[Any]]

DEPTH, VELOCITY, GOAL = "depth", "velocity", "goal"
"""Keys of the shipped layouts; every one has the first."""

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
    range_m: float = quantity("depth from which on everything looks far", "m", gt=0.5, le=65)
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
        check_fov("horizontal_fov_deg", self.projection, self.horizontal_fov_deg)
        return self

    @property
    def camera_rows(self) -> int:
        """Rows of the image that come from the camera."""
        return self.height_px - (STRIP_ROWS if self.layout == "paper" else 0)


class Box(NamedTuple):
    """Shape, type and bounds of one array of a layout, without the leading axis."""

    shape: tuple[int, ...]
    dtype: type[np.generic]
    low: float
    high: float


class Layout(Protocol):
    """A layout of the user's."""

    def boxes(self, spec: ObservationSpec) -> Mapping[str, Box]:
        """Return its arrays by key: `depth` uint8 (channels, height, width), others float32."""
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
        DEPTH: Box((spec.frames, spec.height_px, spec.width_px), np.uint8, 0, 255),
        VELOCITY: Box((3,), np.float32, -math.inf, math.inf),
        GOAL: Box((3,), np.float32, -math.inf, math.inf),
    }
    if spec.in_flight:
        numbers = sum(TOLD[name] for name in spec.in_flight)
        found[IN_FLIGHT] = Box((numbers,), np.float32, -math.inf, math.inf)
    return found


def camera_mismatch(spec: ObservationSpec, camera: Intrinsics) -> str | None:
    """Return why a camera cannot serve a layout, or None when it can.

    Its image must be a whole multiple of the network's, its projection and field of view the same.
    """
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


class Bytes(NamedTuple):
    """How depths become the network's bytes."""

    table: NDArray[np.uint8]
    """(65536,) a byte for each value of `nearest_returns`."""
    far_mm: float = 0.0
    """Not 0: each of them is 255 (value + 1) / far_mm in single precision, rounded to the nearest
    and 255 at most, which a compiler turns into vector instructions as it cannot a table."""


Shrink = Callable[[NDArray[np.uint16], int, int, Bytes], NDArray[np.uint8]]
"""From Z16 images (n, h, w), rows, columns and the bytes of depths to the images (n, rows, columns)
of those bytes."""


def shrink(
    depth_mm: NDArray[np.uint16], rows: int, columns: int, bytes_of: Bytes
) -> NDArray[np.uint8]:
    """Return what numpy makes of images; a `Shrink`."""
    return bytes_of.table[nearest_returns(depth_mm, rows, columns)]


def encode_layout(spec: ObservationSpec, seen: Observation, shrink: Shrink = shrink) -> Encoded:
    """Return the arrays of a layout for n vehicles.

    Args:
        spec: The layout; its camera must fit (`camera_mismatch`).
        seen: Of n vehicles: every array has a leading axis (n,).
        shrink: What makes the network's images of the camera's; numpy by default.

    Returns:
        `depth` (n, frames, height, width) uint8, the newest first and "no return" where there was
        none yet, `velocity` (n, 3) and `goal` (n, 3) float32.
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
    bytes_of = (_body_bytes if spec.layout == "body" else _paper_bytes)(spec.range_m)
    image = shrink(seen.depth_mm, spec.camera_rows, spec.width_px, bytes_of)
    if spec.layout == "body":
        safe = np.maximum(distance, 1e-6)
        goal = np.stack(
            [seen.goal[:, 0] / safe, seen.goal[:, 1] / safe, distance / DISTANCE_SCALE_M], axis=1
        )
        velocity = seen.velocity / SPEED_SCALE_M_S
    else:
        image = np.concatenate([_bearing_strip(spec, seen), image], axis=1)
        level = np.concatenate([seen.goal, np.zeros((len(distance), 1))], axis=1)
        goal = heading_to_ned(level, seen.yaw)
        goal[:, 2] = distance
        velocity = heading_to_ned(seen.velocity, seen.yaw)
    encoded: Encoded = {
        DEPTH: image[:, None]
        if spec.frames == 1
        else _stacked(spec, image, seen, shrink, bytes_of),
        VELOCITY: velocity.astype(np.float32),
        GOAL: goal.astype(np.float32),
    }
    if spec.in_flight:
        encoded[IN_FLIGHT] = _told(spec.in_flight, seen.in_flight)
    return encoded


def _stacked(
    spec: ObservationSpec,
    newest: NDArray[np.uint8],
    seen: Observation,
    shrink: Shrink,
    bytes_of: Bytes,
) -> NDArray[np.uint8]:
    """Return the network's images (n, frames, height, width), the newest first."""
    stack = np.full((len(newest), spec.frames, *newest.shape[1:]), 255, np.uint8)
    stack[:, 0] = newest
    for k, image in enumerate(seen.earlier_mm[: spec.frames - 1], start=1):
        stack[:, k] = shrink(image, spec.camera_rows, spec.width_px, bytes_of)
    return stack


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
        if len(box.shape) != (3 if key == DEPTH else 1)
        or np.dtype(box.dtype) != np.dtype(np.uint8 if key == DEPTH else np.float32)
    ]
    if wrong or DEPTH not in found:
        problem = f"its arrays are {', '.join(wrong) or ', '.join(found)}"
        wanted = f"{DEPTH} uint8 (channels, height, width), all others float32 (k,)"
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


def ablated(encoded: Mapping[str, NDArray[Any]], key: str) -> Encoded:
    """Return the arrays with one input made zero, as the paper's sensor ablation does."""
    return {k: np.zeros_like(v) if k == key else v for k, v in encoded.items()}


def nearest_returns(depth_mm: NDArray[np.uint16], rows: int, columns: int) -> NDArray[np.uint16]:
    """Shrink Z16 images (n, h, w) to (n, rows, columns): the nearest return of each block wins.

    Values are one less than in the images, so that "no return" (0) wraps round to the farthest.
    """
    image = depth_mm - np.uint16(1)
    vertical, horizontal = depth_mm.shape[1] // rows, depth_mm.shape[2] // columns
    nearest = image[:, ::vertical]
    for k in range(1, vertical):
        nearest = np.minimum(nearest, image[:, k::vertical])
    image, nearest = nearest, nearest[:, :, ::horizontal]
    for k in range(1, horizontal):
        nearest = np.minimum(nearest, image[:, :, k::horizontal])
    return nearest


def _depths_m(range_m: float) -> NDArray[np.float64]:
    """Return the depth [m] of every value of `nearest_returns`; infinite beyond the range."""
    depth = (np.arange(MAX_MM + 1) + 1) / MM_PER_M
    depth[(depth > range_m) | (np.arange(MAX_MM + 1) == MAX_MM)] = np.inf
    return depth


@cache
def _body_bytes(range_m: float) -> Bytes:
    """Depth in proportion to the range: 0 is at the lens, 255 the range and beyond."""
    share = np.minimum(_depths_m(range_m) / range_m, 1.0)
    table = np.rint(255.0 * share).astype(np.uint8)
    far_mm = range_m * MM_PER_M
    values = np.arange(1, MAX_MM + 2).astype(np.float32)
    ratios = np.float32(255.0) * values / np.float32(far_mm)
    in_single = np.rint(np.minimum(ratios, np.float32(255.0))).astype(np.uint8)
    return Bytes(table, far_mm if np.array_equal(in_single, table) else 0.0)


@cache
def _paper_bytes(range_m: float) -> Bytes:
    """Air Learning's mapping (airlearning-rl, getScreenDepthVis).

    255 / max(1 m, depth) cut to a byte, inverted, to the tenth power of the byte's range.
    """
    byte = (255.0 / np.maximum(1.0, _depths_m(range_m))).astype(np.uint8)
    return Bytes((255.0 * ((255.0 - byte) / 255.0) ** 10).astype(np.uint8))


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
