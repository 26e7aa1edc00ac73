"""Observations of n vehicles: the cameras in use, their layout, and encoding in compiled loops.

The compiled loops are several times faster than numpy. `policy.images` defines the images; the
companion has no numba and computes them with numpy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MM_PER_M
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.kernels import kernel
from airl_mav.envs.fleet import Fleet
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.faults import Fault
from airl_mav.policy import observation_spec
from airl_mav.policy.images import (
    BAND_M,
    NEAREST_M,
    WIDEST_RAD,
    Bytes,
    Floats,
    Moved,
    Scanning,
    ScanRays,
    Shrink,
    Tilt,
    goes_round,
)
from airl_mav.policy.layouts import DISTANCE_SCALE_M, LEAST_DISTANCE_M, SPEED_SCALE_M_S
from airl_mav.profiles.camera import Camera, check_gym_imaging, check_noise
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.vehicle.rotation import Quat, Vec, multiply, yaw_of


def level_scan(depth_mm: NDArray[np.uint16], rays: ScanRays, tilt: Tilt, bearings: int) -> Floats:
    """Return the same as `policy.scans.level_scan`."""
    found = np.full((len(depth_mm), bearings), np.inf)
    _level_scan(np.ascontiguousarray(depth_mm), rays, tilt, goes_round(rays.fov_rad), found)
    return found


def carried(scans: Floats, moved: Moved, fov_rad: float) -> Floats:
    """Return the same as `policy.scans.carried`."""
    found = np.full(scans.shape, np.inf)
    _carry(scans, moved, fov_rad, goes_round(fov_rad), found)
    return found


COMPILED_SCANNING = Scanning(level_scan, carried)
"""Scan functions of the vectorized simulator."""


@kernel
def _level_scan(
    depth_mm: NDArray[np.uint16], rays: ScanRays, tilt: Tilt, whole: bool, found: Floats
) -> None:
    bearings = found.shape[1]
    share = bearings / rays.fov_rad
    for i in range(len(depth_mm)):
        sr, cr = tilt.sin_roll[i], tilt.cos_roll[i]
        sp, cp = tilt.sin_pitch[i], tilt.cos_pitch[i]
        for v in range(depth_mm.shape[1]):
            for u in range(depth_mm.shape[2]):
                if depth_mm[i, v, u] == 0:
                    continue
                depth = depth_mm[i, v, u] / MM_PER_M
                ahead, right = depth * rays.forward[u], depth * rays.right[u]
                down = depth * rays.down[v]
                # Rotate the point by roll, then by pitch; `BAND_M` selects points at the vehicle's
                # height.
                below = sr * right + cr * down
                if abs(cp * below - sp * ahead) > BAND_M:
                    continue
                level_right, level_ahead = cr * right - sr * down, cp * ahead + sp * below
                angle = math.atan2(level_right, level_ahead) + 0.5 * rays.fov_rad
                bearing = math.floor(angle * share)
                # A scan all around wraps at its edge.
                if whole:
                    bearing %= bearings
                if 0 <= bearing < bearings:
                    distance = math.sqrt(level_ahead * level_ahead + level_right * level_right)
                    # The nearest point of each bearing counts.
                    found[i, bearing] = min(found[i, bearing], distance)


@kernel
def _carry(scans: Floats, moved: Moved, fov_rad: float, whole: bool, found: Floats) -> None:
    bearings = scans.shape[1]
    step = fov_rad / bearings
    for i in range(len(scans)):
        for bearing in range(bearings):
            distance = scans[i, bearing]
            if not math.isfinite(distance):
                continue
            # The middle of the bearing after the vehicle's turn; then the shift in the new axes.
            angle = (bearing + 0.5) * step - 0.5 * fov_rad - moved.turned_rad[i]
            ahead = distance * math.cos(angle) + moved.forward_m[i]
            right = distance * math.sin(angle) + moved.right_m[i]
            now = math.sqrt(ahead * ahead + right * right)
            # A nearer obstacle covers more bearings than before.
            half = min(0.5 * step * distance / max(now, NEAREST_M), WIDEST_RAD)
            angle = math.atan2(right, ahead) + 0.5 * fov_rad
            middle = math.floor(angle / step)
            # At least the bearing of the middle is covered.
            first = min(math.ceil((angle - half) / step - 0.5), middle)
            last = max(math.floor((angle + half) / step - 0.5), middle)
            for covered in range(first, last + 1):
                at = covered % bearings if whole else covered
                if 0 <= at < bearings:
                    found[i, at] = min(found[i, at], now)


def shrink_depth(
    depth_mm: NDArray[np.uint16], rows: int, columns: int, bytes_of: Bytes
) -> NDArray[np.uint8]:
    """Return the same as `policy.images.shrink_depth`."""
    images = np.empty((len(depth_mm), rows, columns), np.uint8)
    _shrink(depth_mm, bytes_of.table, bytes_of.far_mm, images)
    return images


def shrink_colour(image: NDArray[np.uint8], rows: int, columns: int) -> NDArray[np.uint8]:
    """Return the same as `policy.images.shrink_colour`."""
    images = np.empty((len(image), image.shape[3], rows, columns), np.uint8)
    _shrink_colour(image, images)
    return images


COMPILED = Shrink(shrink_depth, shrink_colour, COMPILED_SCANNING)
"""Image functions of the vectorized simulator."""


@kernel
def _shrink_colour(image: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    channels, rows, columns = out.shape[1], out.shape[2], out.shape[3]
    tall, wide = image.shape[1] // rows, image.shape[2] // columns
    # The sizes are equal: transpose only.
    if tall == 1 and wide == 1:
        for i in range(len(out)):
            for row in range(rows):
                for channel in range(channels):
                    line = out[i, channel, row]
                    for column in range(columns):
                        line[column] = image[i, row, column, channel]
        return
    count = np.uint32(tall * wide)
    sums = np.empty((channels, columns), np.uint32)
    for i in range(len(out)):
        for row in range(rows):
            # Starting at half the count rounds the mean to the nearest.
            sums[:, :] = count // np.uint32(2)
            for k in range(tall):
                for column in range(columns):
                    for m in range(wide):
                        for channel in range(channels):
                            sums[channel, column] += image[
                                i, row * tall + k, column * wide + m, channel
                            ]
            for channel in range(channels):
                for column in range(columns):
                    out[i, channel, row, column] = np.uint8(sums[channel, column] // count)


@kernel
def _shrink(
    depth_mm: NDArray[np.uint16], table: NDArray[np.uint8], far_mm: float, out: NDArray[np.uint8]
) -> None:
    rows, columns = out.shape[1], out.shape[2]
    tall, wide = depth_mm.shape[1] // rows, depth_mm.shape[2] // columns
    if tall == 1 and wide == 1:
        _to_bytes(depth_mm.ravel(), np.uint16(1), table, far_mm, out.ravel())
        return
    line, least = np.empty(depth_mm.shape[2], np.uint16), np.empty((rows, columns), np.uint16)
    for i in range(len(out)):
        for row in range(rows):
            # Unsigned: 0 (no return) minus 1 wraps to 65,535, the maximum, so min ignores it.
            for u in range(len(line)):
                line[u] = depth_mm[i, row * tall, u] - np.uint16(1)
            for k in range(1, tall):
                for u in range(len(line)):
                    line[u] = min(line[u], np.uint16(depth_mm[i, row * tall + k, u] - 1))
            if wide == 2:
                # The usual case: the compiler vectorizes a stride known at compile time.
                for column in range(columns):
                    least[row, column] = min(line[2 * column], line[2 * column + 1])
            else:
                for column in range(columns):
                    nearest = line[column * wide]
                    for k in range(1, wide):
                        nearest = min(nearest, line[column * wide + k])
                    least[row, column] = nearest
        _to_bytes(least.ravel(), np.uint16(0), table, far_mm, out[i].ravel())


@kernel
def _to_bytes(
    depths: NDArray[np.uint16],
    less: np.uint16,
    table: NDArray[np.uint8],
    far_mm: float,
    out: NDArray[np.uint8],
) -> None:
    """Write the bytes of depths (k,), which exceed the values in `Bytes` by `less`."""
    # far_mm = 0: the bytes come from a table.
    if far_mm == 0.0:
        for u in range(len(depths)):
            out[u] = table[np.uint16(depths[u] - less)]
        return
    one, most, far = np.float32(1.0), np.float32(255.0), np.float32(far_mm)
    for u in range(len(depths)):
        ratio = most * (np.float32(np.uint16(depths[u] - less)) + one) / far
        out[u] = np.uint8(np.rint(ratio if ratio < most else most))


class EncodedBody(NamedTuple):
    """Arrays of the layout `body` of a depth image, for n vehicles."""

    depth: NDArray[np.uint8]  # (n, h, w)
    velocity: NDArray[np.float32]  # (n, 3)
    goal: NDArray[np.float32]  # (n, 3)


@kernel
def encode_body(
    fleet: Fleet,
    errors: NDArray[np.float64],
    depth_mm: NDArray[np.uint16],
    goal: NDArray[np.float64],
    bytes_of: Bytes,
    out: EncodedBody,
) -> None:
    """Write the policy input of n vehicles, as `observe` and `encode_layout` do.

    `errors` (n, 9) are the errors of telemetry, `depth_mm` (n, h, w) the newest images, and `goal`
    is (n, 3) `ArenaBatch.goal`.
    """
    _shrink(depth_mm, bytes_of.table, bytes_of.far_mm, out.depth)
    for i in range(len(errors)):
        q, e = fleet.quaternion[i], errors[i]
        cos, sin = heading_told((q[0], q[1], q[2], q[3]), (e[6], e[7], e[8]))
        here = fleet.position[i]
        # Policy inputs use telemetry: the true state plus the errors.
        north, east = goal[i, 0] - (here[0] + e[0]), goal[i, 1] - (here[1] + e[1])
        ahead, right = cos * north + sin * east, cos * east - sin * north
        distance = math.hypot(ahead, right)
        # At the goal its direction is 0, not NaN.
        safe = max(distance, LEAST_DISTANCE_M)
        out.goal[i, 0], out.goal[i, 1] = ahead / safe, right / safe
        out.goal[i, 2] = distance / DISTANCE_SCALE_M
        north, east = fleet.velocity[i, 0] + e[3], fleet.velocity[i, 1] + e[4]
        out.velocity[i, 0] = (cos * north + sin * east) / SPEED_SCALE_M_S
        out.velocity[i, 1] = (cos * east - sin * north) / SPEED_SCALE_M_S
        out.velocity[i, 2] = (fleet.velocity[i, 2] + e[5]) / SPEED_SCALE_M_S


@kernel
def heading_told(quaternion: Quat, turn: Vec) -> tuple[float, float]:
    """Return cosine and sine of the heading that telemetry reports for an attitude, body -> NED.

    `turn` is the attitude error [rad], as in `draws.perturbed`.
    """
    angle = math.sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2])
    # The same operations as `np.sinc`, so that the result has the same bits.
    half = math.pi * (angle / (2.0 * math.pi))
    share = 0.5 if angle == 0.0 else 0.5 * (math.sin(half) / half)
    error = (math.cos(0.5 * angle), share * turn[0], share * turn[1], share * turn[2])
    yaw = yaw_of(multiply(error, quaternion))
    return math.cos(yaw), math.sin(yaw)


LENS = ("projection", "horizontal_fov_deg", "distortion", "range_m", "kind")
"""Fields of a camera that the layout of an observation contains."""


class Sight(NamedTuple):
    """Cameras in use, and their observation layout."""

    camera: Camera
    """Main camera."""
    further: dict[str, Camera]
    """Additional cameras of the vehicle that the environment names."""
    observation: observation_spec.ObservationSpec

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of the main camera."""
        return Intrinsics.of(self.camera)

    @property
    def lenses(self) -> dict[str, Intrinsics]:
        """Intrinsics of the additional cameras by name."""
        return {name: Intrinsics.of(each) for name, each in self.further.items()}

    @property
    def coloured(self) -> bool:
        """True if any camera is a colour or grey camera."""
        return any(each.kind != "depth" for each in (self.camera, *self.further.values()))


def sight_of(spec: EnvironmentSpec, vehicle: VehicleProfile) -> Sight:
    """Return the camera input of an environment's networks.

    Raises:
        UsageError: The vehicle's cameras do not match the layout, or a camera is missing.
    """
    camera = spec.camera.of(vehicle.camera)
    observation = observation_spec.ObservationSpec(
        **{name: getattr(spec, name) for name in ("layout", "frames", "in_flight", "goal_height")},
        **{name: getattr(camera, name) for name in LENS},
        height_px=spec.image_height_px,
        width_px=spec.image_width_px,
        cameras=further_seen(spec, vehicle),
    )
    sight = Sight(camera, {name: vehicle.cameras[name] for name in spec.cameras}, observation)
    if problem := observation_spec.camera_mismatch(observation, sight.intrinsics):
        raise UsageError(f"image_width_px, image_height_px: {problem}")
    if problem := observation_spec.further_mismatch(observation, sight.lenses):
        raise UsageError(f"cameras: {problem}")
    # A level scan assumes that the middle of the image is ahead.
    if spec.layout == "scan" and camera.yaw_deg != 0.0:
        accepted = "another with a camera that does not look ahead (camera.yaw_deg)"
        raise FieldError("layout", spec.layout, accepted)
    return sight


def further_seen(
    spec: EnvironmentSpec, vehicle: VehicleProfile
) -> dict[str, observation_spec.SeenCamera]:
    """Return the observation layout of additional cameras by name.

    Raises:
        FieldError: The vehicle has no camera with this name.
    """
    found = {}
    for name, asked in spec.cameras.items():
        camera = vehicle.cameras.get(name)
        if camera is None:
            has = ", ".join(map(repr, vehicle.cameras)) or "none beside its main one"
            problem = f"vehicle {spec.vehicle} has no such camera; accepted: {has}"
            raise FieldError(f"cameras.{name}", problem=problem)
        found[name] = observation_spec.SeenCamera(
            **{field: getattr(camera, field) for field in LENS},
            height_px=asked.image_height_px or camera.height_px,
            width_px=asked.image_width_px or camera.width_px,
            frames=asked.frames,
        )
    return found


def check_conditions(sight: Sight, spec: EnvironmentSpec, faults: Sequence[Fault]) -> None:
    """Raise FieldError for camera conditions that the vectorized simulator does not support."""
    further = sight.further.values()
    check_noise(sight.camera, spec.randomisation, faults, "randomisation", further)
    check_gym_imaging(sight.camera)
    for name, camera in sight.further.items():
        check_gym_imaging(camera, name)
