"""Actions of policies, and action sets, which convert a network's output to an action.

An action is a velocity, or an attitude or body rates with a thrust.

Action sets: `arc-25`: five speeds with five yaw rates. `paper-25`: the 25 actions of the paper's
text. `velocity`: the paper's continuous pair, forward and right speed, the nose turns to the
course; `velocity-fixed-yaw`: the same pair with a fixed heading. Sets of three dimensions also
command the vertical speed; the other sets hold an altitude. `velocity3d` and `velocity3d-fixed-yaw`
are these two with a third number, and `arc3d-75` is `arc-25` climbing, level and sinking.
`body-rates` commands no velocity: three body rates and a collective thrust. Any other name is a
custom set: a class, constructed without arguments, whose objects are an `ActionSet`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Literal, NamedTuple, Protocol, TypeAlias, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core import plugins
from airl_mav.core.constants import GRAVITY_M_S2, CommandKind
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import ProfileModel, later_field, quantity
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


BODY_RATES = "body-rates"
FIXED_YAW = ("velocity-fixed-yaw", "velocity3d-fixed-yaw")
VELOCITIES = ("velocity", "velocity3d", *FIXED_YAW)
CONTINUOUS = (*VELOCITIES, BODY_RATES)
VERTICAL = ("arc3d-75", "velocity3d", "velocity3d-fixed-yaw")
"""Sets that also command a vertical speed."""

DISCRETE = {"arc-25": 25, "paper-25": 25, "arc3d-75": 75}
"""Number of actions of each discrete set."""

SHIPPED = ("arc-25", "paper-25", "velocity", "velocity-fixed-yaw", *VERTICAL, BODY_RATES)
ActionSetName = Annotated[str, plugins.part_name(plugins.ACTION_SETS, SHIPPED)]

PAPER_SPEED_M_S = 5.0
"""Maximum speed of the paper's actions [m/s]."""

ARC_SPEEDS = (0.0, 0.2, 0.4, 0.7, 1.0)
"""`arc-25`: speeds as shares of the maximum."""

ARC_YAW_RATES_DEG_S = (-72.0, -27.0, 0.0, 27.0, 72.0)
"""`arc-25`: yaw rates [deg/s]."""

CLIMB_SHARES = (-1.0, 0.0, 1.0)
"""`arc3d-75`: downward speeds as shares of the maximum climb rate."""

PAPER_RIGHT_DEG_S = (108.0, 54.0, 27.0, 13.5, 6.75)
PAPER_LEFT_DEG_S = (-216.0, -108.0, -54.0, -27.0, -13.5)
"""`paper-25`: yaw rates [deg/s] (Air Learning, appendix B)."""

FOLLOW_GAIN_1_S = 1.2
"""`velocity`: yaw rate per angle between nose and course [1/s]; same as the greedy policy."""

FOLLOW_MAX_RAD_S = math.radians(90.0)
"""`velocity`: maximum yaw rate [rad/s]."""


MAX_RATE_DEG_S = 180.0
"""`body-rates`: maximum rate [deg/s]; PX4's defaults are 220 deg/s for roll and pitch, and 200
deg/s for yaw (MC_ROLLRATE_MAX, MC_PITCHRATE_MAX, MC_YAWRATE_MAX)."""

MaxRate = Annotated[
    float, quantity("greatest body rate of the set body-rates", "deg/s", gt=0, le=1800)
]


class ActionSpec(ProfileModel):
    """An action set and its maximum speed, or maximum rate."""

    set: ActionSetName = "arc-25"
    max_speed_m_s: float = quantity(
        "fastest action; all speeds scale with it", "m/s", gt=0, le=30, default=PAPER_SPEED_M_S
    )
    max_rate_deg_s: MaxRate = later_field(MAX_RATE_DEG_S)

    @property
    def commands(self) -> CommandKind:
        """Command kind of the set."""
        return "body_rates" if self.set == BODY_RATES else "velocity"


class ActionSet(Protocol):
    """Interface of a custom action set."""

    @property
    def discrete(self) -> int | None:
        """Number of discrete actions; None for a continuous set of two numbers -1..1."""

    def commands(self, actions: NDArray[Any], max_speed_m_s: float) -> NDArray[np.float64]:
        """Return the commands (n, 3) of n actions, as the function `commands` does."""


def discrete_actions(spec: ActionSpec) -> int | None:
    """Return the number of discrete actions; None for a continuous set."""
    if spec.set not in SHIPPED:
        return _own(spec.set).discrete
    return DISCRETE.get(spec.set)


def continuous_numbers(spec: ActionSpec) -> int:
    """Return the length of an action of a continuous set."""
    if spec.set == BODY_RATES:
        return len(BodyRates._fields)
    return 3 if spec.set in VERTICAL else 2


def commands_vertical_speed(spec: ActionSpec) -> bool:
    """Return whether an action set commands the vertical speed; otherwise an altitude is held."""
    return spec.set in VERTICAL


def command_numbers(spec: ActionSpec) -> int:
    """Return the length of a command from `commands`."""
    return 4 if spec.set in (*VERTICAL, BODY_RATES) else 3


def commands(spec: ActionSpec, actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the commands of n actions.

    Discrete actions are (n,) integers from 0 on. Continuous actions are (n, 2): forward and right
    speed, each -1..1 of the maximum, clipped. Sets of three dimensions are (n, 3). The third number
    is the downward speed as a share of `actions.fastest_climb`. `body-rates` is (n, 4): roll, pitch
    and yaw rate, each -1..1 of the maximum, and thrust, -1 for zero to 1 for full thrust.

    The commands are (n, 3): forward and right [m/s] in the heading frame, and yaw rate [rad/s],
    clockwise positive. Sets of three dimensions append the downward speed [m/s]. `body-rates`
    returns (n, 4), as `actions.BodyRates`. Raises UsageError if a custom set returns anything else.
    """
    if spec.set not in SHIPPED:
        return _checked(spec, actions)
    if spec.set not in CONTINUOUS:
        chosen: NDArray[np.float64] = _table(spec.set, spec.max_speed_m_s)[np.asarray(actions)]
        return chosen
    shares = np.clip(np.asarray(actions, np.float64), -1.0, 1.0)
    if spec.set == BODY_RATES:
        rates = shares[:, :3] * math.radians(spec.max_rate_deg_s)
        return np.concatenate([rates, 0.5 * (1.0 + shares[:, 3:])], axis=1)
    wanted = shares[:, :2] * spec.max_speed_m_s
    # Limit the vector's length: a corner of the square is no faster than an edge.
    speed = np.hypot(wanted[:, 0], wanted[:, 1])
    wanted *= np.minimum(1.0, spec.max_speed_m_s / np.maximum(speed, 1e-9))[:, None]
    down = shares[:, 2:] * fastest_climb(spec.max_speed_m_s)
    if spec.set in FIXED_YAW:
        return np.concatenate([wanted, np.zeros((len(wanted), 1)), down], axis=1)
    course = np.arctan2(wanted[:, 1], wanted[:, 0])
    # The turn grows with the speed, as the course is undefined in hover.
    turn = np.clip(FOLLOW_GAIN_1_S * course, -FOLLOW_MAX_RAD_S, FOLLOW_MAX_RAD_S)
    turn *= np.minimum(1.0, speed / (0.2 * spec.max_speed_m_s))
    return np.concatenate([wanted, turn[:, None], down], axis=1)


def _checked(spec: ActionSpec, actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the commands of a custom set. Raises UsageError if shape or values are invalid."""
    asked = np.asarray(_own(spec.set).commands(np.asarray(actions), spec.max_speed_m_s), np.float64)
    wanted = (len(actions), 3)
    if asked.shape != wanted or not np.isfinite(asked).all():
        found = f"an array {asked.shape}" if asked.shape != wanted else "what is no number"
        raise UsageError(f"actions {spec.set!r}: gives {found}; accepted: {wanted} numbers")
    return asked


@cache
def _own(name: str) -> ActionSet:
    """Return a custom action set. Raises FieldError."""
    door = plugins.ACTION_SETS
    found = plugins.load_part(door, name, lambda made: callable(getattr(made, "commands", None)))
    try:
        own = found() if isinstance(found, type) else found
    except Exception as error:
        problem = f"cannot be made without arguments: {type(error).__name__}: {error}"
        raise FieldError(door.field, name, problem=problem) from error
    count = getattr(own, "discrete", None)
    if not (count is None or (type(count) is int and count > 1)):
        problem = f"its number of actions is discrete = {count!r}; accepted: 2 or more, or None"
        raise FieldError(door.field, name, problem=problem)
    return cast("ActionSet", own)


def command(spec: ActionSpec, action: NDArray[Any]) -> Action | BodyRates:
    """Return the command of one action, (), (2,), (3,) or (4,) by action set."""
    numbers = commands(spec, np.asarray(action)[None])[0].tolist()
    if spec.set == BODY_RATES:
        return BodyRates(*numbers)
    forward, right, turn, *down = numbers
    return Action(forward, right, turn, down[0] if down else None)


@cache
def _table(name: str, max_speed: float) -> NDArray[np.float64]:
    """Return the commands of a discrete set: (k, 3), or (k, 4) with a vertical speed."""
    if name == "arc3d-75":
        climb = fastest_climb(max_speed)
        return np.array(
            [
                (*arc, share * climb)
                for share in CLIMB_SHARES
                for arc in _table("arc-25", max_speed).tolist()
            ]
        )
    if name == "arc-25":
        rows = [
            (share * max_speed, 0.0, math.radians(rate))
            for share in ARC_SPEEDS
            for rate in ARC_YAW_RATES_DEG_S
        ]
    else:
        slowest = max_speed / PAPER_SPEED_M_S
        rows = [(speed, 0.0, 0.0) for speed in np.linspace(max_speed, slowest, 10)]
        rows += [(-speed, 0.0, 0.0) for speed in np.linspace(max_speed, slowest, 5)]
        rows += [(0.0, 0.0, math.radians(rate)) for rate in PAPER_RIGHT_DEG_S]
        rows += [(0.0, 0.0, math.radians(rate)) for rate in PAPER_LEFT_DEG_S]
    return np.array(rows)
