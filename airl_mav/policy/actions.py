"""Actions of policies, and action sets, which convert a network's output to an action.

An action is a velocity, or an attitude or body rates with a thrust.

Action sets: `arc-25`: five speeds with five yaw rates. `paper-25`: the 25 actions of the paper's
text. `velocity`: the paper's continuous pair, forward and right speed, the nose turns to the
course; `velocity-fixed-yaw`: the same pair with a fixed heading. Sets of three dimensions
also command the vertical speed; the other sets hold an altitude. `velocity3d` and
`velocity3d-fixed-yaw` are these two with a third number, `velocity3d-yaw-rate` is the pair with a
yaw rate and a vertical speed, and `arc3d-75` is `arc-25` climbing, level and sinking.
`body-rates` commands no velocity: three body rates and a collective thrust. Any other name is a
custom set: a class, constructed without arguments.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    Protocol,
    TypeAlias,
    runtime_checkable,
)

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


CLIMB_SHARE = 0.3
"""Maximum climb and descent rate as a share of the maximum level speed: 1.5 m/s at 5 m/s, as in
PX4's default descent (MPC_Z_VEL_MAX_DN)."""


def fastest_climb(speed_m_s: float) -> float:
    """Return the maximum vertical speed of an action [m/s] for a maximum level speed [m/s]."""
    return CLIMB_SHARE * speed_m_s


# --- kinds of commands


@dataclass(frozen=True)
class Action:
    """A velocity command. Without a vertical speed the pilot holds an altitude."""

    forward_m_s: float
    right_m_s: float
    yaw_rate_rad_s: float
    """Yaw rate, positive clockwise seen from above."""
    down_m_s: float | None = None
    """Vertical speed, positive downwards; None = the pilot holds the altitude."""

    def within(self, speed_m_s: float) -> Action:
        """Return the action with its speed limited and non-finite values set to zero.

        The vertical speed, if present, is limited to `fastest_climb` of `speed_m_s`.
        """
        numbers = (self.forward_m_s, self.right_m_s, self.yaw_rate_rad_s)
        forward, right, turn = [n if math.isfinite(n) else 0.0 for n in numbers]
        speed = math.hypot(forward, right)
        scale = min(1.0, speed_m_s / speed) if speed > 0.0 else 1.0
        down = self.down_m_s
        if down is not None:
            climb = fastest_climb(speed_m_s)
            down = max(-climb, min(climb, down)) if math.isfinite(down) else 0.0
        return Action(forward * scale, right * scale, turn, down)


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

    def within(self, speed_m_s: float) -> Attitude:  # noqa: ARG002 (for velocities)
        """Return the attitude with a thrust of 0 to 1. Raises ValueError if not finite."""
        return self._replace(thrust=_flyable_thrust(self))

    def stopped(self) -> Attitude:
        """Return the level attitude of the same heading and thrust."""
        return Attitude(0.0, 0.0, self.yaw_rad, self.thrust)


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

    def within(self, speed_m_s: float) -> BodyRates:  # noqa: ARG002 (for velocities)
        """Return the rates with a thrust of 0 to 1. Raises ValueError if not finite."""
        return self._replace(thrust=_flyable_thrust(self))

    def stopped(self) -> BodyRates:
        """Return zero rates with the same thrust."""
        return BodyRates(0.0, 0.0, 0.0, self.thrust)


def _flyable_thrust(action: Attitude | BodyRates) -> float:
    if not all(map(math.isfinite, action)):
        raise ValueError(f"it returned what is no number: {action}")
    return min(1.0, max(0.0, action.thrust))


AnyAction: TypeAlias = "Action | Attitude | BodyRates"


@dataclass(frozen=True)
class CommandSpec:
    """Kind of commands; limits and encoding are methods of its action."""

    action: type[Action] | type[Attitude] | type[BodyRates]
    title: str
    """Name in messages."""
    levels: tuple[str, ...] = ("gym", "lockstep", "sitl")
    """Fidelity levels that support the kind."""
    steady: bool = False
    """True if the vehicle stays upright while the last command persists. The effect of other kinds
    is not predicted by latency compensation, and ArduPilot does not support them."""


KINDS: dict[CommandKind, CommandSpec] = {
    "velocity": CommandSpec(Action, "velocity", steady=True),
    "attitude": CommandSpec(Attitude, "attitude", ("lockstep", "sitl")),
    "body_rates": CommandSpec(BodyRates, "body rates"),
}

UPRIGHT_S = 0.15
"""Default timeout of commands that are not `steady`, beyond the hold time [s]. The flight
controller then holds the vehicle. At 3 rad/s the vehicle has turned by 26 degrees."""

ALTITUDE_P = 0.5
"""Vertical speed per metre of altitude error [1/s]; stable with decisions 1.5 s apart."""

MAX_VERTICAL_M_S = 1.0
"""Limit of the altitude correction [m/s]."""


def vertical_speed(altitude_m: float, down_m: float) -> float:
    """Return the downward speed [m/s] that holds a height above the start [m], from a position."""
    speed = ALTITUDE_P * (-altitude_m - down_m)
    return float(np.clip(speed, -MAX_VERTICAL_M_S, MAX_VERTICAL_M_S))


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


def failure_of(error: Exception) -> str:
    """Return the reason of a flight whose policy raised an error, in one line."""
    return " ".join(f"policy failed: {type(error).__name__}: {error}".split())


def flyable(action: AnyAction, kind: CommandKind, speed_m_s: float) -> AnyAction:
    """Return an action within limits: a limited speed, or a thrust within 0..1.

    Raises:
        TypeError: The action has another command kind.
        ValueError: An attitude, a body rate or a thrust is not finite. There is no safe default.
    """
    wanted = KINDS[kind].action
    if not isinstance(action, wanted):
        raise TypeError(f"it returned {type(action).__name__}; accepted: {wanted.__name__}")
    return action.within(speed_m_s)


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


MAX_YAW_RATE_RAD_S = math.radians(120.0)
"""`velocity3d-yaw-rate`: maximum yaw rate [rad/s]."""


MAX_RATE_DEG_S = 180.0
"""`body-rates`: maximum rate [deg/s]; PX4's defaults are 220 deg/s for roll and pitch, and 200
deg/s for yaw (MC_ROLLRATE_MAX, MC_PITCHRATE_MAX, MC_YAWRATE_MAX)."""

MaxRate = Annotated[
    float, quantity("greatest body rate of the set body-rates", "deg/s", gt=0, le=1800)
]


class ActionSet:
    """Action set: number of actions, commands, and their kind. Base class of the shipped sets.

    Custom sets need no base class: they have the attribute `discrete`, None for continuous actions
    of two numbers -1..1, and a method `commands(actions, max_speed_m_s)` that returns (n, 3).
    """

    kind: CommandKind = "velocity"
    discrete: int | None = None
    """Number of discrete actions; None for a continuous set."""
    numbers = 2
    """Length of an action of a continuous set."""
    vertical = False
    """True if the set also commands a vertical speed; otherwise an altitude is held."""

    @property
    def command_numbers(self) -> int:
        """Length of a command."""
        return 3 + self.vertical

    def commands(self, spec: ActionSpec, actions: NDArray[Any]) -> NDArray[np.float64]:
        """Return the commands of n actions; see the function `commands`."""
        raise NotImplementedError


Row = tuple[float, ...]


class DiscreteSet(ActionSet):
    """Table of commands at a maximum speed [m/s]."""

    def __init__(
        self,
        count: int,
        rows: Callable[[float], list[tuple[float, ...]]],
        *,
        vertical: bool = False,
    ) -> None:
        self.discrete, self.vertical = count, vertical
        self._table = cache(lambda max_speed_m_s: np.array(rows(max_speed_m_s)))

    def commands(self, spec: ActionSpec, actions: NDArray[Any]) -> NDArray[np.float64]:
        """Return the rows of n numbers."""
        chosen: NDArray[np.float64] = self._table(spec.max_speed_m_s)[np.asarray(actions)]
        return chosen


class VelocitySet(ActionSet):
    """Continuous velocities, clipped; without a fixed heading the nose turns to the course."""

    def __init__(
        self, *, vertical: bool = False, fixed_yaw: bool = False, yaw_rate: bool = False
    ) -> None:
        self.vertical, self.numbers, self._fixed_yaw = vertical, 2 + vertical + yaw_rate, fixed_yaw
        self._yaw_rate = yaw_rate

    def commands(self, spec: ActionSpec, actions: NDArray[Any]) -> NDArray[np.float64]:
        """Return the velocities of n shares of the maximum."""
        shares = np.clip(np.asarray(actions, np.float64), -1.0, 1.0)
        wanted = shares[:, :2] * spec.max_speed_m_s
        # Limit the vector's length: a corner of the square is no faster than an edge.
        speed = np.hypot(wanted[:, 0], wanted[:, 1])
        wanted *= np.minimum(1.0, spec.max_speed_m_s / np.maximum(speed, 1e-9))[:, None]
        climb = fastest_climb(spec.max_speed_m_s)
        if self._yaw_rate:
            return np.concatenate([wanted, shares[:, 2:] * (MAX_YAW_RATE_RAD_S, climb)], axis=1)
        down = shares[:, 2:] * climb
        if self._fixed_yaw:
            return np.concatenate([wanted, np.zeros((len(wanted), 1)), down], axis=1)
        course = np.arctan2(wanted[:, 1], wanted[:, 0])
        # The turn grows with the speed, as the course is undefined in hover.
        turn = np.clip(FOLLOW_GAIN_1_S * course, -FOLLOW_MAX_RAD_S, FOLLOW_MAX_RAD_S)
        turn *= np.minimum(1.0, speed / (0.2 * spec.max_speed_m_s))
        return np.concatenate([wanted, turn[:, None], down], axis=1)


class BodyRateSet(ActionSet):
    """Continuous body rates and thrust."""

    kind = "body_rates"
    numbers = command_numbers = 4

    def commands(self, spec: ActionSpec, actions: NDArray[Any]) -> NDArray[np.float64]:
        """Return the rates of n shares of the maximum, and the thrusts."""
        shares = np.clip(np.asarray(actions, np.float64), -1.0, 1.0)
        rates = shares[:, :3] * math.radians(spec.max_rate_deg_s)
        return np.concatenate([rates, 0.5 * (1.0 + shares[:, 3:])], axis=1)


class CustomSet(ActionSet):
    """Set of a custom class, which is loaded on first use. Raises FieldError."""

    def __init__(self, name: str) -> None:
        door = plugins.ACTION_SETS
        self._custom = plugins.load_object(door, name, ("commands",))
        count = getattr(self._custom, "discrete", None)
        if not (count is None or (type(count) is int and count > 1)):
            problem = f"its number of actions is discrete = {count!r}; accepted: 2 or more, or None"
            raise FieldError(door.field, name, problem=problem)
        self.discrete = count

    def commands(self, spec: ActionSpec, actions: NDArray[Any]) -> NDArray[np.float64]:
        """Return the commands. Raises UsageError if shape or values are invalid."""
        given = self._custom.commands(np.asarray(actions), spec.max_speed_m_s)
        asked, wanted = np.asarray(given, np.float64), (len(actions), 3)
        if asked.shape != wanted or not np.isfinite(asked).all():
            found = f"an array {asked.shape}" if asked.shape != wanted else "what is no number"
            raise UsageError(f"actions {spec.set!r}: gives {found}; accepted: {wanted} numbers")
        return asked


def _arc(max_speed_m_s: float) -> list[Row]:
    return [
        (share * max_speed_m_s, 0.0, math.radians(rate))
        for share in ARC_SPEEDS
        for rate in ARC_YAW_RATES_DEG_S
    ]


def _arc_3d(max_speed_m_s: float) -> list[Row]:
    climb = fastest_climb(max_speed_m_s)
    return [(*arc, share * climb) for share in CLIMB_SHARES for arc in _arc(max_speed_m_s)]


def _paper(max_speed_m_s: float) -> list[Row]:
    slowest = max_speed_m_s / PAPER_SPEED_M_S
    return [
        *((speed, 0.0, 0.0) for speed in np.linspace(max_speed_m_s, slowest, 10)),
        *((-speed, 0.0, 0.0) for speed in np.linspace(max_speed_m_s, slowest, 5)),
        *((0.0, 0.0, math.radians(rate)) for rate in (*PAPER_RIGHT_DEG_S, *PAPER_LEFT_DEG_S)),
    ]


BODY_RATES = "body-rates"

ACTION_SETS: dict[str, ActionSet] = {
    "arc-25": DiscreteSet(25, _arc),
    "paper-25": DiscreteSet(25, _paper),
    "velocity": VelocitySet(),
    "velocity-fixed-yaw": VelocitySet(fixed_yaw=True),
    "arc3d-75": DiscreteSet(75, _arc_3d, vertical=True),
    "velocity3d": VelocitySet(vertical=True),
    "velocity3d-fixed-yaw": VelocitySet(vertical=True, fixed_yaw=True),
    "velocity3d-yaw-rate": VelocitySet(vertical=True, yaw_rate=True),
    BODY_RATES: BodyRateSet(),
}
"""Shipped action sets by name."""

SHIPPED = tuple(ACTION_SETS)
VELOCITIES = tuple(name for name, each in ACTION_SETS.items() if isinstance(each, VelocitySet))
VERTICAL = tuple(name for name, each in ACTION_SETS.items() if each.vertical)
"""Sets that also command a vertical speed."""

ActionSetName = Annotated[str, plugins.part_name(plugins.ACTION_SETS, SHIPPED)]


class ActionSpec(ProfileModel):
    """An action set and its maximum speed, or maximum rate."""

    set: ActionSetName = "arc-25"
    max_speed_m_s: float = quantity(
        "fastest action; all speeds scale with it", "m/s", gt=0, le=30, default=PAPER_SPEED_M_S
    )
    max_rate_deg_s: MaxRate = later_field(MAX_RATE_DEG_S)

    @property
    def commands(self) -> CommandKind:
        """Command kind of the set; a custom set commands velocities."""
        return ACTION_SETS[self.set].kind if self.set in ACTION_SETS else "velocity"

    @property
    def vertical(self) -> bool:
        """True if the set commands a vertical speed; otherwise an altitude is held."""
        return self.set in VERTICAL


def set_of(spec: ActionSpec) -> ActionSet:
    """Return the action set of a specification. Raises FieldError for an unusable custom set."""
    return _set_named(spec.set)


@cache
def _set_named(name: str) -> ActionSet:
    """Return the action set of a name; cached, as every step needs it."""
    return ACTION_SETS.get(name) or CustomSet(name)


def discrete_actions(spec: ActionSpec) -> int | None:
    """Return the number of discrete actions; None for a continuous set."""
    return _set_named(spec.set).discrete


def continuous_numbers(spec: ActionSpec) -> int:
    """Return the length of an action of a continuous set."""
    return set_of(spec).numbers


def command_numbers(spec: ActionSpec) -> int:
    """Return the length of a command from `commands`."""
    return set_of(spec).command_numbers


def commands(spec: ActionSpec, actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the commands of n actions.

    Discrete actions are (n,) integers from 0 on. Continuous actions are (n, 2): forward and right
    speed, each -1..1 of the maximum, clipped. Sets of three dimensions are (n, 3). The third
    number is the downward speed as a share of `actions.fastest_climb`. `velocity3d-yaw-rate` is
    (n, 4): the third number is the yaw rate as a share of `MAX_YAW_RATE_RAD_S`, the fourth the
    downward speed. `body-rates` is (n, 4): roll, pitch and yaw rate, each -1..1 of the maximum, and
    thrust, -1 for zero to 1 for full thrust.

    The commands are (n, 3): forward and right [m/s] in the heading frame, and yaw rate [rad/s],
    clockwise positive. Sets of three dimensions append the downward speed [m/s]. `body-rates`
    returns (n, 4), as `actions.BodyRates`. Raises UsageError if a custom set returns anything else.
    """
    return _set_named(spec.set).commands(spec, actions)


def command(spec: ActionSpec, action: NDArray[Any]) -> AnyAction:
    """Return the command of one action, (), (2,), (3,) or (4,) by action set."""
    numbers = commands(spec, np.asarray(action)[None])[0].tolist()
    return KINDS[spec.commands].action(*numbers)
