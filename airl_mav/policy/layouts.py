"""Observation layouts: conversion of observations to the input arrays of a network.

`body` is the default: the camera's image, and goal and velocity in the heading frame. `paper` is
Air Learning's own input as in its code: a 154 x 256 image whose top rows draw the bearing of the
goal, and vectors in the world frame. `scan` is `body` with a level scan, as from a planar lidar, in
place of the depth image. Earlier scans are moved to the vehicle's present position. All are Dicts
of the image, `velocity` and `goal`. The image's key is the camera's kind: `depth`, `rgb` or `grey`.
Images of additional cameras follow, under KIND_NAME. Any other layout is a custom class,
constructed without arguments, whose objects are a `Layout`.

Training and flight share one function: `encode_layout` takes n vehicles at a time, and the
companion is n = 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from airl_mav.core import plugins
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.frames import down_in_body, heading_to_ned
from airl_mav.policy.images import (
    NUMPY,
    Bytes,
    Shrink,
    body_bytes,
    paper_bytes,
    scan_bytes,
    scans_of,
)
from airl_mav.policy.observation import Observation
from airl_mav.policy.observation_spec import (
    SHIPPED,
    STRIP_ROWS,
    TOLD,
    Box,
    Encoded,
    ObservationSpec,
    SeenCamera,
    Told,
)
from airl_mav.profiles.projections import CHANNELS, KINDS

VELOCITY, GOAL = "velocity", "goal"
"""Keys of the shipped layouts besides the image's key, which is the camera's kind."""


def image_key(keys: Iterable[str]) -> str:
    """Return the key of the image among a layout's keys. Raises StopIteration without an image."""
    return next(key for key in keys if key in KINDS)


IN_FLIGHT = "in_flight"
"""Key of the additional inputs, if there are any."""

SPEED_SCALE_M_S = 5.0
"""`body`: divisor of velocities, the maximum speed of the paper's actions."""

DISTANCE_SCALE_M = 20.0
"""`body`: divisor of the goal distance."""

LEAST_DISTANCE_M = 1e-6
"""Minimum distance of a goal with a bearing [m]."""

HEIGHT_SCALE_M = 5.0
"""Divisor of the goal's distance below the vehicle, and of the vehicle's height."""

STRIP_HALF_WIDTH = 1
"""`paper`: the bar that draws the bearing is three columns wide."""


def boxes(spec: ObservationSpec) -> dict[str, Box]:
    """Return the arrays of a layout, by key. Raises UsageError if a network cannot take them."""
    if spec.layout not in SHIPPED:
        return own_boxes(spec)
    found = {
        spec.kind: Box((spec.channels, *spec.image_shape), np.uint8, 0, 255),
        VELOCITY: Box((3,), np.float32, -math.inf, math.inf),
        GOAL: Box((spec.goal_numbers,), np.float32, -math.inf, math.inf),
    }
    if spec.in_flight:
        numbers = sum(TOLD[name] for name in spec.in_flight)
        found[IN_FLIGHT] = Box((numbers,), np.float32, -math.inf, math.inf)
    return found | further_boxes(spec)


def further_boxes(spec: ObservationSpec) -> dict[str, Box]:
    """Return the images of additional cameras, by key, sorted."""
    found = {
        key: Box((seen.channels, seen.height_px, seen.width_px), np.uint8, 0, 255)
        for key, seen in zip(spec.further_keys.values(), spec.cameras.values(), strict=True)
    }
    return dict(sorted(found.items()))


def encode_layout(spec: ObservationSpec, seen: Observation, shrink: Shrink = NUMPY) -> Encoded:
    """Return the arrays of a layout for n vehicles.

    The camera must fit (`camera_mismatch`). Every array of `seen` has a leading axis (n,).

    Returns:
        Image uint8, the newest frame first: `depth` (n, frames, height, width), missing frames
        "no return"; `rgb` (n, 3 frames, height, width) and `grey` (n, frames, height, width),
        missing frames black. `velocity` (n, 3) and `goal` (n, 3) float32.
        `scan`: `depth` (n, 1, frames, bearings) of `policy.scans.scan_bytes`, a row for each frame.
        The image width is the number of bearings; an all-round camera repeats some at either end.
        Earlier frames are moved to the present position and heading. Otherwise as `body`.
        `body`: velocity forward, right, down / 5 m/s; goal as cosine and sine of its bearing and
        its level distance / 20 m. With `goal_height` goal is (n, 4), the last number being the
        distance below the vehicle / 5 m. `paper`: velocity NED [m/s]; goal as north, east [m] and
        distance [m].
        With additional inputs, `in_flight` (n, k) float32: forward, right / 5 m/s and yaw rate
        [rad/s]; latency [s]; age [s]; the setpoint as in `InFlight.setpoint`; down in body axes
        FRD; body rates [rad/s]; height above the start / 5 m.
        An image of each additional camera as in `body`, for every layout: `grey_down`
        (n, frames, height, width) of a grey camera called down.

    Raises:
        ValueError: An additional input is not available.
        UsageError: A custom layout returns other arrays than declared, the network needs the height
            of a goal without one, or an additional camera has no image.
    """
    if spec.layout not in SHIPPED:
        return own_arrays(spec, seen)
    distance = np.hypot(seen.goal[:, 0], seen.goal[:, 1])
    image = _scans(spec, seen, shrink) if spec.layout == "scan" else _images(spec, seen, shrink)
    if spec.layout != "paper":
        safe = np.maximum(distance, LEAST_DISTANCE_M)
        goal = np.stack(
            [seen.goal[:, 0] / safe, seen.goal[:, 1] / safe, distance / DISTANCE_SCALE_M], axis=1
        )
        if spec.goal_height:
            goal = np.concatenate([goal, _below(seen)[:, None] / HEIGHT_SCALE_M], axis=1)
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
        encoded[IN_FLIGHT] = _told(spec.in_flight, seen)
    return encoded | _further(spec, seen, shrink)


def _below(seen: Observation) -> NDArray[np.float64]:
    """Return distances (n,) [m] of goals below their vehicles. Raises UsageError if unknown."""
    below = seen.goal_down
    if below is None or not np.isfinite(below).all():
        raise UsageError("the network is told how high the goal is, and this goal has no height")
    return np.asarray(below, np.float64)


def _images(spec: ObservationSpec, seen: Observation, shrink: Shrink) -> NDArray[np.uint8]:
    """Return the network's images (n, channels, rows of the camera, width), the newest first."""
    bytes_of = (body_bytes if spec.layout == "body" else paper_bytes)(spec.range_m)
    return _stack(spec, (seen.image, *seen.earlier), bytes_of, shrink)


def _further(spec: ObservationSpec, seen: Observation, shrink: Shrink) -> Encoded:
    """Return network images of additional cameras, by key. Raises UsageError if one is missing."""
    encoded: Encoded = {}
    for name, key in sorted(spec.further_keys.items(), key=lambda each: each[1]):
        if name not in seen.further:
            raise UsageError(f"the network sees by a camera {name!r}, and there is no image of it")
        view, camera = seen.further[name], spec.cameras[name]
        images = (view.image, *view.earlier)
        encoded[key] = _stack(camera, images, body_bytes(camera.range_m), shrink)
    return encoded


def _stack(
    spec: ObservationSpec | SeenCamera,
    images: Sequence[NDArray[Any]],
    bytes_of: Bytes,
    shrink: Shrink,
) -> NDArray[np.uint8]:
    """Return the network's image of a camera, the newest frame first, missing frames blank."""
    rows, columns = spec.camera_rows, spec.width_px
    if spec.kind == "depth":

        def network(image: NDArray[Any]) -> NDArray[np.uint8]:
            return shrink.depth(image, rows, columns, bytes_of)[:, None]
    else:

        def network(image: NDArray[Any]) -> NDArray[np.uint8]:
            return shrink.colour(image, rows, columns)

    newest = network(images[0])
    if spec.frames == 1:
        return newest
    blank, channels = (255 if spec.kind == "depth" else 0), CHANNELS[spec.kind]
    stack = np.full((len(newest), spec.channels, rows, columns), blank, np.uint8)
    for k, image in enumerate(images[: spec.frames]):
        stack[:, k * channels : (k + 1) * channels] = newest if k == 0 else network(image)
    return stack


def _scans(spec: ObservationSpec, seen: Observation, shrink: Shrink) -> NDArray[np.uint8]:
    """Return the network's scans (n, 1, frames, bearings with the seam), the newest first."""
    scans = scans_of(seen, spec.frames, spec.width_px, shrink.scanning)
    columns = np.arange(-spec.seam, spec.width_px + spec.seam) % spec.width_px
    return scan_bytes(scans, spec.range_m)[:, None, :, columns]


def _told(names: tuple[Told, ...], seen: Observation) -> NDArray[np.float32]:
    """Return the additional inputs of n vehicles (n, k)."""
    return np.concatenate([_part(name, seen) for name in names], axis=1).astype(np.float32)


def _part(name: Told, seen: Observation) -> NDArray[np.float64]:
    """Return one additional input of n vehicles (n, k)."""
    known, state = seen.in_flight, seen.states[0] if seen.states else None
    if name == "tilt":
        return down_in_body(np.asarray(seen.roll), np.asarray(seen.pitch))
    if name == "rates":
        if state is None or state.rates is None:
            raise ValueError("the network is told the body rates, and nobody measures them")
        return np.asarray(state.rates, np.float64)
    if name == "height":
        if state is None:
            raise ValueError("the network is told its height, and nobody measures it")
        return -np.asarray(state.position[..., 2:], np.float64) / HEIGHT_SCALE_M
    if known is None:
        raise ValueError(f"the network is told {name}, and nobody keeps account of it")
    if name == "command":
        return np.asarray(known.command / (SPEED_SCALE_M_S, SPEED_SCALE_M_S, 1.0))
    if name == "setpoint":
        return np.asarray(known.setpoint)
    return np.asarray(known.latency_s if name == "latency" else known.age_s)[:, None]


def newest_frame(spec: ObservationSpec, seen: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Return a copy of one vehicle's newest frame, as a picture (h, w) or (h, w, 3)."""
    channels = seen[spec.kind][: CHANNELS[spec.kind]]
    if spec.layout == "scan":
        scan = channels[:, :1, spec.seam : spec.seam + spec.width_px]
        channels = np.repeat(scan, spec.height_px, axis=1)
    picture: NDArray[np.uint8] = np.ascontiguousarray(np.moveaxis(channels, 0, -1))
    return picture.copy() if spec.kind == "rgb" else picture[..., 0].copy()


def ablated(encoded: Mapping[str, NDArray[Any]], key: str) -> Encoded:
    """Return the arrays with one input set to zero, as in the paper's sensor ablation."""
    return {k: np.zeros_like(v) if k == key else v for k, v in encoded.items()}


def _bearing_strip(spec: ObservationSpec, seen: Observation) -> NDArray[np.uint8]:
    """Return Air Learning's strip (n, 10, width): white, a black bar at the goal's bearing.

    Bearings of -180..180 deg run from the left to the right edge. The last row is black.
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


class Layout(Protocol):
    """Interface of a custom layout."""

    def boxes(self, spec: ObservationSpec) -> Mapping[str, Box]:
        """Return the arrays by key: `spec.kind` uint8 (channels, height, width), others float32.

        Images of additional cameras (`spec.further_keys`) have the same format as `spec.kind`.
        """

    def encode(self, spec: ObservationSpec, seen: Observation) -> Mapping[str, NDArray[Any]]:
        """Return the arrays for n vehicles, as `encode_layout` does. Rows are independent."""


def own_boxes(spec: ObservationSpec) -> dict[str, Box]:
    """Return the arrays of a custom layout by key, sorted, if a network can take them."""
    found = {key: Box(*box) for key, box in sorted(_own(spec.layout).boxes(spec).items())}
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


def own_arrays(spec: ObservationSpec, seen: Observation) -> Encoded:
    """Return the arrays of a custom layout for an observation, checked against its boxes."""
    found, wanted = _own(spec.layout).encode(spec, seen), own_boxes(spec)
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
    """Return a custom layout. Raises FieldError."""
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
