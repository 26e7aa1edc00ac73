"""Observation layouts and inputs: tables of objects that know shape, encoding and drawing.

`body` is the default: the camera's image, and goal and velocity in the heading frame. `paper` is
Air Learning's own input as in its code: a 154 x 256 image whose top rows draw the bearing of the
goal, and vectors in the world frame. `scan` is `body` with a level scan, as from a planar lidar, in
place of the depth image. Earlier scans are moved to the vehicle's present position. These are Dicts
of the image, `velocity` and `goal`. The image's key is the camera's kind: `depth`, `rgb` or `grey`.
Images of additional cameras follow, under KIND_NAME. `candidates` is the planner's: velocities with
features of their predicted flight. Its map is the memory of a flight. Any other layout is a custom
class, constructed without arguments, with the methods `boxes` and `encode` of `Layout`.

To add an input, add a row to `INPUTS`. To add a layout, add an object to `LAYOUTS`.

Training and flight share one function: `encode_layout` takes n vehicles at a time, and the
companion is n = 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from airl_mav.core import plugins
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.frames import down_in_body, heading_to_ned
from airl_mav.policy import planner
from airl_mav.policy.images import (
    NUMPY,
    Bytes,
    Shrink,
    body_bytes,
    goes_round,
    paper_bytes,
    scan_bytes,
    scans_of,
)
from airl_mav.policy.observation import Observation
from airl_mav.profiles.projections import CHANNELS, KINDS, PROJECTIONS

if TYPE_CHECKING:
    from airl_mav.policy.observation_spec import ObservationSpec, SeenCamera

T = TypeVar("T")
Encoded = dict[str, NDArray[Any]]
"""Arrays of a layout, by key."""

Encoder = Callable[..., Encoded]
"""Function as `Layout.encode`."""

VELOCITY, GOAL = "velocity", "goal"
"""Keys of the shipped layouts besides the image's key, which is the camera's kind."""

IN_FLIGHT = "in_flight"
"""Key of the additional inputs, if there are any."""

SPEED_SCALE_M_S = 5.0
"""Divisor of velocities, the maximum speed of the paper's actions."""

DISTANCE_SCALE_M = 20.0
"""`body`: divisor of the goal distance."""

LEAST_DISTANCE_M = 1e-6
"""Minimum distance of a goal with a bearing [m]."""

HEIGHT_SCALE_M = 5.0
"""Divisor of the goal's distance below the vehicle, and of the vehicle's height."""

STRIP_ROWS = 10
"""`paper`: rows on top of the image that draw the bearing of the goal, the last one black."""

STRIP_HALF_WIDTH = 1
"""`paper`: the bar that draws the bearing is three columns wide."""

SEAM_SHARE = 8
"""`scan`: divisor for the bearings of an all-round camera that are repeated at either end, so that
a convolution sees the rear without a gap."""

LEAST_ROWS = 4
"""Minimum rows of a network's image; a scan has one row per frame instead."""


class Box(NamedTuple):
    """Shape, type and bounds of one array of a layout, without the leading axis."""

    shape: tuple[int, ...]
    dtype: type[np.generic]
    low: float
    high: float

    @classmethod
    def of_image(cls, *shape: int) -> Box:
        """Return the box of an image (channels, rows, columns)."""
        return cls(shape, np.uint8, 0, 255)

    @classmethod
    def of_numbers(cls, count: int) -> Box:
        """Return the box of unbounded numbers."""
        return cls((count,), np.float32, -math.inf, math.inf)


# --- additional inputs


@dataclass(frozen=True)
class Input:
    """Additional input of a network: numbers of one kind."""

    count: int
    meaning: str
    """Description, as in `ObservationSpec.in_flight`."""
    read: Callable[[Observation], Any]
    """Return the values of n vehicles (n,) or (n, count) [m, m/s, rad, rad/s, s]."""
    scale: float | tuple[float, ...] = 1.0
    """Divisor of the values."""

    def encode(self, seen: Observation) -> NDArray[np.float64]:
        """Return the input of n vehicles (n, count). Raises ValueError if it is not available."""
        values = np.asarray(self.read(seen), np.float64)
        return values.reshape(len(values), self.count) / self.scale


def _known(value: T | None, lacking: str) -> T:
    if value is None:
        raise ValueError(f"the network is told {lacking}")
    return value


def _decided(name: str, attribute: str) -> Callable[[Observation], Any]:
    """Return the reader of an attribute of `InFlight`."""

    def read(seen: Observation) -> Any:
        known = _known(seen.in_flight, f"{name}, and nobody keeps account of it")
        return getattr(known, attribute)

    return read


def _tilt(seen: Observation) -> NDArray[np.float64]:
    return down_in_body(np.asarray(seen.roll), np.asarray(seen.pitch))


def _rates(seen: Observation) -> NDArray[np.float64]:
    rates = seen.states[0].rates if seen.states else None
    return _known(rates, "the body rates, and nobody measures them")


def _height(seen: Observation) -> NDArray[np.float64]:
    state = _known(seen.states[0] if seen.states else None, "its height, and nobody measures it")
    return -np.asarray(state.position[..., 2])


INPUTS: dict[str, Input] = {
    "command": Input(
        3,
        "the newest velocity setpoint",
        _decided("command", "command"),
        (SPEED_SCALE_M_S, SPEED_SCALE_M_S, 1.0),
    ),
    "latency": Input(1, "the expected t2", _decided("latency", "latency_s")),
    "age": Input(1, "the age of the image", _decided("age", "age_s")),
    "setpoint": Input(
        4,
        "all four numbers of the newest setpoint of any kind",
        _decided("setpoint", "setpoint"),
    ),
    "tilt": Input(3, "the down direction in body axes", _tilt),
    "rates": Input(3, "the body rates", _rates),
    "height": Input(1, "the height above the start", _height, HEIGHT_SCALE_M),
}
"""Additional inputs by name."""


# --- layouts


class Layout:
    """Layout `body`, and base class of all others.

    Custom layouts need no base class: they have the methods `boxes` and `encode`, without `shrink`.
    """

    least_rows = LEAST_ROWS
    """Minimum rows of the image."""
    strip_rows = 0
    """Rows of the image that do not come from the camera."""
    only: Mapping[str, tuple[Any, str]] = {}
    """Fields of the specification with a fixed value: value, and accepted values as text."""
    looks_ahead = False
    """True if the middle of the image must be ahead."""
    remembers = False
    """True if an encoder depends on earlier observations: each flight needs its own."""

    def problem(self, spec: ObservationSpec) -> str | None:
        """Return why the layout does not support a specification, or None if it does."""
        height = f"height_px = {spec.height_px}: accepted:"
        if spec.camera_rows < 1:
            return (
                f"{height} more than {self.strip_rows}, the rows of the strip of layout"
                f" {spec.layout!r}"
            )
        if spec.height_px < self.least_rows:
            return f"{height} {self.least_rows} or more with layout {spec.layout!r}"
        return self.fixed(spec.layout, spec)

    def fixed(self, name: str, spec: Any) -> str | None:
        """Return the first field of a specification that differs from `only` as text."""
        for field, (value, accepted) in self.only.items():
            if (given := getattr(spec, field, value)) != value:
                shown = ", ".join(given) if isinstance(given, dict) else repr(given)
                # As written in TOML.
                shown = shown.lower() if isinstance(given, bool) else shown
                return f"{field} = {shown}: accepted: {accepted} with layout {name!r}"
        return None

    def image_shape(self, spec: ObservationSpec) -> tuple[int, int, int]:
        """Return channels, rows and columns of the network's image."""
        return CHANNELS[spec.kind] * spec.frames, spec.height_px, spec.width_px

    def boxes(self, spec: ObservationSpec) -> dict[str, Box]:
        """Return the arrays by key: `spec.kind` uint8 (channels, height, width), others float32.

        Images of additional cameras (`spec.further_keys`) have the same format as `spec.kind`.
        """
        found = {
            spec.kind: Box.of_image(*self.image_shape(spec)),
            VELOCITY: Box.of_numbers(3),
            GOAL: Box.of_numbers(spec.goal_numbers),
        }
        if spec.in_flight:
            found[IN_FLIGHT] = Box.of_numbers(sum(INPUTS[name].count for name in spec.in_flight))
        further = {
            spec.further_keys[name]: Box.of_image(each.channels, each.height_px, each.width_px)
            for name, each in spec.cameras.items()
        }
        # Sorted by key: the order of the network's inputs must not depend on the profile's order.
        return found | dict(sorted(further.items()))

    def encode(self, spec: ObservationSpec, seen: Observation, shrink: Shrink = NUMPY) -> Encoded:
        """Return the arrays for n vehicles; see `encode_layout`. Rows are independent."""
        image = self.image(spec, seen, shrink)
        velocity, goal = self.vectors(spec, seen)
        encoded: Encoded = {
            spec.kind: image,
            VELOCITY: velocity.astype(np.float32),
            GOAL: goal.astype(np.float32),
        }
        if spec.in_flight:
            told = [INPUTS[name].encode(seen) for name in spec.in_flight]
            encoded[IN_FLIGHT] = np.concatenate(told, axis=1).astype(np.float32)
        return encoded | dict(_further(spec, seen, shrink))

    def encoder(self) -> Encoder:
        """Return the function of `encode` for the observations of a flight, in order."""
        return self.encode

    def image(self, spec: ObservationSpec, seen: Observation, shrink: Shrink) -> NDArray[np.uint8]:
        """Return the network's images of n vehicles, the newest frame first."""
        return _stack(spec, (seen.image, *seen.earlier), body_bytes(spec.range_m), shrink)

    def vectors(
        self, spec: ObservationSpec, seen: Observation
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return velocity (n, 3) and goal (n, `spec.goal_numbers`) of n vehicles."""
        distance = np.hypot(seen.goal[:, 0], seen.goal[:, 1])
        # The bearing of a goal straight below is undefined: no division by zero.
        safe = np.maximum(distance, LEAST_DISTANCE_M)
        goal = [seen.goal[:, 0] / safe, seen.goal[:, 1] / safe, distance / DISTANCE_SCALE_M]
        if spec.goal_height:
            goal.append(_below(seen) / HEIGHT_SCALE_M)
        return seen.velocity / SPEED_SCALE_M_S, np.stack(goal, axis=1)

    def newest(self, spec: ObservationSpec, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the channels of the newest frame of one vehicle's image, to be drawn."""
        return image[: CHANNELS[spec.kind]]


class PaperLayout(Layout):
    """Layout `paper`."""

    strip_rows = STRIP_ROWS
    only: Mapping[str, tuple[Any, str]] = {
        "frames": (1, "1"),
        "kind": ("depth", "'depth'"),
        "goal_height": (False, "false"),
        "cameras": ({}, "none"),
    }

    def image(self, spec: ObservationSpec, seen: Observation, shrink: Shrink) -> NDArray[np.uint8]:
        """Return the camera's image below Air Learning's strip.

        The strip is white, with a black bar at the goal's bearing: -180 to 180 deg run from the
        left to the right edge. The last row is black.
        """
        image = _stack(spec, (seen.image,), paper_bytes(spec.range_m), shrink)
        n, width = len(seen.goal), spec.width_px
        bearing = np.arctan2(seen.goal[:, 1], seen.goal[:, 0])
        column = ((bearing + math.pi) / (2.0 * math.pi) * width).astype(np.int64)
        # At the edges the bar keeps its width.
        column = np.clip(column, STRIP_HALF_WIDTH, width - 1 - STRIP_HALF_WIDTH)
        strip = np.full((n, 1, STRIP_ROWS, width), 255, np.uint8)
        strip[:, 0, -1] = 0
        for offset in range(-STRIP_HALF_WIDTH, STRIP_HALF_WIDTH + 1):
            strip[np.arange(n), 0, :, column + offset] = 0
        return np.concatenate([strip, image], axis=2)

    def vectors(
        self,
        spec: ObservationSpec,  # noqa: ARG002 (for other layouts)
        seen: Observation,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return velocity and goal in the world frame, and the goal's distance."""
        # The goal's height is not part of the paper's observation.
        level = np.concatenate([seen.goal, np.zeros((len(seen.goal), 1))], axis=1)
        goal = heading_to_ned(level, seen.yaw)
        goal[:, 2] = np.hypot(seen.goal[:, 0], seen.goal[:, 1])
        return heading_to_ned(seen.velocity, seen.yaw), goal


class ScanLayout(Layout):
    """Layout `scan`."""

    least_rows = 1
    only: Mapping[str, tuple[Any, str]] = {"kind": ("depth", "'depth'")}
    looks_ahead = True

    def problem(self, spec: ObservationSpec) -> str | None:
        """Return why the layout does not support a specification; rejects a fisheye."""
        if (problem := super().problem(spec)) is None and PROJECTIONS[spec.projection].tabled:
            accepted = "pinhole or cylindrical with layout 'scan'"
            return f"projection = {spec.projection!r}: accepted: {accepted}"
        return problem

    def image_shape(self, spec: ObservationSpec) -> tuple[int, int, int]:
        """Return one channel, the frames, and the bearings with the seam."""
        return 1, spec.frames, spec.width_px + 2 * self.seam(spec)

    def image(self, spec: ObservationSpec, seen: Observation, shrink: Shrink) -> NDArray[np.uint8]:
        """Return the scans (n, 1, frames, bearings with the seam)."""
        scans = scans_of(seen, spec.frames, spec.width_px, shrink.scanning)
        seam = self.seam(spec)
        # An all-round scan has no edge: convolutions need the neighbours across the seam.
        columns = np.arange(-seam, spec.width_px + seam) % spec.width_px
        return scan_bytes(scans, spec.range_m)[:, None, :, columns]

    def newest(self, spec: ObservationSpec, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the newest scan without the seam, as high as the camera's image."""
        seam = self.seam(spec)
        # One row is invisible beside the camera's image.
        return np.repeat(image[:1, :1, seam : seam + spec.width_px], spec.height_px, axis=1)

    @staticmethod
    def seam(spec: ObservationSpec) -> int:
        """Return the number of bearings of a scan that are repeated at either end."""
        whole = goes_round(math.radians(spec.horizontal_fov_deg))
        return spec.width_px // SEAM_SHARE if whole else 0


class CandidatesLayout(Layout):
    """Layout `candidates`: the planner's candidates for a network that scores them."""

    only: Mapping[str, tuple[Any, str]] = {
        "kind": ("depth", "'depth'"),
        "frames": (1, "1"),
        "goal_height": (False, "false"),
        "in_flight": (("command", "latency"), "command, latency"),
        "cameras": ({}, "none"),
    }
    looks_ahead = remembers = True

    def boxes(self, spec: ObservationSpec) -> dict[str, Box]:
        """Return the arrays by key: features, planner's costs and commands of c candidates."""
        fov = math.radians(spec.horizontal_fov_deg)
        count = planner.candidate_count(planner.LEARNED.speeds_m_s, fov)
        shapes = {
            "candidates": (count, planner.FEATURES),
            "commands": (count, 4),
            "costs": (count,),
        }
        return {key: Box(shape, np.float32, -math.inf, math.inf) for key, shape in shapes.items()}

    def encode(self, spec: ObservationSpec, seen: Observation, shrink: Shrink = NUMPY) -> Encoded:
        """Return the arrays of first decisions."""
        rows = [self.encoder()(spec, seen.rows([i]), shrink) for i in range(len(seen.goal))]
        return {key: np.concatenate([row[key] for row in rows]) for key in self.boxes(spec)}

    def encoder(self) -> Encoder:
        """Return the encoder of one flight."""
        memory = planner.PlannerPolicy(planner.LEARNED)

        def encode(spec: ObservationSpec, seen: Observation, *_: Shrink) -> Encoded:
            boxes = self.boxes(spec)
            found = memory.candidates(seen.rows(0), features=True)
            told = {
                "candidates": found.features,
                "commands": found.commands / planner.LEARNED.limits,
                "costs": np.minimum(found.costs - found.costs.min(), planner.WORST_S),
            }
            encoded = {key: np.zeros((1, *box.shape), np.float32) for key, box in boxes.items()}
            # Candidates out of view are missing.
            encoded["costs"][:] = 2.0 * planner.WORST_S
            for key, array in told.items():
                encoded[key][0, : len(array)] = array
            return encoded

        return encode


class CustomLayout(Layout):
    """Layout of a custom class. Its rules are checked without loading its code."""

    least_rows = 1

    def boxes(self, spec: ObservationSpec) -> dict[str, Box]:
        """Return the arrays by key, sorted. Raises FieldError if a network cannot take them."""
        found = {key: Box(*box) for key, box in sorted(_custom(spec.layout).boxes(spec).items())}
        # Only images have three axes; networks treat all others as vectors.
        images = {spec.kind, *spec.further_keys.values()}
        wrong = [
            f"{key} {np.dtype(box.dtype)} {box.shape}"
            for key, box in found.items()
            if len(box.shape) != (3 if key in images else 1)
            or np.dtype(box.dtype) != np.dtype(np.uint8 if key in images else np.float32)
        ]
        if wrong or not images <= found.keys():
            problem = f"its arrays are {', '.join(wrong) or ', '.join(found)}"
            named = ", ".join((spec.kind, *sorted(spec.further_keys.values())))
            wanted = f"{named} uint8 (channels, height, width), all others float32 (k,)"
            raise FieldError(
                plugins.LAYOUTS.field, spec.layout, problem=f"{problem}; accepted: {wanted}"
            )
        return found

    def encode(
        self,
        spec: ObservationSpec,
        seen: Observation,
        shrink: Shrink = NUMPY,  # noqa: ARG002 (for shipped layouts)
    ) -> Encoded:
        """Return the arrays of n vehicles. Raises UsageError if they differ from the boxes."""
        # Checked on every call: custom code may return other shapes for other inputs.
        found, wanted = _custom(spec.layout).encode(spec, seen), self.boxes(spec)
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


LAYOUTS: dict[str, Layout] = {
    "body": Layout(),
    "paper": PaperLayout(),
    "scan": ScanLayout(),
    "candidates": CandidatesLayout(),
}
"""Shipped layouts by name."""

SHIPPED = tuple(LAYOUTS)

_CUSTOM = CustomLayout()


@cache
def layout_of(name: str) -> Layout:
    """Return the layout of a name. Reading a specification runs no custom code."""
    return LAYOUTS.get(name, _CUSTOM)


@cache
def _custom(name: str) -> Any:
    """Return the object of a custom layout. Raises FieldError."""
    return plugins.load_object(plugins.LAYOUTS, name, ("boxes", "encode"))


def boxes(spec: ObservationSpec) -> dict[str, Box]:
    """Return the arrays of a layout, by key. Raises UsageError if a network cannot take them."""
    return layout_of(spec.layout).boxes(spec)


def encode_layout(spec: ObservationSpec, seen: Observation, shrink: Shrink = NUMPY) -> Encoded:
    """Return the arrays of a layout for n vehicles.

    The camera must fit (`camera_mismatch`). Every array of `seen` has a leading axis (n,).

    Returns:
        Image uint8, the newest frame first: `depth` (n, frames, height, width), missing frames
        "no return"; `rgb` (n, 3 frames, height, width) and `grey` (n, frames, height, width),
        missing frames black. `velocity` (n, 3) and `goal` (n, 3) float32.
        `scan`: `depth` (n, 1, frames, bearings) of `policy.images.scan_bytes`, a row for each
        frame. The image width is the number of bearings; an all-round camera repeats some at either
        end. Earlier frames are moved to the present position and heading. Otherwise as `body`.
        `body`: velocity forward, right, down / 5 m/s; goal as cosine and sine of its bearing and
        its level distance / 20 m. With `goal_height` goal is (n, 4), the last number being the
        distance below the vehicle / 5 m. `paper`: velocity NED [m/s]; goal as north, east [m] and
        distance [m].
        `candidates`: `candidates` (n, c, features), `commands` (n, c, 4) in shares of the maximum,
        and `costs` (n, c) [s] of `planner.Candidates`, float32, as at first decisions.
        With additional inputs, `in_flight` (n, k) float32, as in `INPUTS`.
        An image of each additional camera as in `body`, for every layout: `grey_down`
        (n, frames, height, width) of a grey camera called down.

    Raises:
        ValueError: An additional input is not available.
        UsageError: A custom layout returns other arrays than declared, the network needs the height
            of a goal without one, or an additional camera has no image.
    """
    return layout_of(spec.layout).encode(spec, seen, shrink)


def newest_frame(spec: ObservationSpec, seen: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Return a copy of one vehicle's newest frame, as a picture (h, w) or (h, w, 3)."""
    channels = layout_of(spec.layout).newest(spec, seen[spec.kind])
    # Networks take channels first, pictures have them last.
    picture = np.moveaxis(channels, 0, -1)
    return np.array(picture if spec.kind == "rgb" else picture[..., 0], order="C")


def image_key(keys: Iterable[str]) -> str:
    """Return the key of the image among a layout's keys. Raises StopIteration without an image."""
    return next(key for key in keys if key in KINDS)


def ablated(encoded: Mapping[str, NDArray[Any]], key: str) -> Encoded:
    """Return the arrays with one input set to zero, as in the paper's sensor ablation."""
    return {k: np.zeros_like(v) if k == key else v for k, v in encoded.items()}


def _below(seen: Observation) -> NDArray[np.float64]:
    """Return distances (n,) [m] of goals below their vehicles. Raises UsageError if unknown."""
    below = seen.goal_down
    # A missing height must not become a goal at the vehicle's height.
    if below is None or not np.isfinite(below).all():
        raise UsageError("the network is told how high the goal is, and this goal has no height")
    return np.asarray(below, np.float64)


def _further(
    spec: ObservationSpec, seen: Observation, shrink: Shrink
) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """Yield network images of additional cameras, by key. Raises UsageError if one is missing."""
    for name, key in sorted(spec.further_keys.items(), key=lambda each: each[1]):
        if name not in seen.further:
            raise UsageError(f"the network sees by a camera {name!r}, and there is no image of it")
        view, camera = seen.further[name], spec.cameras[name]
        images = (view.image, *view.earlier)
        yield key, _stack(camera, images, body_bytes(camera.range_m), shrink)


def _stack(
    spec: ObservationSpec | SeenCamera,
    images: Sequence[NDArray[Any]],
    bytes_of: Bytes,
    shrink: Shrink,
) -> NDArray[np.uint8]:
    """Return the network's image of a camera, the newest frame first, missing frames blank."""
    rows, columns = spec.camera_rows, spec.width_px

    def network(image: NDArray[Any]) -> NDArray[np.uint8]:
        if spec.kind == "depth":
            return shrink.depth(image, rows, columns, bytes_of)[:, None]
        return shrink.colour(image, rows, columns)

    newest = network(images[0])
    # The common case copies no stack.
    if spec.frames == 1:
        return newest
    # Missing depth frames are free space (no return), missing pictures are black.
    blank, channels = (255 if spec.kind == "depth" else 0), CHANNELS[spec.kind]
    stack = np.full((len(newest), channels * spec.frames, rows, columns), blank, np.uint8)
    for k, image in enumerate(images[: spec.frames]):
        stack[:, k * channels : (k + 1) * channels] = newest if k == 0 else network(image)
    return stack
