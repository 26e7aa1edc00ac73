"""Plans stored on board, and the interface of missions, which the add-on `missions` implements.

Source: PX4 1.16, navigation.h and dataman.h.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Protocol

from airl_mav.core import constants, frames
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot import autopilot_state, flight_modes


class MissionType(IntEnum):
    """MAV_MISSION_TYPE."""

    MISSION = 0
    FENCE = 1
    RALLY = 2


POSITION_COMMANDS = frozenset({16, 17, 19, 21, 22, 31, 84, 85})
"""MAV_CMD with a place to fly to: waypoint, loiter, take-off, land
(MissionBlock::item_contains_position)."""

_RELATIVE = (3, 6)
"""MAV_FRAME_GLOBAL_RELATIVE_ALT and MAV_FRAME_GLOBAL_RELATIVE_ALT_INT."""


@dataclass(frozen=True, slots=True)
class PlanItem:
    """Item of a mission, fence or list of rally points."""

    command: int
    """MAV_CMD."""
    frame: int
    """MAV_FRAME."""
    params: tuple[float, float, float, float]
    """Parameters 1..4; angles in degrees as on the wire, NaN = not given."""
    x: float
    """Latitude [deg]; parameter 5 in frame MISSION."""
    y: float
    """Longitude [deg]; parameter 6 in frame MISSION."""
    z: float
    """Altitude [m] above mean sea level or home, by the frame; parameter 7 in frame MISSION."""
    autocontinue: bool = True
    """True if the mission continues automatically after the item."""

    @property
    def has_position(self) -> bool:
        """True if the item has a place to fly to."""
        return self.command in POSITION_COMMANDS

    @property
    def altitude_is_relative(self) -> bool:
        """True if the altitude is relative to home."""
        return self.frame in _RELATIVE

    def place(self, home_altitude_m: float) -> frames.Geodetic:
        """Return the item's place for a home altitude above mean sea level [m]."""
        above = home_altitude_m if self.altitude_is_relative else 0.0
        return frames.Geodetic(self.x, self.y, self.z + above)


class Stored(NamedTuple):
    """Stored list of items."""

    items: tuple[PlanItem, ...] = ()
    identity: int = 0
    """PX4's opaque id of the list, a checksum; 0 = empty."""
    revision: int = 0
    """Number of changes."""


class Plans:
    """Storage of all plans and of the mission progress: PX4's dataman.

    It persists with the autopilot, through landings and disarming.
    """

    def __init__(self) -> None:
        self._stored = {kind: Stored() for kind in MissionType}
        self.current = 0
        """Index of the active mission item, or of the next item if the mission is paused."""
        self.set_current_count = 0
        """Number of client selections of the current item."""
        self.changes = 0
        """Number of stored lists and client selections."""
        self.history: list[tuple[str, float, float]] = []
        """Name, old and new number of items of each stored list; the MAVLink server takes them."""
        self.reached = -1
        """Index of the newest reached item; -1 = none in this run."""
        self.has_state = True
        """True if a return completes the mission and its state is reported (from PX4 1.17 on)."""
        self.valid = False
        """True if the mission is feasible."""
        self.finished = False
        """True if the mission has ended in this run."""
        self.jumps_done: dict[int, int] = {}
        """Number of executions of each DO_JUMP, by index."""
        self.jumped = -1
        """Index of the newest DO_JUMP with a changed count; -1 = none."""
        self.receiving = False
        """True while a list is being uploaded, on any link."""

    @property
    def progress(self) -> tuple[int, int, int, int]:
        """Mission progress: current and reached item, newest DO_JUMP and its count."""
        return self.current, self.reached, self.jumped, self.jumps_done.get(self.jumped, 0)

    def stored(self, kind: MissionType) -> Stored:
        """Return a stored list."""
        return self._stored[kind]

    @property
    def mission(self) -> tuple[PlanItem, ...]:
        """Items of the mission."""
        return self._stored[MissionType.MISSION].items

    def store(
        self, kind: MissionType, items: tuple[PlanItem, ...], identity: int, current: int = -1
    ) -> None:
        """Replace a list.

        `current` is the first mission item; -1 = the current index, at most the last item.
        """
        self.changes += 1
        before = len(self._stored[kind].items)
        self.history.append((f"items of {kind.name.lower()}", before, len(items)))
        self._stored[kind] = Stored(items, identity, self._stored[kind].revision + 1)
        if kind is MissionType.MISSION:
            self.current = current if current >= 0 else min(self.current, max(0, len(items) - 1))
            self.jumps_done.clear()
            self.jumped = self.reached = -1
            self.finished = False

    def clear(self, kind: MissionType) -> None:
        """Delete a list."""
        self.store(kind, (), 0, 0)

    def set_current(self, index: int) -> None:
        """Set the current mission item on a client's request. Raises IndexError."""
        if not 0 <= index < len(self.mission):
            raise IndexError(f"mission item {index}: there are {len(self.mission)}")
        self.current = index
        self.set_current_count += 1
        self.changes += 1


def distance_m(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Return the great-circle distance [m] between two places (latitude, longitude) [deg].

    Haversine on a sphere, like PX4's get_distance_to_next_waypoint.
    """
    lat_a, lat_b = math.radians(a[0]), math.radians(b[0])
    half_lat = math.sin(0.5 * (lat_b - lat_a))
    half_lon = math.sin(0.5 * math.radians(b[1] - a[1]))
    h = half_lat * half_lat + half_lon * half_lon * math.cos(lat_a) * math.cos(lat_b)
    return constants.EARTH_RADIUS_M * 2.0 * math.atan2(math.sqrt(h), math.sqrt(max(0.0, 1.0 - h)))


class NavigationState(NamedTuple):
    """State of the vehicle for navigation."""

    time_us: int
    position: Vec
    """Local NED [m]."""
    yaw: float
    """Heading [rad]."""
    landed: bool
    home: frames.Geodetic
    origin: frames.Geodetic
    """Geodetic origin of local NED."""
    velocity: Vec = (0.0, 0.0, 0.0)
    """NED [m/s]."""

    def local(self, place: frames.Geodetic) -> Vec:
        """Return a place in local NED [m]."""
        north, east, down = frames.geodetic_to_local(place, self.origin).tolist()
        return north, east, down


class Crew(Protocol):
    """Callbacks for mission commands other than flight."""

    def say(self, message: autopilot_state.OperatorText, /) -> None:
        """Send a text to the operator."""

    def set_home(self, place: frames.Geodetic | None, /) -> object:
        """Move home; None = the current position."""

    def return_to_launch(self) -> None:
        """Abort the mission and return."""


class Missions:
    """Missions of a vehicle. The add-on `missions` extends this class, which has none."""

    @property
    def valid(self) -> bool:
        """True if a feasible mission is stored, as required by Mission mode."""
        return False

    @property
    def over(self) -> bool:
        """True if the active mission has ended."""
        return False

    def review(self, _now: NavigationState, /) -> None:
        """Check the mission after a change of mission, fence or home."""

    def step(self, _now: NavigationState, _mode: flight_modes.Mode, /, *, armed: bool) -> None:
        """Advance by a period of the navigator."""

    def destination(self, now: NavigationState, /) -> frames.Geodetic | None:
        """Return the destination of Return at ground altitude; None = along mission items."""
        return now.home

    def look_at(self, _place: frames.Geodetic | None, /) -> None:
        """Set the region of interest; None = clear it."""
