"""Mission items in local metres, and a flight that is moved by hand."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from airl_mav.core.frames import Geodetic, local_to_geodetic
from airl_mav.profiles.px4_release import px4_release
from airl_mav.vehicle.rotation import Vec
from firmware_sim.addons.missions.executor import MissionExecutor
from firmware_sim.addons.missions.feasibility import FeasibilityResult, check
from firmware_sim.addons.missions.items import NavCommand, PlanFrame
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.autopilot.navigation.navigator import PERIOD_US
from firmware_sim.autopilot.navigation.plan import MissionType, NavigationState, PlanItem, Plans

NAN = math.nan
ORIGIN = Geodetic(47.397743, 8.545594, 489.4)
DEFAULTS = {spec.name: float(spec.default) for spec in px4_release().specs}


def place(north: float, east: float, up: float = 0.0, origin: Geodetic = ORIGIN) -> Geodetic:
    """Return a place on the globe from metres about the origin."""
    return local_to_geodetic(np.array([north, east, -up]), origin)


def at(
    north: float,
    east: float,
    up: float,
    command: int = NavCommand.WAYPOINT,
    *params: float,
    frame: int = PlanFrame.GLOBAL_RELATIVE_ALT_INT,
    autocontinue: bool = True,
    origin: Geodetic = ORIGIN,
) -> PlanItem:
    """Return an item at metres from the origin and above home; parameter 4 is NaN unless given."""
    where = place(north, east, 0.0, origin)
    padded = (*params, *(0.0, 0.0, 0.0, NAN)[len(params) :])
    first, second, third, fourth = padded
    return PlanItem(
        command,
        frame,
        (first, second, third, fourth),
        where.latitude_deg,
        where.longitude_deg,
        up,
        autocontinue,
    )


def do(command: int, *params: float, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> PlanItem:
    """Return an item without a place."""
    first, second, third, fourth = (*params, *(0.0, 0.0, 0.0, 0.0)[len(params) :])
    return PlanItem(command, PlanFrame.MISSION, (first, second, third, fourth), x, y, z)


class FakeFlight:
    """An executor and a vehicle that is wherever the test puts it."""

    def __init__(self, *items: PlanItem, parameters: Mapping[str, float] | None = None) -> None:
        self.values = {**DEFAULTS, **(parameters or {})}
        self.plans = Plans()
        self.texts: list[str] = []
        self.homes: list[Geodetic | None] = []
        self.returned = False
        self.now = NavigationState(0, (0.0, 0.0, 0.0), 0.0, True, ORIGIN, ORIGIN)
        self.executor = MissionExecutor(self.plans, self.values.__getitem__, self, self._check)
        if items:
            self.plans.store(MissionType.MISSION, items, 1, 0)

    def _check(self, now: NavigationState) -> FeasibilityResult:
        return check(
            self.plans.mission,
            now.home,
            self.values.__getitem__,
            landed=now.landed,
            inside_fence=lambda _: True,
        )

    # --- the crew

    def say(self, message: OperatorText) -> None:
        self.texts.append(message.text)

    def set_home(self, place: Geodetic | None) -> None:
        self.homes.append(place)

    def return_to_launch(self) -> None:
        self.returned = True

    # --- the flight

    def start(self) -> None:
        """Begin Mission mode where the vehicle is."""
        self.executor.idle(self.now, armed=True)
        self.executor.activate(self.now)

    def be(
        self,
        position: Vec | None = None,
        *,
        landed: bool = False,
        yaw: float | None = None,
        seconds: float = 0.0,
    ) -> None:
        """Let time pass; then the vehicle is at a place NED."""
        steps = max(1, round(seconds * 1e6 / PERIOD_US))
        for _ in range(steps):
            self.now = self.now._replace(
                time_us=self.now.time_us + PERIOD_US,
                position=self.now.position if position is None else position,
                landed=landed,
                yaw=self.now.yaw if yaw is None else yaw,
            )
            self.executor.update(self.now)

    def arrive(self, *, landed: bool = False) -> None:
        """Move to the executor's target, with the requested heading."""
        triplet = self.executor.triplet
        yaw = None if math.isnan(triplet.yaw) else triplet.yaw
        self.be(triplet.target, landed=landed, yaw=yaw)
