"""Compensation of decision latency: predicts observations at the time of effect.

A decision that takes t2 acts on a vehicle that has moved in the meantime. The setpoints executed in
the meantime are known. Therefore the vehicle's response to them predicts the state at the time when
the decision takes effect. The depth images are reprojected to the camera's predicted pose. The
policy needs no training for it.

Vehicles respond to velocity setpoints by a first-order model in closed form (`Response`): after a
dead time the velocity approaches the setpoint with one time constant, the yaw rate with another. A
setpoint in the heading frame turns with the nose, as PX4 turns it at every repetition. These are
not the plant's equations: `scripts/fit-response` fits them to flown steps alone.

The companion (n = 1) and the vectorized simulator (n at a time) share this code; numpy alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MAX_MM, MM_PER_M
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import GRAVITY_M_S2, US_PER_MS, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import Vector, quat_from_euler, quat_to_matrix, quats_to_euler
from airl_mav.policy.observation import InFlight, Kinematics
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.vehicle import Response, VehicleProfile

LEAST_DEPTH_M = 0.05
"""Minimum depth [m]: points closer to the image plane, or a cylinder's axis, have no pixel."""

_RANK = 1 << 16
"""Rank step: older images rank behind all depths of newer ones."""

_UNSEEN = np.uint32(0xFFFFFFFF)

Image = NDArray[np.uint16]
Floats = NDArray[np.float32]


class CameraPose(NamedTuple):
    """Position and orientation of a camera."""

    position: NDArray[np.float64]  # (3,) NED [m]
    axes: NDArray[np.float64]  # (3, 3) columns: forward (optical axis), right, down, in NED


class PosedImage(NamedTuple):
    """Depth image and its camera pose."""

    depth_mm: Image  # (h, w), 0 = no return
    pose: CameraPose


class Reprojector:
    """Reprojects the images of one camera."""

    def __init__(self, camera: Camera, intrinsics: Intrinsics) -> None:
        """Take the camera, and the intrinsics of its images."""
        self._k = k = intrinsics
        self._range_m = camera.range_m
        u = (np.arange(k.width, dtype=np.float32) - np.float32(k.cx)) / np.float32(k.focal)
        v = (np.arange(k.height, dtype=np.float32) - np.float32(k.cy)) / np.float32(k.focal)
        rays = np.ones((3, k.height, k.width), np.float32)
        if k.model.tabled:
            rays[:] = k.rays
        elif k.model.cylindrical:
            rays[0], rays[1] = np.cos(u)[None, :], np.sin(u)[None, :]
        else:
            rays[1] = u[None, :]
        if not k.model.tabled:
            rays[2] = v[:, None]
        self._rays = rays.reshape(3, -1)
        """(3, h w) viewing direction of each pixel at a depth of 1: forward, right, down."""
        self._sees = self._rays.any(axis=0)
        """(h w) True if a pixel has a direction: inside a fisheye's circle."""

    def image(self, sights: Sequence[PosedImage], pose: CameraPose) -> Image:
        """Return the depth image (h, w) [mm] from a pose. The newest sight is first."""
        k, size = self._k, self._rays.shape[1]
        nearest = np.full(size, _UNSEEN, np.uint32)
        for rank, sight in enumerate(sights):
            pixels, depth_mm = self._carried(sight, pose)
            # A single minimum selects the newest image first, then the nearest depth.
            np.minimum.at(nearest, pixels, depth_mm + np.uint32(rank * _RANK))
        out = (nearest & np.uint32(MAX_MM)).astype(np.uint16)
        # Points beyond the range were observed as empty.
        out[out == MAX_MM] = 0
        unseen = nearest == _UNSEEN
        out[unseen] = self._ground_mm(pose)[unseen]
        return out.reshape(k.height, k.width)

    def _carried(
        self, sight: PosedImage, pose: CameraPose
    ) -> tuple[NDArray[np.intp], NDArray[np.uint32]]:
        """Return the pixels hit by the points of an image, and their depths [mm]."""
        k = self._k
        turn = (pose.axes.T @ sight.pose.axes).astype(np.float32)
        shift = (pose.axes.T @ (sight.pose.position - pose.position)).astype(np.float32)
        mm = sight.depth_mm.reshape(-1)
        empty = mm == 0
        depth = mm * np.float32(1.0 / MM_PER_M)
        # Empty pixels are carried at the range, so that free directions stay known.
        depth[empty] = self._range_m
        points = (turn @ self._rays) * depth
        forward, right = points[0] + shift[0], points[1] + shift[1]
        if k.model.tabled:
            return self._on_table(np.stack([forward, right, points[2] + shift[2]]), empty)
        there = np.hypot(forward, right) if k.model.cylindrical else forward
        kept = there > LEAST_DEPTH_M
        scale = np.float32(k.focal) / np.maximum(there, np.float32(LEAST_DEPTH_M))
        if k.model.cylindrical:
            column = self._bearing_column(forward, right)
        else:
            column = np.rint(right * scale + np.float32(k.cx))
        row = np.rint((points[2] + shift[2]) * scale + np.float32(k.cy))
        return self._fallen(column, row, there, kept, empty)

    def _on_table(
        self, points: Floats, empty: NDArray[np.bool_]
    ) -> tuple[NDArray[np.intp], NDArray[np.uint32]]:
        """Return as `_carried` the pixels of a tabled projection that see points (3, h w)."""
        there = np.sqrt((points * points).sum(axis=0))
        column, row = (np.rint(place) for place in self._k.model.places(self._k, points))
        kept = self._sees & (there > LEAST_DEPTH_M)
        return self._fallen(column, row, there, kept, empty)

    def _fallen(
        self,
        column: Floats,
        row: Floats,
        there: Floats,
        kept: NDArray[np.bool_],
        empty: NDArray[np.bool_],
    ) -> tuple[NDArray[np.intp], NDArray[np.uint32]]:
        """Return the pixels hit by points, filtered by `kept`, and their depths [mm]."""
        k = self._k
        kept &= (column >= 0) & (column < k.width) & (row >= 0) & (row < k.height)
        column, row, there, empty = column[kept], row[kept], there[kept], empty[kept]
        pixels = (row * np.float32(k.width) + column).astype(np.intp)
        carried_mm = np.rint(there * np.float32(MM_PER_M)).astype(np.uint32)
        # Empty and out-of-range points carry the mark MAX_MM until the minimum is known.
        carried_mm[empty | (there > self._range_m)] = MAX_MM
        return pixels, carried_mm

    def _bearing_column(self, forward: Floats, right: Floats) -> Floats:
        """Return the cylinder columns (h w) of points, modulo full turns."""
        k = self._k
        turn = np.float32(2.0 * math.pi * k.focal)
        column = np.arctan2(right, forward) * np.float32(k.focal) + np.float32(k.cx)
        # A point half a pixel left of the first column, on the seam, maps to the last one.
        column -= turn * np.floor((column + np.float32(0.5)) / turn)
        found: Floats = np.rint(column)
        return found

    def _ground_mm(self, pose: CameraPose) -> Image:
        """Return the depth (h w) [mm] of level ground at the height of the take-off."""
        # Down component of each ray.
        sinking = pose.axes[2].astype(np.float32) @ self._rays
        height = np.float32(-pose.position[2])
        with np.errstate(divide="ignore"):
            depth = np.where(sinking > 0.0, height / sinking, np.inf)
        depth[(depth > self._range_m) | (depth < LEAST_DEPTH_M)] = 0.0
        ground: Image = np.rint(depth * np.float32(MM_PER_M)).astype(np.uint16)
        return ground


Array = NDArray[np.float64]


class MotionBatch(NamedTuple):
    """Motion of n vehicles."""

    position: Array  # (n, 3) NED [m]
    velocity: Array  # (n, 3) NED [m/s]
    heading: Array  # (n,) [rad]
    heading_rate: Array  # (n,) [rad/s]


def flown_on(
    motion: MotionBatch, command: Array, response: Response, seconds: Array
) -> MotionBatch:
    """Return the motion of vehicles after (n,) seconds on one setpoint (n, 4) each.

    With the heading turning at the rate w from psi on, the horizontal velocity v as a complex
    number (north + i east) follows T v' = c exp(i (psi + w t)) - v, whose solution is A exp(i w t)
    + (v0 - A) exp(-t / T) with A = c exp(i psi) / (1 + i w T). While the turn builds up, psi is the
    heading extrapolated back from the final turn. The setpoint is forward, right, down [m/s], yaw
    rate [rad/s]. The caller handles the response's dead time.
    """
    turn, lag, turn_lag = command[:, 3], response.velocity_time_s, response.yaw_rate_time_s
    fading, turn_fading = np.exp(-seconds / lag), np.exp(-seconds / turn_lag)
    # Extrapolate the heading of the final turn back to now.
    lead = (motion.heading_rate - turn) * turn_lag
    turned = turn * seconds
    wanted = (command[:, 0] + 1j * command[:, 1]) * np.exp(1j * (motion.heading + lead))
    follows = wanted / (1.0 + 1j * lag * turn)
    velocity = motion.velocity[:, 0] + 1j * motion.velocity[:, 1] - follows
    # The integral of exp(i w t); sinc has no trouble where w is zero.
    arc = seconds * np.sinc(turned / (2.0 * math.pi)) * np.exp(0.5j * turned)
    moved = follows * arc + velocity * (lag * (1.0 - fading))
    velocity = follows * np.exp(1j * turned) + velocity * fading
    # The vertical velocity has the same time constant, but no turn.
    sinking = motion.velocity[:, 2] - command[:, 2]
    sunk = command[:, 2] * seconds + sinking * (lag * (1.0 - fading))
    return MotionBatch(
        motion.position + np.stack([moved.real, moved.imag, sunk], axis=1),
        np.stack([velocity.real, velocity.imag, command[:, 2] + sinking * fading], axis=1),
        motion.heading + turned + lead * (1.0 - turn_fading),
        turn + (motion.heading_rate - turn) * turn_fading,
    )


def leaning(motion: MotionBatch, command: Array, response: Response) -> tuple[Array, Array]:
    """Return the roll and pitch (n,) [rad] of vehicles that fly a setpoint (n, 4).

    The thrust carries the weight, accelerates the vehicle and balances the drag, so it lies along
    the sum of the three.
    """
    course = np.exp(-1j * motion.heading)
    velocity = (motion.velocity[:, 0] + 1j * motion.velocity[:, 1]) * course
    wanted = command[:, 0] + 1j * command[:, 1]
    # Acceleration of the first-order response, plus the drag that it must overcome.
    push = (wanted - velocity) / response.velocity_time_s + response.drag_1_s * velocity
    pitch = -np.arctan2(push.real, GRAVITY_M_S2)
    return np.arctan2(push.imag * np.cos(pitch), GRAVITY_M_S2), pitch


LINK_US = round(4.0 * US_PER_MS)
"""Time from sending a setpoint to its effect [µs]: a tick of the flight controller."""

REMEMBERED = 4
"""Default number of stored images; more do not fly better (docs/results.md)."""

NEVER_US = np.iinfo(np.int64).max


class Compensator:
    """Predicts the observations of n companions."""

    def __init__(
        self,
        n: int,
        vehicle: VehicleProfile,
        intrinsics: Intrinsics,
        *,
        remembered: int = REMEMBERED,
    ) -> None:
        """Prepare n companions of one vehicle, whose camera has these intrinsics.

        `remembered` images are stored: the newest, and older ones that fill its unseen parts.
        Raises FieldError if the vehicle's profile lacks a setpoint response, or the camera gives no
        depth.
        """
        if intrinsics.kind != "depth":
            raise FieldError(
                "compensate",
                True,
                problem=f"the vehicle has a camera of kind {intrinsics.kind!r}, and only depth can"
                " be carried forward; accepted: no compensation, or a depth camera",
            )
        if vehicle.response is None:
            raise FieldError(
                "compensate",
                True,
                problem="the vehicle's profile has no table `response`; scripts/fit-response"
                " identifies it",
            )
        self.intrinsics = intrinsics
        """Intrinsics of the predicted images."""
        self._response = vehicle.response
        self._dead_us = round(self._response.dead_time_s * US_PER_S)
        self._mount = _Mount(vehicle.camera)
        self._reprojector = Reprojector(vehicle.camera, intrinsics)
        self.memory = DecisionMemory(n, foresees=True)
        """Setpoints and latencies so far."""
        shape = (intrinsics.height, intrinsics.width)
        self._depth_mm = np.zeros((n, remembered, *shape), np.uint16)
        self._position = np.zeros((n, remembered, 3))
        self._axes = np.zeros((n, remembered, 3, 3))
        self._kept = np.zeros(n, np.int64)
        """Number of stored images per companion; the newest come first."""
        # Pipelined, at most one is sent per frame, and many before the first takes effect.
        room = (LINK_US + self._dead_us) // vehicle.camera.period_us + 3
        self._setpoint = np.zeros((n, room, 4))
        """Setpoints, newest first: forward, right, down [m/s], yaw rate [rad/s]."""
        self._answered_us = np.zeros((n, room), np.int64)
        """Start of the velocity's response to each [µs]."""
        self._sooner_us = self._dead_us - round(self._response.yaw_rate_dead_time_s * US_PER_S)
        """Time by which the yaw rate responds sooner [µs]."""
        self._stopped_us = np.full(n, NEVER_US, np.int64)
        """Expiry of the newest setpoint, after which the vehicle hovers [µs]."""

    def begin(self, i: int) -> None:
        """Begin a flight of companion i, in a hover."""
        self.memory.begin(i)
        self._kept[i] = 0
        self._setpoint[i], self._answered_us[i], self._stopped_us[i] = 0.0, 0, NEVER_US

    def forget(self, i: int) -> None:
        """Discard the images of companion i before a discontinuity."""
        self._kept[i] = 0

    def held(self) -> Mapping[str, Any]:
        """Return all mutable arrays by name, for checkpoints."""
        return {
            "depth_mm": self._depth_mm,
            "position": self._position,
            "axes": self._axes,
            "kept": self._kept,
            "setpoint": self._setpoint,
            "answered_us": self._answered_us,
            "stopped_us": self._stopped_us,
        }

    def foresee(
        self,
        who: NDArray[np.intp],
        depth_mm: NDArray[np.uint16],
        age_us: NDArray[np.int64],
        now_us: NDArray[np.int64],
        state: Kinematics,
    ) -> tuple[NDArray[np.uint16], Kinematics]:
        """Return images and motion of the vehicles at the time when their decisions take effect.

        Call once per decision: the images are stored. Only the rows `who` (k,) decide. `depth_mm`
        (n, h, w) are the newest images, 0 = no return, taken `age_us` (n,) ago. The decisions begin
        at `now_us` (n,).
        """
        roll, pitch, heading = quats_to_euler(state.quaternion)
        now = MotionBatch(state.position, state.velocity, heading, self._heading_rate(now_us))
        # The state now, flown on to the time of effect.
        then, command = self._carried(now, now_us)
        quaternion = state.quaternion.copy()
        tilted = leaning(then, command, self._response)
        image = depth_mm.copy()
        for i in who.tolist():
            age_s = age_us[i] / US_PER_S
            # Assumes an unchanged tilt: it changes little once a setpoint is flown.
            taken = quat_from_euler(
                float(roll[i]), float(pitch[i]), float(heading[i] - now.heading_rate[i] * age_s)
            )
            self._keep(i, depth_mm[i], state.position[i] - state.velocity[i] * age_s, taken)
            quaternion[i] = quat_from_euler(
                float(tilted[0][i]), float(tilted[1][i]), float(then.heading[i])
            )
            sights = [
                PosedImage(self._depth_mm[i, k], CameraPose(self._position[i, k], self._axes[i, k]))
                for k in range(int(self._kept[i]))
            ]
            pose = self._mount.pose(then.position[i], quaternion[i])
            image[i] = self._reprojector.image(sights, pose)
        return image, Kinematics(then.position, then.velocity, quaternion)

    def decided(
        self,
        who: NDArray[np.intp],
        command: NDArray[np.float64],
        t2_us: NDArray[np.int64],
        sent_us: NDArray[np.int64],
        stopped_us: NDArray[np.int64] | None = None,
    ) -> None:
        """Store the sent setpoints (k, 4) forward, right, down [m/s], yaw rate [rad/s].

        The decisions took `t2_us` (k,); `stopped_us` (k,) is the time at which a stop replaces each
        without a newer one, None: never.
        """
        self.memory.decided(who, command, t2_us)
        for array in (self._setpoint, self._answered_us):
            array[who, 1:] = array[who, :-1]
        self._setpoint[who, 0] = command
        self._answered_us[who, 0] = sent_us + LINK_US + self._dead_us
        self._stopped_us[who] = (
            NEVER_US if stopped_us is None else stopped_us + LINK_US + self._dead_us
        )

    def _heading_rate(self, now_us: NDArray[np.int64]) -> Vector:
        """Return the turn rates (n,) [rad/s] of the vehicles, by their setpoints alone."""
        turns = self._setpoint[:, ::-1, 3].T
        begins_us = (self._answered_us - self._sooner_us).T[::-1]
        # Each turn lasts until the response to the next setpoint begins.
        ends_us = np.minimum(np.vstack([begins_us[1:], now_us]), now_us)
        answered_s = np.maximum(ends_us - begins_us, 0) / US_PER_S
        fading = np.exp(-answered_s / self._response.yaw_rate_time_s)
        rate: Vector = turns[0]
        for turn, kept in zip(turns, fading, strict=True):
            rate = turn + (rate - turn) * kept
        return rate

    def _carried(
        self, motion: MotionBatch, now_us: NDArray[np.int64]
    ) -> tuple[MotionBatch, Vector]:
        """Return the predicted motion, and the setpoints (n, 4) that will be in effect."""
        acts_us = now_us + self.memory.latency.expected_us() + LINK_US
        turned_us = self._answered_us - self._sooner_us
        marks_us = np.vstack([now_us, self._answered_us.T, turned_us.T, self._stopped_us, acts_us])
        marks_us = np.sort(np.clip(marks_us, now_us, acts_us), axis=0)
        seconds = np.diff(marks_us, axis=0) / US_PER_S
        command = self._setpoint[:, -1]
        # Skip empty intervals.
        for k in np.flatnonzero(seconds.any(axis=1)).tolist():
            flown = _newest(self._setpoint, self._answered_us, marks_us[k])
            flown[:, 3] = _newest(self._setpoint, turned_us, marks_us[k])[:, 3]
            # A stop follows the newest setpoint: zero velocity.
            flown[self._stopped_us <= marks_us[k]] = 0.0
            motion = flown_on(motion, flown, self._response, seconds[k])
            command = np.where(seconds[k, :, None] > 0.0, flown, command)
        return motion, command

    def _keep(
        self, i: int, depth_mm: NDArray[np.uint16], position: Vector, quaternion: Vector
    ) -> None:
        """Store an image of companion i, and its pose."""
        # Newest first; the oldest image is dropped.
        for array in (self._depth_mm, self._position, self._axes):
            array[i, 1:] = array[i, :-1]
        pose = self._mount.pose(position, quaternion)
        self._depth_mm[i, 0], self._position[i, 0], self._axes[i, 0] = depth_mm, *pose
        self._kept[i] = min(self._kept[i] + 1, self._depth_mm.shape[1])


def _newest(setpoint: Array, begins_us: NDArray[np.int64], now_us: NDArray[np.int64]) -> Array:
    """Return the newest of the setpoints (n, k, 4) that has begun; the oldest if none has."""
    begun = begins_us <= now_us[:, None]
    begun[:, -1] = True
    found: Array = setpoint[np.arange(len(setpoint)), begun.argmax(axis=1)]
    return found


class _Mount:
    """Camera mount on its vehicle."""

    def __init__(self, camera: Camera) -> None:
        self._offset = np.array([camera.forward_m, camera.right_m, -camera.up_m])
        pitch, yaw = np.deg2rad(camera.pitch_up_deg), np.deg2rad(camera.yaw_deg)
        self._turn = quat_to_matrix(quat_from_euler(0.0, float(pitch), float(yaw)))

    def pose(self, position: Vector, quaternion: Vector) -> CameraPose:
        """Return the camera pose of a vehicle at NED [m], body -> NED."""
        axes = quat_to_matrix(quaternion)
        return CameraPose(position + axes @ self._offset, axes @ self._turn)


class DecisionMemory:
    """Decisions of n companions."""

    def __init__(self, n: int, *, foresees: bool = False) -> None:
        """Take the number of companions, and whether their observations are compensated."""
        self.foresees = foresees
        self.latency = ExpectedLatency(n)
        """Expected t2."""
        self.newest = np.zeros((n, 4))
        """(n, 4) newest setpoints, as `InFlight.setpoint`."""

    def begin(self, i: int) -> None:
        """Begin a flight of companion i, in a hover."""
        self.latency.begin(i)
        self.newest[i] = 0.0

    def decided(
        self, who: NDArray[np.intp], setpoint: NDArray[np.float64], t2_us: NDArray[np.int64]
    ) -> None:
        """Store the setpoints (k, 4) that the companions in `who` (k,) sent, and their t2 [µs]."""
        self.latency.measure(who, t2_us)
        self.newest[who] = setpoint

    def in_flight(self, age_us: NDArray[np.int64]) -> InFlight:
        """Return the inputs for policies; `age_us` (n,) is the age of the images."""
        return InFlight(
            self.latency.expected_us() / US_PER_S,
            age_us / US_PER_S,
            self.newest,
            self.foresees,
        )

    def held(self) -> Mapping[str, Any]:
        """Return all mutable arrays by name, for checkpoints."""
        return {
            "newest": self.newest,
            "measured_us": self.latency.measured_us,
            "measured": self.latency.count,
        }


RECENT = 32
"""Number of recent decisions that count."""


class ExpectedLatency:
    """Expected t2 of n companions: the mean of each companion's recent measurements.

    Zero before the first decision, when the vehicle hovers and latency has no effect. The mean
    flies better than a high quantile (docs/results.md), because the predicted position is then
    correct on average.
    """

    def __init__(self, n: int) -> None:
        """Take the number of companions."""
        self.measured_us = np.zeros((n, RECENT), np.int64)
        """(n, 32) newest t2 [µs], in a ring."""
        self.count = np.zeros(n, np.int64)
        """(n,) decisions measured."""

    def begin(self, i: int) -> None:
        """Reset the measurements of companion i."""
        self.count[i] = 0

    def measure(self, who: NDArray[np.intp], t2_us: NDArray[np.int64]) -> None:
        """Store the decision times [µs] (k,) of the companions in `who` (k,)."""
        self.measured_us[who, self.count[who] % RECENT] = t2_us
        self.count[who] += 1

    def expected_us(self) -> NDArray[np.int64]:
        """Return the expected t2 (n,) [µs] of each next decision."""
        known = np.minimum(self.count, RECENT)
        # Before the ring is full, only measured entries count.
        counted = np.arange(RECENT) < known[:, None]
        total = np.where(counted, self.measured_us, 0).sum(axis=1)
        mean: NDArray[np.int64] = total // np.maximum(known, 1)
        return mean
