"""Messages from a flight to its view, their encoding, and the state of a view from them.

Positions and velocities are local NED [m, m/s], attitudes body FRD -> NED [w, x, y, z], times
simulated [µs]. A message is one part of JSON. An image follows as a second part: little-endian
uint16 millimetres of depth, or bytes of colour.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from airl_mav.arena.geometry import Arena
from airl_mav.core import constants, frames
from airl_mav.profiles.projections import Projection
from airl_mav.profiles.vehicle import Momentum, VehicleProfile
from airl_mav.rehearsal.live_view import ViewAddresses

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Image = NDArray[Any]
"""Image as in `camera.frame.Frame`: depth (h, w) uint16 [mm], colour (h, w, channels) uint8."""

Shape = tuple[int, int] | tuple[int, int, int]

ROTOR_SHARE = 0.8
"""Rotor radius as a fraction of the shorter arm component; default of profiles without a propeller
diameter."""


class ViewMessage(BaseModel):
    """Base class of messages."""

    model_config = ConfigDict(extra="forbid", frozen=True)


CAMERA_FIELDS = ("forward_m", "right_m", "up_m", "pitch_up_deg", "yaw_deg", "projection", "range_m")


class VehicleShape(ViewMessage):
    """Dimensions of a vehicle and mounting of its main camera [m, deg]."""

    arm_forward_m: float
    arm_right_m: float
    rotor_radius_m: float
    height_m: float
    camera_forward_m: float
    camera_up_m: float
    camera_pitch_up_deg: float
    camera_right_m: float = 0.0
    camera_yaw_deg: float = 0.0
    camera_projection: Projection
    camera_fov_deg: float
    """Horizontal field of view [deg]."""
    camera_aspect: float
    camera_range_m: float

    @classmethod
    def of(cls, vehicle: VehicleProfile) -> VehicleShape:
        """Return the shape of a profile's vehicle."""
        rotor, camera, power = vehicle.rotor, vehicle.camera, vehicle.power
        radius_m = ROTOR_SHARE * min(rotor.arm_forward_m, rotor.arm_right_m)
        if isinstance(power, Momentum):
            radius_m = 0.5 * power.propeller_diameter_m
        return cls(
            arm_forward_m=rotor.arm_forward_m,
            arm_right_m=rotor.arm_right_m,
            rotor_radius_m=radius_m,
            height_m=vehicle.body.height_m,
            camera_fov_deg=camera.horizontal_fov_deg,
            camera_aspect=camera.width_px / camera.height_px,
            **{f"camera_{name}": getattr(camera, name) for name in CAMERA_FIELDS},
        )


class Episode(ViewMessage):
    """Start of an episode in a new arena."""

    kind: Literal["episode"] = "episode"
    seed: int
    started_us: int
    """Start time of moving obstacles."""
    arena: Arena | None
    """Arena; None = an endless floor."""
    vehicle: VehicleShape
    goal: frames.Goal
    """North, east and optionally down [m]."""
    goal_radius_m: float


class VehicleState(ViewMessage):
    """True state of the vehicle."""

    kind: Literal["vehicle"] = "vehicle"
    time_us: int
    position: Vector3
    velocity: Vector3
    quaternion: Quaternion
    rotors: Quaternion
    """Rotor speeds relative to the speed at full command, in PX4's order."""
    battery: float | None
    """State of charge, 1 to 0; None = unknown."""
    mode: str
    """Flight mode; empty = unknown."""
    armed: bool
    collision: str | None


class CameraImage(ViewMessage):
    """Newest image of the camera."""

    kind: Literal["picture"] = "picture"
    captured_us: int
    shape: Shape
    """Height, width [px] and, for colour, channels."""


class Decided(ViewMessage):
    """Decision that was sent, with the policy's input image."""

    kind: Literal["decided"] = "decided"
    captured_us: int
    began_us: int
    ready_us: int
    sent_us: int
    expires_us: int | None
    """Time at which the vehicle hovers without a newer decision; None = never."""
    setpoint: Quaternion
    """Velocity forward, right, down [m/s] in the heading frame and yaw rate [rad/s]. For other
    `commands`, the fields of `policy.actions.Attitude` or `BodyRates`."""
    commands: constants.CommandKind = "velocity"
    compensated: bool
    """True if the policy's input was predicted by latency compensation."""
    shape: Shape
    """Height, width [px] and, for colour, channels of the image."""


class Flight(ViewMessage):
    """Start or restart of a flight of the run."""

    kind: Literal["flight"] = "flight"
    index: int
    seed: int
    goal: frames.Goal


class PhaseStart(ViewMessage):
    """Phase that the companion entered, or the verdict on the flight."""

    kind: Literal["phase"] = "phase"
    time_us: int
    phase: str


class Said(ViewMessage):
    """Text from the autopilot or the run."""

    kind: Literal["said"] = "said"
    time_us: int | None
    severity: int
    """MAV_SEVERITY: 4 is a warning; lower is more severe."""
    text: str


Told = Annotated[
    Episode | VehicleState | CameraImage | Decided | Flight | PhaseStart | Said,
    Field(discriminator="kind"),
]
_TOLD: TypeAdapter[Told] = TypeAdapter(Told)


class Steering(ViewMessage):
    """Viewers' requests to the flight; the newest message applies."""

    paused: bool = False
    speed: float | None = None
    """Simulated seconds per wall second; None = unlimited."""
    steps: int = 0
    """Total of single decisions requested so far while paused."""
    t2_ms: float | None = None
    """Latency of every decision [ms]; None = the scenario's latency."""
    compensate: bool | None = None
    """True to compensate latency; None = the scenario's setting."""


def to_parts(message: ViewMessage, image: Image | None = None) -> list[bytes]:
    """Return the wire parts of a message and its image."""
    parts = [message.model_dump_json().encode()]
    if image is not None:
        parts.append(np.ascontiguousarray(image, _number(image.shape)).tobytes())
    return parts


def from_parts(parts: list[bytes]) -> tuple[Told, Image | None] | None:
    """Return a message and its image; None for invalid parts."""
    try:
        message = _TOLD.validate_json(parts[0])
    except (ValidationError, IndexError):
        return None
    if not isinstance(message, CameraImage | Decided):
        return message, None
    shape, number = message.shape, np.dtype(_number(message.shape))
    if len(parts) != 2 or min(shape) < 1 or len(parts[1]) != number.itemsize * math.prod(shape):
        return None
    return message, np.frombuffer(parts[1], number).reshape(shape)


def shape_of(image: Image) -> Shape:
    """Return the shape of an image for a message."""
    height, width, *channels = image.shape
    return (height, width, channels[0]) if channels else (height, width)


def _number(shape: tuple[int, ...]) -> str:
    return "<u2" if len(shape) == 2 else "u1"


class ViewSettings(BaseModel):
    """Configuration of a view process."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    run: str
    port: int | None
    """TCP port of the page; None = any free port."""
    paced: bool
    """True if viewers may set the pace."""
    speed: float | None
    compensable: bool
    """True if the vehicle's response is known, which latency compensation requires."""
    compensated: bool


class ViewAnswer(BaseModel):
    """Port and addresses of a started view."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    port: int = 0
    ends: ViewAddresses | None = None
    """ZeroMQ addresses; None = the requested port is in use."""


STRIP_S = 20.0
"""Time span of the latency strip [simulated s]."""

TEXTS = 6
"""Number of recent texts shown."""

TRAIL_STEP_M = 0.05
"""Minimum distance between points of the trail [m]."""

OFFBOARD = "offboard"
"""Flight mode that follows setpoints."""

Point = tuple[float, float, float]


@dataclass
class Shown:
    """Data of the scene and the panel."""

    flight: Flight | None = None
    phase: str = ""
    texts: deque[Said] = field(default_factory=lambda: deque(maxlen=TEXTS))
    episode: Episode | None = None
    arena: Arena | None = None
    is_surrounded: bool = True
    """True if the surroundings are known; False while an arena is being generated."""
    episodes: int = 0
    """Number of episodes started so far; a new number requires a new scene."""
    vehicle: VehicleState | None = None
    trail: list[Point] = field(default_factory=list)
    """Past positions of the vehicle in this episode, NED [m]."""
    picture: Image | None = None
    decided: Decided | None = None
    decided_image: Image | None = None
    """Policy's input image of that decision."""
    decisions: int = 0
    """Number of decisions received in this episode."""
    ages: deque[tuple[float, float, float]] = field(default_factory=deque)
    """Time since the episode's start [s], command age and t2 of its decision [ms]."""

    def take(self, message: Told, image: Image | None) -> None:
        """Update the state with a message and its image."""
        if isinstance(message, VehicleState):
            self._move(message)
        elif isinstance(message, CameraImage):
            self.picture = image
        elif isinstance(message, Decided):
            self.decided, self.decided_image = message, image
            self.decisions += 1
        elif isinstance(message, Episode):
            self._begin(message)
        elif isinstance(message, PhaseStart):
            self.phase = message.phase
        elif isinstance(message, Said):
            self.texts.append(message)
        else:
            self.flight, self.phase = message, "booting"

    def _begin(self, episode: Episode) -> None:
        self.episode = episode
        self.arena = episode.arena
        self.episodes += 1
        self.vehicle = self.picture = self.decided = self.decided_image = None
        self.trail, self.decisions = [], 0
        self.ages.clear()

    def _move(self, vehicle: VehicleState) -> None:
        self.vehicle = vehicle
        if not self.trail or math.dist(self.trail[-1], vehicle.position) >= TRAIL_STEP_M:
            self.trail.append(vehicle.position)
        age_ms, t2_ms = self.age_ms, self.t2_ms
        if age_ms is not None and t2_ms is not None:
            self.ages.append((self.seconds, age_ms, t2_ms))
        while self.ages and self.ages[0][0] < self.seconds - STRIP_S:
            self.ages.popleft()

    @property
    def seconds(self) -> float:
        """Time since the episode's start [simulated s]."""
        if self.vehicle is None or self.episode is None:
            return 0.0
        return (self.vehicle.time_us - self.episode.started_us) / constants.US_PER_S

    @property
    def flies_setpoints(self) -> bool:
        """True if the vehicle is armed and follows setpoints."""
        vehicle = self.vehicle
        return vehicle is not None and vehicle.armed and vehicle.mode == OFFBOARD

    @property
    def age_ms(self) -> float | None:
        """Age of the image behind the current command [ms]; None without such a command."""
        if self.decided is None or self.vehicle is None or not self.flies_setpoints:
            return None
        return max(0.0, (self.vehicle.time_us - self.decided.captured_us) / constants.US_PER_MS)

    @property
    def t2_ms(self) -> float | None:
        """Inference time t2 of the newest decision [ms]; None before the first decision."""
        if self.decided is None:
            return None
        return (self.decided.ready_us - self.decided.began_us) / constants.US_PER_MS

    @property
    def command(self) -> NDArray[np.float64] | None:
        """Commanded velocity (3,): forward, right, down [m/s]; None without one."""
        if self.decided is None or self.vehicle is None or not self.flies_setpoints:
            return None
        if self.decided.commands != "velocity":
            return None
        expires_us = self.decided.expires_us
        if expires_us is not None and self.vehicle.time_us >= expires_us:
            return np.zeros(3)
        return np.array(self.decided.setpoint[:3])

    @property
    def to_goal_m(self) -> float | None:
        """Distance to the goal [m]; horizontal for a goal without a height."""
        if self.vehicle is None or self.episode is None:
            return None
        return frames.goal_distance_m(self.episode.goal, self.vehicle.position)
