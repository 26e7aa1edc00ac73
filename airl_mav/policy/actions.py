"""What a policy does: it commands a velocity, or an attitude, or body rates, with a thrust."""

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
"""When a decision begins: after the hold of the one before, or as soon as that one is ready."""


@dataclass(frozen=True)
class Action:
    """A velocity command. Where it says nothing of the vertical, the pilot holds an altitude."""

    forward_m_s: float
    right_m_s: float
    yaw_rate_rad_s: float
    """Positive clockwise seen from above."""
    down_m_s: float | None = None
    """Positive downwards; None: the pilot adds the vertical speed that holds the altitude."""


class Attitude(NamedTuple):
    """An attitude and a collective thrust. Nothing but the policy controls the velocity."""

    roll_rad: float
    """Positive: right side down."""
    pitch_rad: float
    """Positive: nose up."""
    yaw_rad: float
    """Heading, 0 = north, positive to the east."""
    thrust: float
    """Collective, 0 to 1 of what the motors can; what hovers is MPC_THR_HOVER of PX4."""

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
        """Return the attitude and thrust of an acceleration, for policies that command those.

        Thrust alone makes the specific force a - g, as in PX4's ControlMath::bodyzToAttitude. Drag
        is left to the policy. A tilt is not limited. Forward and right are level, along the
        commanded heading (0 = north, positive to the east); 0 down holds the vertical speed.
        """
        up_m_s2 = GRAVITY_M_S2 - down_m_s2
        force_m_s2 = math.hypot(forward_m_s2, right_m_s2, up_m_s2)
        roll = math.asin(right_m_s2 / force_m_s2) if force_m_s2 > 0.0 else 0.0
        thrust = hover_thrust * force_m_s2 / GRAVITY_M_S2
        return cls(roll, -math.atan2(forward_m_s2, up_m_s2), yaw_rad, thrust)


class BodyRates(NamedTuple):
    """Body rates and a collective thrust (CTBR). Nothing but the policy controls the attitude."""

    roll_rate_rad_s: float
    """Body FRD, as the two others: about the axis forward, ..."""
    pitch_rate_rad_s: float
    """... to the right, ..."""
    yaw_rate_rad_s: float
    """... and downward."""
    thrust: float
    """As of `Attitude`."""


AnyAction: TypeAlias = "Action | Attitude | BodyRates"

KINDS: dict[CommandKind, type[Any]] = {
    "velocity": Action,
    "attitude": Attitude,
    "body_rates": BodyRates,
}

UPRIGHT_S = 0.15
"""An attitude, or body rates, persist so long by default, beyond the hold time, before the flight
controller is to hold the vehicle instead [s]: at 3 rad/s it has turned by 26 degrees."""

ALTITUDE_P = 0.5
"""Vertical speed per metre of altitude error [1/s]: slow enough for decisions 1.5 s apart."""

MAX_VERTICAL_M_S = 1.0
"""Limit of the altitude correction [m/s]."""

CLIMB_SHARE = 0.3
"""Fastest climb and descent of an action, as a share of the fastest level speed: 1.5 m/s where that
is 5 m/s, which is what PX4 descends at by default (MPC_Z_VEL_MAX_DN)."""


def fastest_climb(speed_m_s: float) -> float:
    """Return the fastest vertical speed of an action [m/s], of the fastest level one [m/s]."""
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
    """Anything that decides.

    What commands no velocity says so: by an attribute `commands`, of its class or its own, which is
    one of `CommandKind`. Without one it commands a velocity.
    """

    def act(self, observation: Observation) -> AnyAction:
        """Return the action for an observation."""


def command_kind(policy: object) -> CommandKind:
    """Return what a policy, or its class, commands. Raises FieldError if it says anything else."""
    kind = getattr(policy, "commands", "velocity")
    for known in KINDS:
        if kind == known:
            return known
    raise FieldError("policy", problem=f"commands = {kind!r}; accepted: {', '.join(KINDS)}")


@runtime_checkable
class CameraBound(Protocol):
    """A policy that not every camera can serve."""

    @property
    def name(self) -> str:
        """Name of the policy."""

    def refuses(self, camera: Intrinsics) -> str | None:
        """Return why a camera cannot serve the policy, or None when it can."""


@runtime_checkable
class RigBound(CameraBound, Protocol):
    """One that asks for further cameras, or may."""

    def refuses_further(self, cameras: Mapping[str, Intrinsics]) -> str | None:
        """Return why further cameras, by name, cannot serve the policy, or None when they can."""


def flyable(action: AnyAction, kind: CommandKind, speed_m_s: float) -> AnyAction:
    """Return an action as it may be sent: a velocity `limited`, a thrust within 0..1.

    Raises:
        TypeError: It is of another kind.
        ValueError: An attitude, a body rate or a thrust is no number. Nothing is safe to put in its
            place.
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
    """Return the action with its speed limited and anything that is not finite made zero.

    The vertical speed, where it has one, is limited to `fastest_climb` of `speed_m_s`.
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
