"""Actions of policies: a velocity, or an attitude or body rates with a thrust."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import GRAVITY_M_S2, CommandKind
from airl_mav.core.errors import FieldError
from airl_mav.policy.observation import Observation

DecisionTiming = Literal["sequential", "pipelined"]
"""Start of a decision: after the previous hold time, or as soon as the previous one is ready."""


@dataclass(frozen=True)
class Action:
    """A velocity command. Without a vertical speed the pilot holds an altitude."""

    forward_m_s: float
    right_m_s: float
    yaw_rate_rad_s: float
    """Yaw rate, positive clockwise seen from above."""
    down_m_s: float | None = None
    """Vertical speed, positive downwards; None = the pilot holds the altitude."""


class Attitude(NamedTuple):
    """An attitude and a collective thrust. Only the policy controls the velocity."""

    roll_rad: float
    """Roll, positive right side down."""
    pitch_rad: float
    """Pitch, positive nose up."""
    yaw_rad: float
    """Heading, 0 = north, positive to the east."""
    thrust: float
    """Collective thrust, 0 to 1 of the maximum; PX4 hovers at MPC_THR_HOVER."""

    @classmethod
    def accelerating(
        cls,
        forward_m_s2: float,
        right_m_s2: float,
        down_m_s2: float,
        *,
        yaw_rad: float,
        hover_thrust: float = 0.5,
    ) -> Attitude:
        """Return the attitude and thrust of an acceleration, for policies of accelerations.

        Thrust alone produces the specific force a - g, as in PX4's ControlMath::bodyzToAttitude.
        The policy must compensate drag. The tilt is not limited. Forward and right are level, along
        the commanded heading (0 = north, positive to the east); 0 down holds the vertical speed.
        """
        up_m_s2 = GRAVITY_M_S2 - down_m_s2
        force_m_s2 = math.hypot(forward_m_s2, right_m_s2, up_m_s2)
        roll = math.asin(right_m_s2 / force_m_s2) if force_m_s2 > 0.0 else 0.0
        thrust = hover_thrust * force_m_s2 / GRAVITY_M_S2
        return cls(roll, -math.atan2(forward_m_s2, up_m_s2), yaw_rad, thrust)


class BodyRates(NamedTuple):
    """Body rates and a collective thrust (CTBR). Only the policy controls the attitude."""

    roll_rate_rad_s: float
    """Roll rate about the forward axis (body FRD)."""
    pitch_rate_rad_s: float
    """Pitch rate about the right axis (body FRD)."""
    yaw_rate_rad_s: float
    """Yaw rate about the down axis (body FRD)."""
    thrust: float
    """Collective thrust as in `Attitude`."""


AnyAction: TypeAlias = "Action | Attitude | BodyRates"

KINDS: dict[CommandKind, type[Any]] = {
    "velocity": Action,
    "attitude": Attitude,
    "body_rates": BodyRates,
}

UPRIGHT_S = 0.15
"""Default timeout of an attitude, or of body rates, beyond the hold time [s]. The flight controller
then holds the vehicle. At 3 rad/s the vehicle has turned by 26 degrees."""

ALTITUDE_P = 0.5
"""Vertical speed per metre of altitude error [1/s]; stable with decisions 1.5 s apart."""

MAX_VERTICAL_M_S = 1.0
"""Limit of the altitude correction [m/s]."""

CLIMB_SHARE = 0.3
"""Maximum climb and descent rate as a share of the maximum level speed: 1.5 m/s at 5 m/s, as in
PX4's default descent (MPC_Z_VEL_MAX_DN)."""


def fastest_climb(speed_m_s: float) -> float:
    """Return the maximum vertical speed of an action [m/s] for a maximum level speed [m/s]."""
    return CLIMB_SHARE * speed_m_s


def vertical_speed(altitude_m: float, down_m: float) -> float:
    """Return the downward speed [m/s] that holds a height above the start [m], from a position."""
    return float(vertical_speeds(altitude_m, np.array(down_m)))


def vertical_speeds(altitude_m: float, down_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the downward speeds [m/s] of n vehicles; as `vertical_speed`."""
    error_m = -altitude_m - down_m
    speeds: NDArray[np.float64] = np.clip(ALTITUDE_P * error_m, -MAX_VERTICAL_M_S, MAX_VERTICAL_M_S)
    return speeds


class Policy(Protocol):
    """Interface of a policy.

    A class or object attribute `commands` declares the `CommandKind`. The default is velocity.
    """

    def act(self, observation: Observation) -> AnyAction:
        """Return the action for an observation."""


def command_kind(policy: object) -> CommandKind:
    """Return the command kind of a policy or its class. Raises FieldError if it is unknown."""
    kind = getattr(policy, "commands", "velocity")
    for known in KINDS:
        if kind == known:
            return known
    raise FieldError("policy", problem=f"commands = {kind!r}; accepted: {', '.join(KINDS)}")


@runtime_checkable
class CameraBound(Protocol):
    """A policy with camera requirements."""

    @property
    def name(self) -> str:
        """Name of the policy."""

    def refuses(self, camera: Intrinsics) -> str | None:
        """Return why a camera cannot serve the policy, or None when it can."""


@runtime_checkable
class RigBound(CameraBound, Protocol):
    """A policy that may require additional cameras."""

    def refuses_further(self, cameras: Mapping[str, Intrinsics]) -> str | None:
        """Return why additional cameras, by name, cannot serve the policy, or None."""


def flyable(action: AnyAction, kind: CommandKind, speed_m_s: float) -> AnyAction:
    """Return an action within limits: a velocity `limited`, a thrust within 0..1.

    Raises:
        TypeError: The action has another command kind.
        ValueError: An attitude, a body rate or a thrust is not finite. There is no safe default.
    """
    wanted = KINDS[kind]
    if not isinstance(action, wanted):
        raise TypeError(f"it returned {type(action).__name__}; accepted: {wanted.__name__}")
    if isinstance(action, Action):
        return limited(action, speed_m_s)
    if not all(map(math.isfinite, action)):
        raise ValueError(f"it returned what is no number: {action}")
    within: AnyAction = action._replace(thrust=min(1.0, max(0.0, action.thrust)))
    return within


def limited(action: Action, speed_m_s: float) -> Action:
    """Return the action with its speed limited and non-finite values set to zero.

    The vertical speed, if present, is limited to `fastest_climb` of `speed_m_s`.
    """
    numbers = (action.forward_m_s, action.right_m_s, action.yaw_rate_rad_s)
    forward, right, turn = (n if math.isfinite(n) else 0.0 for n in numbers)
    speed = math.hypot(forward, right)
    scale = min(1.0, speed_m_s / speed) if speed > 0.0 else 1.0
    down = action.down_m_s
    if down is not None:
        climb = fastest_climb(speed_m_s)
        down = max(-climb, min(climb, down)) if math.isfinite(down) else 0.0
    return Action(forward * scale, right * scale, turn, down)
