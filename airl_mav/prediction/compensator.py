"""Compensation of decision latency: what a decision sees is what it will act on.

A decision that takes t2 acts on a vehicle that has flown on meanwhile. But what it flies on is
known: the setpoints that were sent. So the state is carried forward by the vehicle's response to
them, to the moment at which the decision is expected to act. And the depth images are reprojected
to where the camera will be then. The policy need not have been trained for it.

Vehicles answer velocity setpoints by a first-order model in closed form (`Response`): after a dead
time the velocity approaches the setpoint with one time constant, the yaw rate with another. A
setpoint in the heading frame turns with the nose, as PX4 turns it at every repetition. These are
not the plant's equations: `scripts/fit-response` fits them to flown steps alone.

The same code in the companion (n = 1) and in the batch twin (n at a time); numpy alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import GRAVITY_M_S2, US_PER_MS, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import Vector, quat_from_euler, quat_to_matrix, quats_to_euler
from airl_mav.policy.observation import Kinematics
from airl_mav.prediction.memory import DecisionMemory
from airl_mav.prediction.reprojection import CameraPose, Reprojector, Sight
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.vehicle import Response, VehicleProfile

Array = NDArray[np.float64]


class Motion(NamedTuple):
    """How n vehicles move."""

    position: Array  # (n, 3) NED [m]
    velocity: Array  # (n, 3) NED [m/s]
    heading: Array  # (n,) [rad]
    heading_rate: Array  # (n,) [rad/s]


def flown_on(motion: Motion, command: Array, response: Response, seconds: Array) -> Motion:
    """Return the motion of vehicles after (n,) seconds on one setpoint (n, 4) each.

    With the heading turning at the rate w from psi on, the horizontal velocity v as a complex
    number (north + i east) follows T v' = c exp(i (psi + w t)) - v, whose solution is A exp(i w t)
    + (v0 - A) exp(-t / T) with A = c exp(i psi) / (1 + i w T). While the turn itself still builds
    up, psi is that of the turn it ends in. The setpoint is forward, right, down [m/s], yaw rate
    [rad/s]. The response's dead time is left to the caller.
    """
    turn, lag, turn_lag = command[:, 3], response.velocity_time_s, response.yaw_rate_time_s
    fading, turn_fading = np.exp(-seconds / lag), np.exp(-seconds / turn_lag)
    lead = (motion.heading_rate - turn) * turn_lag
    turned = turn * seconds
    wanted = (command[:, 0] + 1j * command[:, 1]) * np.exp(1j * (motion.heading + lead))
    follows = wanted / (1.0 + 1j * lag * turn)
    velocity = motion.velocity[:, 0] + 1j * motion.velocity[:, 1] - follows
    # The integral of exp(i w t); sinc has no trouble where w is zero.
    arc = seconds * np.sinc(turned / (2.0 * math.pi)) * np.exp(0.5j * turned)
    moved = follows * arc + velocity * (lag * (1.0 - fading))
    velocity = follows * np.exp(1j * turned) + velocity * fading
    sinking = motion.velocity[:, 2] - command[:, 2]
    sunk = command[:, 2] * seconds + sinking * (lag * (1.0 - fading))
    return Motion(
        motion.position + np.stack([moved.real, moved.imag, sunk], axis=1),
        np.stack([velocity.real, velocity.imag, command[:, 2] + sinking * fading], axis=1),
        motion.heading + turned + lead * (1.0 - turn_fading),
        turn + (motion.heading_rate - turn) * turn_fading,
    )


def leaning(motion: Motion, command: Array, response: Response) -> tuple[Array, Array]:
    """Return the roll and pitch (n,) [rad] with which the vehicles fly on a setpoint (n, 4).

    The thrust carries the weight and gives the acceleration and what the drag takes, so that it is
    along the sum of the three.
    """
    course = np.exp(-1j * motion.heading)
    velocity = (motion.velocity[:, 0] + 1j * motion.velocity[:, 1]) * course
    wanted = command[:, 0] + 1j * command[:, 1]
    push = (wanted - velocity) / response.velocity_time_s + response.drag_1_s * velocity
    pitch = -np.arctan2(push.real, GRAVITY_M_S2)
    return np.arctan2(push.imag * np.cos(pitch), GRAVITY_M_S2), pitch


LINK_US = round(4.0 * US_PER_MS)
"""A setpoint is taken to be in effect so long after it was sent [µs]: a tick of the flight
controller."""

REMEMBERED = 4
"""Images that are kept by default; more do not fly better (docs/results.md)."""

NEVER_US = np.iinfo(np.int64).max


class Compensator:
    """Carries forward what n companions see."""

    def __init__(
        self,
        n: int,
        vehicle: VehicleProfile,
        intrinsics: Intrinsics,
        *,
        remembered: int = REMEMBERED,
    ) -> None:
        """Prepare n companions of one vehicle, whose camera has these intrinsics.

        So many images are `remembered`: the newest, and those that fill what it did not see. Raises
        FieldError if the vehicle's profile does not say how it answers setpoints, or the camera
        gives no depth.
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
        """Of the images that are carried forward."""
        self._response = vehicle.response
        self._dead_us = round(self._response.dead_time_s * US_PER_S)
        self._mount = _Mount(vehicle.camera)
        self._reprojector = Reprojector(vehicle.camera, intrinsics)
        self.memory = DecisionMemory(n)
        """The setpoints and latencies so far."""
        shape = (intrinsics.height, intrinsics.width)
        self._depth_mm = np.zeros((n, remembered, *shape), np.uint16)
        self._position = np.zeros((n, remembered, 3))
        self._axes = np.zeros((n, remembered, 3, 3))
        self._kept = np.zeros(n, np.int64)
        """Images that each one has; the newest come first."""
        # Pipelined, one is sent with every frame at most, and many before the first is answered.
        room = (LINK_US + self._dead_us) // vehicle.camera.period_us + 3
        self._setpoint = np.zeros((n, room, 4))
        """The newest comes first: forward, right, down [m/s], yaw rate [rad/s]."""
        self._answered_us = np.zeros((n, room), np.int64)
        """When the vehicle begins to answer each."""
        self._stopped_us = np.full(n, NEVER_US, np.int64)
        """When the newest one expires, and the vehicle is told to hover."""

    def begin(self, i: int) -> None:
        """Begin a flight of companion i, in a hover."""
        self.memory.begin(i)
        self._kept[i] = 0
        self._setpoint[i], self._answered_us[i], self._stopped_us[i] = 0.0, 0, NEVER_US

    def forget(self, i: int) -> None:
        """Forget the images of companion i: what comes next does not follow on them."""
        self._kept[i] = 0

    def held(self) -> Mapping[str, Any]:
        """Return by name all arrays that change, for checkpoints."""
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
        """Return images and motion of the vehicles at the time when their decisions will act.

        Call it once a decision: the images are kept. Only the rows `who` (k,) decide. `depth_mm`
        (n, h, w) are the newest images, 0 = no return. They were taken `age_us` (n,) ago. The
        decisions begin at `now_us` (n,).
        """
        roll, pitch, heading = quats_to_euler(state.quaternion)
        now = Motion(state.position, state.velocity, heading, self._heading_rate(now_us))
        then, command = self._carried(now, now_us)
        quaternion = state.quaternion.copy()
        tilted = leaning(then, command, self._response)
        image = depth_mm.copy()
        for i in who.tolist():
            age_s = age_us[i] / US_PER_S
            # The tilt is taken to be the same as then: it changes little once a setpoint is flown.
            taken = quat_from_euler(
                float(roll[i]), float(pitch[i]), float(heading[i] - now.heading_rate[i] * age_s)
            )
            self._keep(i, depth_mm[i], state.position[i] - state.velocity[i] * age_s, taken)
            quaternion[i] = quat_from_euler(
                float(tilted[0][i]), float(tilted[1][i]), float(then.heading[i])
            )
            sights = [
                Sight(self._depth_mm[i, k], CameraPose(self._position[i, k], self._axes[i, k]))
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
        """Take the setpoints (k, 4) forward, right, down [m/s], yaw rate [rad/s] that were sent.

        The decisions took `t2_us` (k,); `stopped_us` (k,) is when a stop replaces each if no other
        has come, None: never.
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
        """Return the rates (n,) [rad/s] at which the vehicles turn, by their setpoints alone."""
        turns, begins_us = self._setpoint[:, ::-1, 3].T, self._answered_us.T[::-1]
        ends_us = np.minimum(np.vstack([begins_us[1:], now_us]), now_us)
        answered_s = np.maximum(ends_us - begins_us, 0) / US_PER_S
        fading = np.exp(-answered_s / self._response.yaw_rate_time_s)
        rate: Vector = turns[0]
        for turn, kept in zip(turns, fading, strict=True):
            rate = turn + (rate - turn) * kept
        return rate

    def _carried(self, motion: Motion, now_us: NDArray[np.int64]) -> tuple[Motion, Vector]:
        """Return how the vehicles will move, and the setpoints (n, 4) that will be in effect."""
        acts_us = now_us + self.memory.latency.expected_us() + LINK_US
        flown = [*self._setpoint.swapaxes(0, 1)[::-1], np.zeros_like(self._setpoint[:, 0])]
        # Each lasts until the next is answered, none begins before now or lasts longer than asked.
        marks_us = np.vstack([now_us, self._answered_us.T[-2::-1], self._stopped_us, acts_us])
        marks_us = np.minimum(np.maximum.accumulate(marks_us), acts_us)
        seconds = np.diff(marks_us, axis=0) / US_PER_S
        command = flown[0]
        for k in np.flatnonzero(seconds.any(axis=1)).tolist():
            motion = flown_on(motion, flown[k], self._response, seconds[k])
            command = np.where(seconds[k, :, None] > 0.0, flown[k], command)
        return motion, command

    def _keep(
        self, i: int, depth_mm: NDArray[np.uint16], position: Vector, quaternion: Vector
    ) -> None:
        """Keep an image of companion i, and where it was taken."""
        for array in (self._depth_mm, self._position, self._axes):
            array[i, 1:] = array[i, :-1]
        pose = self._mount.pose(position, quaternion)
        self._depth_mm[i, 0], self._position[i, 0], self._axes[i, 0] = depth_mm, *pose
        self._kept[i] = min(self._kept[i] + 1, self._depth_mm.shape[1])


class _Mount:
    """Place of a camera on its vehicle."""

    def __init__(self, camera: Camera) -> None:
        self._offset = np.array([camera.forward_m, camera.right_m, -camera.up_m])
        pitch, yaw = np.deg2rad(camera.pitch_up_deg), np.deg2rad(camera.yaw_deg)
        self._turn = quat_to_matrix(quat_from_euler(0.0, float(pitch), float(yaw)))

    def pose(self, position: Vector, quaternion: Vector) -> CameraPose:
        """Return the pose of the camera of a vehicle at NED [m], body -> NED."""
        axes = quat_to_matrix(quaternion)
        return CameraPose(position + axes @ self._offset, axes @ self._turn)
