"""Messages from a flight to its view, and their bytes on the wire.

Positions and velocities are local NED [m, m/s], attitudes body FRD -> NED [w, x, y, z], times
simulated [µs]. A message is one part of JSON. An image follows as a second part: little-endian
uint16 millimetres of depth, or bytes of colour.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from airl_mav.arena.geometry import Arena
from airl_mav.core.constants import CommandKind
from airl_mav.core.goals import Goal
from airl_mav.profiles.camera_kind import Projection
from airl_mav.profiles.vehicle import Momentum, VehicleProfile

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Image = NDArray[Any]
"""As `camera.frame.Frame.image`: depth (h, w) uint16 [mm], colour (h, w, channels) uint8."""

Shape = tuple[int, int] | tuple[int, int, int]

ROTOR_SHARE = 0.8
"""Radius of a rotor as a share of half the distance to its neighbour, where the profile does not
say it."""


class Message(BaseModel):
    """One message."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class VehicleShape(Message):
    """What a vehicle looks like, and where its main camera looks [m, deg]."""

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
    """Horizontal."""
    camera_aspect: float
    camera_range_m: float

    @classmethod
    def of(cls, vehicle: VehicleProfile) -> VehicleShape:
        """Return what a vehicle of a profile looks like."""
        rotor, camera, power = vehicle.rotor, vehicle.camera, vehicle.power
        radius_m = ROTOR_SHARE * min(rotor.arm_forward_m, rotor.arm_right_m)
        if isinstance(power, Momentum):
            radius_m = 0.5 * power.propeller_diameter_m
        return cls(
            arm_forward_m=rotor.arm_forward_m,
            arm_right_m=rotor.arm_right_m,
            rotor_radius_m=radius_m,
            height_m=vehicle.body.height_m,
            camera_forward_m=camera.forward_m,
            camera_up_m=camera.up_m,
            camera_pitch_up_deg=camera.pitch_up_deg,
            camera_right_m=camera.right_m,
            camera_yaw_deg=camera.yaw_deg,
            camera_projection=camera.projection,
            camera_fov_deg=camera.horizontal_fov_deg,
            camera_aspect=camera.width_px / camera.height_px,
            camera_range_m=camera.range_m,
        )


class Episode(Message):
    """An episode begins, in a new arena."""

    kind: Literal["episode"] = "episode"
    seed: int
    started_us: int
    """When moving obstacles set out."""
    arena: Arena | None
    """None: an endless floor."""
    vehicle: VehicleShape
    goal: Goal
    """North, east [m], and down where it has a height."""
    goal_radius_m: float


class Vehicle(Message):
    """The true state of the vehicle."""

    kind: Literal["vehicle"] = "vehicle"
    time_us: int
    position: Vector3
    velocity: Vector3
    quaternion: Quaternion
    rotors: Quaternion
    """Their speeds, as shares of that at full command, in PX4's order."""
    battery: float | None
    """State of charge, 1 to 0; None: not known."""
    mode: str
    """Empty: not known."""
    armed: bool
    collision: str | None


class Picture(Message):
    """The camera's newest image."""

    kind: Literal["picture"] = "picture"
    captured_us: int
    shape: Shape
    """Height and width [px]; of colour the channels, too."""


class Decided(Message):
    """A decision that was sent, with the image that the policy saw."""

    kind: Literal["decided"] = "decided"
    captured_us: int
    began_us: int
    ready_us: int
    sent_us: int
    expires_us: int | None
    """When the vehicle is told to hover if no other has come; None: never."""
    setpoint: Quaternion
    """Velocity forward, right, down [m/s] in the heading frame, yaw rate [rad/s]; or, by
    `commands`, as `policy.actions.Attitude` or `BodyRates`."""
    commands: CommandKind = "velocity"
    compensated: bool
    """Whether the policy saw what was expected, not what was."""
    shape: Shape
    """Height and width of the image [px]; of colour the channels, too."""


class Flight(Message):
    """A flight of the run begins, also one that begins again."""

    kind: Literal["flight"] = "flight"
    index: int
    seed: int
    goal: Goal


class Phase(Message):
    """The companion has entered a phase, or the flight was judged."""

    kind: Literal["phase"] = "phase"
    time_us: int
    phase: str


class Said(Message):
    """The autopilot has said something, or the run has."""

    kind: Literal["said"] = "said"
    time_us: int | None
    severity: int
    """MAV_SEVERITY: 4 is a warning, less is graver."""
    text: str


class Trained(Message):
    """What the newest decision came to, in a policy's training, and how far that is."""

    kind: Literal["trained"] = "trained"
    time_us: int
    action: str
    reward: float
    returned: float
    """Sum of the episode's rewards so far."""
    steps: int = 0
    """Decisions of all vehicles so far."""
    success: float | None = None
    """Share of the newest episodes that reached the goal, 0 to 1; None: none has ended."""
    zone: int | None = None
    """Open zone of the curriculum; None: there is none."""


Told = Annotated[
    Episode | Vehicle | Picture | Decided | Flight | Phase | Said | Trained,
    Field(discriminator="kind"),
]
_TOLD: TypeAdapter[Told] = TypeAdapter(Told)


class Steering(Message):
    """What the watchers ask of the flight; the newest one counts."""

    paused: bool = False
    speed: float | None = None
    """Simulated seconds per wall second; None: as fast as it goes."""
    steps: int = 0
    """How many single decisions were asked for so far, while paused."""
    t2_ms: float | None = None
    """The latency of every decision; None: as the scenario says."""
    compensate: bool | None = None
    """Whether it is compensated; None: as the scenario says."""


def to_parts(message: Message, image: Image | None = None) -> list[bytes]:
    """Return the parts of a message; `image` is its image."""
    parts = [message.model_dump_json().encode()]
    if image is not None:
        parts.append(np.ascontiguousarray(image, _number(image.shape)).tobytes())
    return parts


def from_parts(parts: list[bytes]) -> tuple[Told, Image | None] | None:
    """Return a message and its image; None for what is no message."""
    try:
        message = _TOLD.validate_json(parts[0])
    except (ValidationError, IndexError):
        return None
    if not isinstance(message, Picture | Decided):
        return message, None
    shape, number = message.shape, np.dtype(_number(message.shape))
    if len(parts) != 2 or min(shape) < 1 or len(parts[1]) != number.itemsize * math.prod(shape):
        return None
    return message, np.frombuffer(parts[1], number).reshape(shape)


def shape_of(image: Image) -> Shape:
    """Return the shape of an image as a message tells it."""
    height, width, *channels = image.shape
    return (height, width, channels[0]) if channels else (height, width)


def _number(shape: tuple[int, ...]) -> str:
    return "<u2" if len(shape) == 2 else "u1"
