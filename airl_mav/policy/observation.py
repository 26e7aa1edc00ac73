"""Observations of a policy: an image, the vehicle's motion and the goal.

`observe` turns frames and telemetry into an Observation, of one vehicle in the companion and of n
at a time in training.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MM_PER_M, Frame, depth_only
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.frames import Goal, Vector, ned_to_heading, quats_to_euler

Rows = int | slice | Sequence[int] | NDArray[np.int64] | None
"""Index into n vehicles; None adds a leading axis of n = 1."""


@dataclass(frozen=True)
class Kinematics:
    """State of one vehicle, or of n, as reported by telemetry. Leading axes may be added."""

    position: Vector  # (..., 3) local NED [m]
    velocity: Vector  # (..., 3) NED [m/s]
    quaternion: Vector  # (..., 4) body FRD -> NED
    rates: Vector | None = None  # (..., 3) body FRD [rad/s]; None = not reported
    time_us: int | None = None
    """Time of one vehicle's attitude by the vehicle's clock [µs]; None = not reported."""

    def known(self) -> dict[str, Vector]:
        """Return position, velocity and quaternion by name: the fields that are always present."""
        return {
            "position": self.position,
            "velocity": self.velocity,
            "quaternion": self.quaternion,
        }

    def rows(self, index: Rows) -> Kinematics:
        """Return the state of one or several of n vehicles."""
        rates = None if self.rates is None else self.rates[index]
        return Kinematics(self.position[index], self.velocity[index], self.quaternion[index], rates)


@dataclass(frozen=True)
class InFlight:
    """Decision state of one companion, or of n."""

    latency_s: Vector
    """(...) expected latency t2 of this decision [s]."""
    age_s: Vector
    """(...) age of the image [s]."""
    setpoint: Vector
    """(..., 4) newest setpoint: `actions.BodyRates`, `actions.Attitude`, or a velocity forward,
    right, down [m/s] and a yaw rate [rad/s]; zeros before the first."""
    foreseen: bool = False
    """True if the observation is compensated: of the time at which the setpoint arrives."""

    @property
    def command(self) -> Vector:
        """(..., 3) newest velocity setpoint: forward, right [m/s], yaw rate [rad/s]."""
        return self.setpoint[..., (0, 1, 3)]

    @classmethod
    def of_first_decisions(cls, n: int) -> InFlight:
        """Return the state of n companions before their first decision."""
        return cls(np.zeros(n), np.zeros(n), np.zeros((n, 4)))

    def rows(self, index: Rows) -> InFlight:
        """Return the state of one or several of n companions."""
        latency_s, age_s = np.asarray(self.latency_s), np.asarray(self.age_s)
        return replace(
            self, latency_s=latency_s[index], age_s=age_s[index], setpoint=self.setpoint[index]
        )


@dataclass(frozen=True)
class CameraView:
    """Image of an additional camera, of one vehicle or with a leading axis of n."""

    image: NDArray[Any]
    intrinsics: Intrinsics
    earlier: tuple[NDArray[Any], ...] = ()
    """Images of the previous decisions, as far as stored, the newest first."""

    def rows(self, index: Rows) -> CameraView:
        """Return the view of one or several of n vehicles."""
        earlier = tuple([image[index] for image in self.earlier])
        return CameraView(self.image[index], self.intrinsics, earlier)


@dataclass(frozen=True)
class Observation:
    """Input of a policy, of one vehicle or with a leading axis of n.

    The heading frame is level and follows the nose: forward, right, down.
    """

    image: NDArray[Any]
    """(..., h, w) depth uint16 along the optical axis [mm], 0 = no return; or colour uint8
    (..., h, w, 3) sRGB, (..., h, w, 1) grey."""
    intrinsics: Intrinsics
    """Intrinsics of the camera; `kind` defines the image's pixels."""
    goal: Vector  # (..., 2) goal relative to the vehicle, forward and right [m]
    velocity: Vector  # (..., 3) heading frame [m/s]
    roll: float | Vector
    """(...) [rad]."""
    pitch: float | Vector
    """(...) [rad]."""
    yaw: float | Vector
    """(...) heading [rad], 0 = north, positive to the east."""
    in_flight: InFlight | None = None
    """Decision state; None = not available."""
    earlier: tuple[NDArray[Any], ...] = ()
    """Images of the previous decisions, as far as stored, the newest first."""
    states: tuple[Kinematics, ...] = ()
    """Vehicle states: the present one, with attitude and body rates from telemetry, then the states
    of `earlier`."""
    goal_down: Vector | None = None
    """(...) distance of the goal below the vehicle [m]; None = the goal has no height."""
    further: Mapping[str, CameraView] = field(default_factory=dict)
    """Views of additional cameras, by name, at the same time."""

    def rows(self, index: Rows) -> Observation:
        """Return the observation of one or several of n vehicles."""
        names = ("image", "goal", "velocity", "roll", "pitch", "yaw")
        found: dict[str, Any] = {name: np.asarray(getattr(self, name))[index] for name in names}
        if (told := self.in_flight) is not None:
            found["in_flight"] = told.rows(index)
        if self.goal_down is not None:
            found["goal_down"] = np.asarray(self.goal_down)[index]
        # Lists: a generator takes a call for each element.
        found["earlier"] = tuple([image[index] for image in self.earlier])
        found["states"] = tuple([state.rows(index) for state in self.states])
        found["further"] = {name: each.rows(index) for name, each in self.further.items()}
        return replace(self, **found)

    @property
    def depth_mm(self) -> NDArray[np.uint16]:
        """Depth (..., h, w) along the optical axis [mm]; 0 = no return.

        Raises UsageError for a colour camera, as do the next two properties.
        """
        return depth_only(self.image, self.intrinsics)

    @property
    def earlier_mm(self) -> tuple[NDArray[np.uint16], ...]:
        """Depths (..., h, w) [mm] of the previous decisions, as far as stored."""
        return tuple(depth_only(image, self.intrinsics) for image in self.earlier)

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """Depth (..., h, w) along the optical axis [m]; 0 = no return."""
        return self.depth_mm.astype(np.float32) / np.float32(MM_PER_M)

    @property
    def goal_distance(self) -> float:
        """Level distance of one vehicle to its goal [m]."""
        return math.hypot(self.goal[0], self.goal[1])

    @property
    def goal_bearing(self) -> float:
        """Direction of one vehicle's goal relative to the nose [rad], positive to the right."""
        return math.atan2(self.goal[1], self.goal[0])


Earlier = Sequence[tuple[NDArray[Any], Kinematics]]
"""Images and states of the previous decisions, the newest first."""


def encode(frame: Frame, state: Kinematics, goal: Goal) -> Observation:
    """Return the observation of a frame, telemetry and a goal."""
    where = np.asarray(goal, np.float64)
    return observe(frame.image, frame.intrinsics, state, where, further=views_of(frame))


def views_of(
    frame: Frame, earlier: Sequence[Mapping[str, NDArray[Any]]] = ()
) -> dict[str, CameraView]:
    """Return the additional cameras' views of a frame; `earlier` images are the newest first."""
    return {
        name: CameraView(each.image, each.intrinsics, tuple(then[name] for then in earlier))
        for name, each in frame.further.items()
    }


def observe(
    image: NDArray[Any],
    intrinsics: Intrinsics,
    state: Kinematics,
    goal: Vector,
    in_flight: InFlight | None = None,
    earlier: Earlier = (),
    further: Mapping[str, CameraView] | None = None,
) -> Observation:
    """Return the observation of one vehicle, or of n.

    `goal` is (..., 2) north, east [m], or (..., 3) with down. `earlier` are the images and states
    of the previous decisions, newest first. `further` are views of additional cameras by name.
    """
    roll, pitch, yaw = quats_to_euler(state.quaternion)
    to_goal = np.zeros_like(state.position)
    to_goal[..., :2] = goal[..., :2] - state.position[..., :2]
    return Observation(
        image=image,
        intrinsics=intrinsics,
        goal=ned_to_heading(to_goal, yaw)[..., :2],
        velocity=ned_to_heading(state.velocity, yaw),
        roll=roll,
        pitch=pitch,
        yaw=yaw,
        in_flight=in_flight,
        earlier=tuple([image for image, _ in earlier]),
        states=(state, *(then for _, then in earlier)),
        goal_down=goal[..., 2] - state.position[..., 2] if goal.shape[-1] == 3 else None,
        further=further or {},
    )
