"""Geofence: its geometry against an independent method, and breaches."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from airl_mav.core.frames import Geodetic
from firmware_sim.addons.missions.items import NavCommand
from firmware_sim.addons.missions.manager import destination
from firmware_sim.autopilot.autopilot_state import OperatorText, Result
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import PositionYaw, Reposition
from firmware_sim.autopilot.navigation.geofence import (
    FENCE_PERIOD_US,
    Circle,
    FenceMonitor,
    Polygon,
    all_allow,
    areas,
    braking_distance,
)
from firmware_sim.autopilot.navigation.plan import MissionType, NavigationState, PlanItem, Plans
from tests.support.flight_rig import Rig, velocity_setpoint
from tests.support.mission_kit import DEFAULTS, ORIGIN, at, place

N = NavCommand
SQUARE = [(-30.0, -30.0), (30.0, -30.0), (30.0, 30.0), (-30.0, 30.0)]


def polygon(corners: Sequence[tuple[float, float]], *, inclusion: bool = True) -> list[PlanItem]:
    command = N.FENCE_POLYGON_VERTEX_INCLUSION if inclusion else N.FENCE_POLYGON_VERTEX_EXCLUSION
    return [at(north, east, 0, command, len(corners)) for north, east in corners]


def circle(north: float, east: float, radius: float, *, inclusion: bool = True) -> PlanItem:
    command = N.FENCE_CIRCLE_INCLUSION if inclusion else N.FENCE_CIRCLE_EXCLUSION
    return at(north, east, 0, command, radius)


def winding(corners: Sequence[tuple[float, float]], point: tuple[float, float]) -> float:
    """Return how often a polygon goes round a point: the sum of angles, in turns."""
    angles = [math.atan2(y - point[1], x - point[0]) for x, y in corners]
    turns = np.diff([*angles, angles[0]])
    return float(np.sum((turns + math.pi) % (2.0 * math.pi) - math.pi) / (2.0 * math.pi))


def edge_distance(
    corners: Sequence[tuple[float, float]], point: tuple[float, float]
) -> list[float]:
    """Return the distance of a point to each edge."""
    found = []
    for (ax, ay), (bx, by) in zip(corners, [*corners[1:], corners[0]], strict=True):
        dx, dy = bx - ax, by - ay
        share = ((point[0] - ax) * dx + (point[1] - ay) * dy) / (dx * dx + dy * dy)
        share = min(1.0, max(0.0, share))
        found.append(math.hypot(point[0] - ax - share * dx, point[1] - ay - share * dy))
    return found


@given(
    radii=st.lists(st.floats(0.2, 1.0), min_size=3, max_size=12),
    point=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
)
def test_polygons_hold_what_they_go_round(radii: list[float], point: tuple[float, float]) -> None:
    """Star-shaped polygons, against the winding number."""
    angles = [2.0 * math.pi * i / len(radii) for i in range(len(radii))]
    corners = [(r * math.cos(a), r * math.sin(a)) for r, a in zip(radii, angles, strict=True)]
    assume(min(edge_distance(corners, point)) > 1e-6)
    turns = abs(winding(corners, point))
    assert Polygon(tuple(corners), inclusion=True).contains(*point) == (turns > 0.5)


@given(bearing=st.floats(0.0, 2.0 * math.pi), radius=st.floats(1.0, 5000.0))
def test_circles_hold_what_is_nearer_than_their_radius(bearing: float, radius: float) -> None:
    round_ = Circle((ORIGIN.latitude_deg, ORIGIN.longitude_deg), radius, inclusion=True)
    for share, inside in ((0.99, True), (1.01, False)):
        north, east = share * radius * math.cos(bearing), share * radius * math.sin(bearing)
        where = place(north, east)
        assert round_.contains(where.latitude_deg, where.longitude_deg) is inside


def test_a_stored_fence() -> None:
    items = [
        *polygon(SQUARE),
        at(0, 0, 0, N.FENCE_RETURN_POINT),
        *polygon([(5, 5), (15, 5), (10, 15)], inclusion=False),
        circle(0, 0, 40),
        circle(-20, 0, 5, inclusion=False),
        at(0, 0, 0, N.WAYPOINT),
    ]
    fence = list(areas(items))
    assert [type(area).__name__ for area in fence] == ["Polygon", "Polygon", "Circle", "Circle"]
    allowed = {(0, 0): True, (29, 0): True, (31, 0): False, (10, 8): False, (-20, 3): False}
    assert {p: all_allow(fence, place(*p)) for p in allowed} == allowed
    # In the square, but beyond the circle.
    assert not all_allow(fence, place(29, 29))


class Watch:
    """A monitor and a vehicle that is moved by hand."""

    def __init__(self, *items: PlanItem, landed: bool = False, **parameters: float) -> None:
        self.values = {**DEFAULTS, **parameters}
        self.plans, self.texts = Plans(), list[str]()
        self.monitor = FenceMonitor(self.plans, self.values.__getitem__, self._say)
        self.now = NavigationState(0, (0.0, 0.0, -10.0), 0.0, landed, ORIGIN, ORIGIN)
        if items:
            self.plans.store(MissionType.FENCE, items, 1)

    def _say(self, message: OperatorText) -> None:
        self.texts.append(message.text)

    def at(
        self, north: float, east: float, up: float = 10.0, mode: Mode = Mode.OFFBOARD
    ) -> tuple[bool, bool, bool]:
        self.now = self.now._replace(time_us=self.now.time_us + FENCE_PERIOD_US)
        self.monitor.step(self.now, mode, lambda: place(north, east, up))
        return self.monitor.status.breached


def test_each_limit_is_told_apart() -> None:
    watch = Watch(*polygon(SQUARE), GF_MAX_HOR_DIST=25.0, GF_MAX_VER_DIST=20.0, GF_ACTION=1)
    assert watch.at(0, 0) == (False, False, False)
    assert watch.at(26, 0) == (True, False, False)
    assert watch.at(31, 0) == (True, False, True)
    assert watch.at(0, 0, 21) == (False, True, False)
    assert watch.at(0, 0) == (False, False, False)
    assert watch.monitor.status.breaches == 1


def test_it_is_checked_every_fifth_of_a_second() -> None:
    watch = Watch(*polygon(SQUARE), GF_ACTION=1)
    watch.at(0, 0)
    asked = []
    for step in range(1, 11):
        now = watch.now._replace(time_us=watch.now.time_us + step * 50_000)
        watch.monitor.step(now, Mode.OFFBOARD, lambda: asked.append(1) or place(0, 0))  # type: ignore[func-returns-value]
    assert len(asked) == 2


@pytest.mark.parametrize("action", [0, 1])
def test_without_action_nothing_is_a_breach(action: int) -> None:
    watch = Watch(*polygon(SQUARE), GF_ACTION=action)
    watch.at(0, 0)
    assert any(watch.at(50, 0)) is bool(action)


def test_a_breach_that_made_it_hold_lasts_as_long_as_it_holds() -> None:
    watch = Watch(*polygon(SQUARE), GF_ACTION=2)
    watch.at(0, 0)
    assert any(watch.at(31, 0))
    for _ in range(3):
        assert any(watch.at(29, 0, mode=Mode.HOLD))
    assert not any(watch.at(29, 0, mode=Mode.OFFBOARD))
    assert not any(watch.at(29, 0, mode=Mode.OFFBOARD))


def test_areas_that_home_or_the_flying_vehicle_violates_are_left_out() -> None:
    watch = Watch(circle(100, 0, 20), circle(0, 0, 30), GF_ACTION=2)
    watch.at(0, 0)
    assert watch.texts == ["Geofence invalid, doesn't contain Home position"]
    assert not any(watch.at(29, 0))
    assert any(watch.at(31, 0))
    watch = Watch(circle(0, 0, 30), GF_ACTION=2)
    watch.at(40, 0)
    assert watch.texts == ["Geofence invalid, doesn't contain current vehicle position"]
    assert not any(watch.at(45, 0))
    assert not Watch(circle(0, 0, 30), GF_ACTION=2, landed=True).texts


def test_missions_are_checked_against_it() -> None:
    watch = Watch(*polygon(SQUARE), GF_MAX_VER_DIST=20.0)
    watch.at(0, 0)
    allowed = [
        watch.monitor.inside(place(*p), ORIGIN) for p in ((0, 0, 10), (31, 0, 10), (0, 0, 25))
    ]
    assert allowed == [True, False, False]


# --- GF_PREDICT


@pytest.mark.parametrize(
    ("speed", "limit", "most", "jerk", "expected"),
    [
        (0.0, 3.0, 0.0, 4.0, 0.0),
        # Without acceleration and with hardly limited jerk: v²/2a, and a fifth of a second more.
        (6.0, 3.0, 0.0, 1e6, 6.0 + 1.2),
        # From 3 m/s² down to -3: the speed first rises by a²/2j, then it falls.
        (6.0, 3.0, 3.0, 1e6, 6.0 + 1.2),
    ],
)
def test_how_far_a_vehicle_flies_until_it_stands(
    speed: float, limit: float, most: float, jerk: float, expected: float
) -> None:
    assert braking_distance(speed, limit, most, jerk) == pytest.approx(expected, abs=1e-3)


@settings(max_examples=15)
@given(speed=st.floats(0.0, 15.0), limit=st.floats(2.0, 10.0), jerk=st.floats(1.0, 40.0))
def test_braking_against_small_steps(speed: float, limit: float, jerk: float) -> None:
    """Bang-bang jerk, integrated: at full jerk until the limit, and back when it is time."""
    at_m, v, a, dt = 0.0, speed, limit, 2e-3
    while v > 0.0 or a > 0.0:
        turn_back = v <= 0.5 * a * a / jerk and a < 0.0
        a = min(0.0, a + jerk * dt) if turn_back else max(-limit, a - jerk * dt)
        if a == 0.0 and turn_back:
            break
        v += a * dt
        at_m += v * dt
    wanted = at_m + 0.2 * speed
    assert braking_distance(speed, limit, limit, jerk) == pytest.approx(wanted, rel=0.02, abs=0.1)


@pytest.mark.parametrize(("predict", "breached"), [(0, False), (1, True)])
def test_a_breach_begins_where_braking_would_end(predict: int, breached: bool) -> None:
    watch = Watch(*polygon(SQUARE), GF_ACTION=1, GF_PREDICT=predict, GF_MAX_VER_DIST=20.0)
    watch.now = watch.now._replace(velocity=(3.0, 0.0, 0.0))
    assert watch.at(0, 0) == (False, False, False)
    assert watch.at(15, 0) == (False, False, breached)
    assert watch.at(-15, 0) == (False, False, False)  # it flies away from that side
    watch.now = watch.now._replace(velocity=(0.0, 0.0, -3.0))
    assert watch.at(0, 0, 17) == (False, breached, False)
    watch.now = watch.now._replace(velocity=(0.0, 0.0, 3.0))
    assert watch.at(0, 0, 17) == (False, False, False)


@pytest.mark.parametrize("predict", [pytest.param(0, marks=pytest.mark.nightly), 1])
def test_a_vehicle_that_looks_ahead_stays_inside(predict: int) -> None:
    limits = {"GF_MAX_HOR_DIST": 40.0, "GF_ACTION": 2, "GF_PREDICT": predict}
    rig = Rig(seed=2, parameters=limits)
    rig.take_off(5.0)
    rig.go_offboard(velocity_setpoint(6.0, 0.0, 0.0))
    farthest_m = [0.0]
    rig.run(
        10.0, lambda: farthest_m.__setitem__(0, max(farthest_m[0], float(rig.truth.position[0])))
    )
    assert rig.mode is Mode.HOLD
    assert (farthest_m[0] < 40.0) is bool(predict)


def test_no_place_outside_is_taken_to_hold_at() -> None:
    """PX4: the vehicle holds and reports why; a fence that only warns has no effect."""
    limits = {"GF_MAX_HOR_DIST": 20.0, "GF_MAX_VER_DIST": 15.0, "GF_ACTION": 3}
    rig = Rig(seed=2, parameters=limits)
    outside = Reposition(PositionYaw((40.0, 0.0, -5.0), math.nan))
    nowhere = PositionYaw((math.nan, math.nan, -40.0), math.nan)
    assert rig.ap.set_mode(Mode.HOLD, outside) is Result.ACCEPTED  # disarmed it means nothing
    rig.take_off(5.0)
    assert math.isnan(rig.said("outside geofence"))
    for request, text in (
        (outside, "Reposition is outside geofence"),
        (Reposition(nowhere, altitude_alone=True), "Altitude change is outside geofence"),
    ):
        assert rig.ap.set_mode(Mode.HOLD, request) is Result.ACCEPTED
        assert rig.said(text) == pytest.approx(rig.time_s, abs=0.1)
        rig.run(2.0)
        assert np.linalg.norm(rig.truth.position[:2]) < 0.5
        assert rig.height == pytest.approx(5.0, abs=0.5)
    rig.ap.set_mode(Mode.HOLD, Reposition(PositionYaw((10.0, 0.0, -5.0), math.nan)))
    rig.run(2.0)
    assert rig.truth.position[0] > 1.0
    rig.ap.parameters.set("GF_ACTION", 1)
    said_s = rig.said("Reposition is outside")
    rig.ap.set_mode(Mode.HOLD, outside)
    assert rig.said("Reposition is outside") == said_s
    rig.close()


# --- rally points

LAND = at(0, 90, 0, N.LAND)


@pytest.mark.parametrize(
    ("kind", "here", "expected"),
    [
        (0, (10, 0), (0, 0)),
        (0, (60, 0), (100, 0)),
        (0, (49.5, 0), (0, 0)),  # not nearer by 2 m
        (1, (30, 0), (100, 0)),
        (1, (0, 80), (0, 90)),
        (3, (0, 80), (0, 90)),
        (3, (0, 10), (0, 0)),
        (0, (0, 80), (0, 0)),  # RTL_TYPE 0 ignores the mission's landing
    ],
)
def test_return_goes_to_the_nearest_place(
    kind: int, here: tuple[float, float], expected: tuple[float, float]
) -> None:
    plans = Plans()
    plans.store(MissionType.MISSION, (at(20, 0, 10), LAND), 1)
    rally = (at(4, 0, 0, N.RALLY_POINT), at(100, 0, 3, N.RALLY_POINT))  # the first is home's
    plans.store(MissionType.RALLY, rally, 1)
    found = destination(plans, ORIGIN, place(*here, 20.0), kind)
    wanted = place(*expected)
    assert found.place[:2] == pytest.approx(wanted[:2], abs=1e-9)
    assert found.by_landing is (expected == (0, 90))
    ground = ORIGIN.altitude_m + (3.0 if expected == (100, 0) else 0.0)
    assert found.place.altitude_m == pytest.approx(ground)


def test_return_goes_home_where_there_is_nothing_else() -> None:
    for kind in (0, 1, 3, 9):
        found = destination(Plans(), ORIGIN, Geodetic(47.0, 8.0, 500.0), kind)
        assert found == (ORIGIN, False)
    plans = Plans()
    plans.store(MissionType.MISSION, (LAND,), 1)
    invalid = destination(plans, ORIGIN, place(0, 80), 1, valid=False)
    assert invalid == (ORIGIN, False)
