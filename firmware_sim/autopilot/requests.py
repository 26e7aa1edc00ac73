"""What modes are asked for beyond their names: places, speeds, circles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from airl_mav.vehicle.rotation import Vec

NAN = math.nan


class Place(NamedTuple):
    """A place and the heading that is kept there."""

    position: Vec
    """Local NED [m]."""
    yaw: float
    """Heading [rad]; where a request allows it, NaN = towards the place."""


class Request:
    """What a mode is entered with, beyond its name: the base of such data, one class a kind."""


@dataclass(frozen=True, slots=True)
class ClimbOn(Request):
    """Hold: climb the rest of a take-off that has ended near its altitude."""

    place: Place


@dataclass(frozen=True, slots=True)
class Reposition(Request):
    """Hold: go to a place first (MAV_CMD_DO_REPOSITION). NaN on an axis = stay there."""

    place: Place
    speed_m_s: float = NAN
    """NaN = as fast as before."""
