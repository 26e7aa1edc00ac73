"""Inputs from clients: arguments of mode requests, targets, obstacles, and the pilot's sticks.

Source of the sticks: PX4 1.16, ManualControlSelector.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from airl_mav.vehicle.rotation import Vec

NAN = math.nan


class PositionYaw(NamedTuple):
    """Position with a heading."""

    position: Vec
    """Position, local NED [m]."""
    yaw: float
    """Heading [rad]; in some requests NaN = towards the place."""


class ModeRequest:
    """Base class for the arguments of a mode request, one subclass per type."""


@dataclass(frozen=True, slots=True)
class ClimbOn(ModeRequest):
    """Hold: finish the climb of a take-off that has ended near its altitude."""

    place: PositionYaw


@dataclass(frozen=True, slots=True)
class Reposition(ModeRequest):
    """Hold: fly to a place first (MAV_CMD_DO_REPOSITION). NaN on an axis = unchanged."""

    place: PositionYaw
    speed_m_s: float = NAN
    """Speed [m/s]; NaN = unchanged."""
    altitude_alone: bool = False
    """True if only the altitude was requested (MAV_CMD_DO_CHANGE_ALTITUDE)."""


@dataclass(frozen=True, slots=True)
class OrbitRequest(ModeRequest):
    """Orbit: circle parameters (MAV_CMD_DO_ORBIT). NaN = unchanged."""

    centre: Vec = (NAN, NAN, NAN)
    """Centre, local NED [m]."""
    radius_m: float = NAN
    """Radius, positive clockwise, negative counter-clockwise."""
    speed_m_s: float = NAN
    facing: int | None = None
    """ORBIT_YAW_BEHAVIOUR; None = unchanged."""


@dataclass(frozen=True, slots=True)
class PrecisionRequest(ModeRequest):
    """Precision Landing: place to look for the target, instead of the current position."""

    place: Vec
    """Place, local NED [m]."""
    required: bool
    """True: search for the target if not visible; False: land without it."""


class LandingTarget(NamedTuple):
    """Target of a precision landing."""

    position: Vec
    """Position, local NED [m]."""
    time_us: int
    """Time of arrival, in simulated time."""


class ObstacleBins(NamedTuple):
    """Distances to the nearest obstacle in bins around the vehicle, as in OBSTACLE_DISTANCE."""

    distances_cm: tuple[int, ...]
    """Distances clockwise; beyond the range: no obstacle; 65535: unknown."""
    increment_deg: float
    """Width of a bin."""
    offset_deg: float
    """Direction of the centre of the first bin."""
    nearest_cm: int
    """Minimum range of the sensor; the maximum follows."""
    farthest_cm: int
    in_world: bool
    """True if directions are relative to north instead of straight ahead."""
    time_us: int
    """Time of arrival, in simulated time."""


class FollowedTarget(NamedTuple):
    """Target of Follow."""

    position: Vec
    """Position, local NED [m]."""
    velocity: Vec
    """Velocity NED [m/s]."""
    time_us: int
    """Time of arrival, in simulated time."""


FOLLOWED_S = 0.3
"""Time constant of the rest position's low-pass [s]; a difference from it counts as motion."""


class Sticks(NamedTuple):
    """Stick deflections -1..1."""

    roll: float
    """Positive right."""
    pitch: float
    """Positive forward."""
    throttle: float
    """Positive up; 0 = centre."""
    yaw: float
    """Positive clockwise."""


class Source(Enum):
    """Input device of the sticks."""

    RADIO = auto()
    JOYSTICK = auto()


_ALLOWED = {
    0: (Source.RADIO,),
    1: (Source.JOYSTICK,),
    2: (Source.RADIO, Source.JOYSTICK),
    3: (Source.RADIO, Source.JOYSTICK),
}
"""Allowed sources by COM_RC_IN_MODE; 3 keeps the first source, 4 allows none."""


class ManualControl:
    """Newest sticks of the selected source."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Store the look-up for PX4 parameters."""
        self._value = value
        self.was_heard = False
        """True if sticks have been received since boot."""
        self._sticks: Sticks | None = None
        self._source: Source | None = None
        self._time_us = 0
        self._rest = Sticks(0.0, 0.0, 0.0, 0.0)

    def offer(self, sticks: Sticks, source: Source, time_us: int) -> bool:
        """Accept sticks from an allowed source; return whether the pilot moves them.

        The threshold is a change of any stick by more than COM_RC_STICK_OV [%].
        """
        mode = int(self._value("COM_RC_IN_MODE"))
        if source not in _ALLOWED.get(mode, ()):
            return False
        fresh = self.sticks(time_us) is not None
        # COM_RC_IN_MODE 3 keeps its first source; others switch after a loss.
        held = fresh or mode == 3
        if held and self._source is not None and source is not self._source:
            return False
        # After a loss, the first sticks are the rest position.
        if not fresh:
            self._rest = sticks
        elapsed_s = (time_us - self._time_us) / US_PER_S
        # Low-pass with the real time between messages.
        weight = min(1.0, elapsed_s / (elapsed_s + FOLLOWED_S)) if elapsed_s > 0.0 else 0.0
        self._rest = Sticks(
            *(r + weight * (s - r) for r, s in zip(self._rest, sticks, strict=True))
        )
        self.was_heard = True
        self._sticks, self._source, self._time_us = sticks, source, time_us
        limit = self._value("COM_RC_STICK_OV") / 100.0
        return any(abs(s - r) > limit for s, r in zip(sticks, self._rest, strict=True))

    def sticks(self, time_us: int) -> Sticks | None:
        """Return the sticks; None before the first and after COM_RC_LOSS_T without input."""
        limit_us = self._value("COM_RC_LOSS_T") * US_PER_S
        if self._sticks is None or time_us - self._time_us > limit_us:
            return None
        return self._sticks
