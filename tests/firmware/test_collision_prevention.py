"""Collision prevention, by the cases of PX4's own CollisionPreventionTest, and in flight."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.constants import US_PER_S
from firmware_sim.addons.extra_modes.collision_prevention import (
    BINS,
    UNKNOWN_CM,
    CollisionPrevention,
    ObstacleMap,
)
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import ObstacleBins, Source, Sticks
from firmware_sim.autopilot.parameter_store import Parameters
from tests.support import mavlink_clients
from tests.support.flight_rig import Rig

BEGAN_US = 10 * US_PER_S


def obstacles(
    distance_cm: Callable[[int], int],
    *,
    increment_deg: float = 5.0,
    offset_deg: float = 0.0,
    in_world: bool = True,
    farthest_cm: int = 2000,
    time_us: int = BEGAN_US,
) -> ObstacleBins:
    distances = tuple(distance_cm(i) for i in range(BINS))
    return ObstacleBins(distances, increment_deg, offset_deg, 100, farthest_cm, in_world, time_us)


def prevention(**parameters: float) -> CollisionPrevention:
    store = Parameters()
    for name, value in parameters.items():
        store.set(name, value)
    return CollisionPrevention(store.value)


def turned(degrees: float, length: float = 10.0) -> tuple[float, float]:
    return length * math.cos(math.radians(degrees)), length * math.sin(math.radians(degrees))


def filled(found: ObstacleMap) -> set[int]:
    return set(np.flatnonzero(found.distances_cm < UNKNOWN_CM).tolist())


@pytest.mark.parametrize(
    ("yaw_deg", "first"), [(0.0, 2), (90.0, 2 + 72 - 18), (-45.0, 2 + 9), (180.0, 2 + 36)]
)
def test_directions_of_the_world_are_turned_into_the_body(yaw_deg: float, first: int) -> None:
    seen = ObstacleMap()
    seen.take(obstacles(lambda i: 500 if 2 <= i <= 6 else UNKNOWN_CM), math.radians(yaw_deg))
    assert filled(seen) == {(first + i) % BINS for i in range(5)}
    assert set(seen.distances_cm[list(filled(seen))]) == {500.0}


@pytest.mark.parametrize(
    ("offset_deg", "expected"),
    [
        (0.0, set(range(9))),
        (30.5, set(range(6, 15))),
        (-30.5, {*range(65, 72), *range(3)}),
    ],
)
def test_bins_of_another_width_and_offset(offset_deg: float, expected: set[int]) -> None:
    seen = ObstacleMap()
    told = obstacles(
        lambda i: 500 if i <= 6 else UNKNOWN_CM,
        increment_deg=6.0,
        offset_deg=offset_deg,
        in_world=False,
    )
    seen.take(told, 1.0)
    assert filled(seen) == expected


def test_of_two_sensors_the_one_with_the_shorter_range_counts_where_it_sees_something() -> None:
    seen = ObstacleMap()
    seen.take(obstacles(lambda _: 800, farthest_cm=2000), 0.0)
    seen.take(obstacles(lambda _: 300, farthest_cm=1000), 0.0)
    assert set(seen.distances_cm) == {300.0}
    seen.take(obstacles(lambda _: 900, farthest_cm=2000), 0.0)
    assert set(seen.distances_cm) == {300.0}
    # Out of range again by its own word; then any range is believed.
    seen.take(obstacles(lambda _: 1001, farthest_cm=1000), 0.0)
    seen.take(obstacles(lambda _: 900, farthest_cm=2000), 0.0)
    assert set(seen.distances_cm) == {900.0}


def test_it_pushes_away_from_what_is_too_near() -> None:
    cp = prevention(CP_DIST=10.0, CP_GUIDE_ANG=0.0)
    near = obstacles(lambda i: 101 if i < 10 else 10_001, farthest_cm=10_000)
    for asked in ((10.0, 0.0), (-10.0, 0.0)):
        north, east = cp.constrain(asked, (2.0, 0.0), near, 0.0, BEGAN_US)
        assert north < 0.0
        assert abs(east) < 1e-6


def test_equal_room_everywhere_changes_no_direction() -> None:
    cp = prevention(CP_DIST=2.0)
    north, east = cp.constrain((10.0, 0.0), (2.0, 0.0), obstacles(lambda _: 700), 0.0, BEGAN_US)
    assert north > 0.0
    assert east == pytest.approx(0.0, abs=1e-9)


def test_nothing_is_flown_to_outside_the_field_of_view() -> None:
    cp = prevention(CP_DIST=5.0)
    view = obstacles(lambda i: 700 if 45 < 5 * i < 225 else UNKNOWN_CM)
    moved = 0
    for i in range(BINS):
        north, east = cp.constrain(turned(5.0 * i), (2.0, 0.0), view, 0.0, BEGAN_US)
        if math.hypot(north, east) > 1e-9:
            moved += 1
            assert 45.0 <= math.degrees(math.atan2(east, north)) % 360.0 <= 225.0
    assert moved > 20


def test_without_data_it_stands_still_unless_it_may_go_where_none_ever_were() -> None:
    cp = prevention(CP_DIST=2.0, CP_GO_NO_DATA=1)
    asked = (-5.0, 0.0)
    assert cp.constrain(asked, (2.0, 0.0), None, 0.0, BEGAN_US) == (0.0, 0.0)
    view = obstacles(lambda i: 1000 if 0 < 5 * i < 40 else UNKNOWN_CM)
    allowed = cp.constrain(asked, (2.0, 0.0), view, 0.0, BEGAN_US)
    assert math.hypot(*allowed) == pytest.approx(5.0)
    careful = prevention(CP_DIST=2.0)
    assert careful.constrain(asked, (2.0, 0.0), view, 0.0, BEGAN_US) == (0.0, 0.0)
    # Directions that lost their data are blocked.
    lost = obstacles(lambda i: 1000 if i == 30 else UNKNOWN_CM, time_us=BEGAN_US + US_PER_S)
    gone = cp.constrain(turned(20.0), (0.0, 0.0), lost, 0.0, BEGAN_US + US_PER_S)
    assert gone == (0.0, 0.0)


def test_less_jerk_allowed_brakes_earlier() -> None:
    near = obstacles(lambda _: 700)
    usual = prevention(CP_DIST=5.0)
    slow = prevention(CP_DIST=5.0, MPC_JERK_MAX=0.5)
    asked = (10.0, 0.0), (2.0, 0.0)
    firm = usual.constrain(*asked, near, 0.0, BEGAN_US)[0]
    assert slow.constrain(*asked, near, 0.0, BEGAN_US)[0] < firm


def test_stale_data_are_forgotten_and_the_mode_given_up() -> None:
    cp = prevention(CP_DIST=1.0)
    far = obstacles(lambda _: 9000, farthest_cm=10_000)
    for tenth in range(80):
        now_us = BEGAN_US + tenth * US_PER_S // 10
        flown = math.hypot(*cp.constrain((10.0, 0.0), (2.0, 0.0), far, 0.0, now_us))
        assert flown == pytest.approx(10.0 if tenth < 5 else 0.0)
        assert cp.gives_up is (tenth > 50)
    cp.rest()
    assert not cp.gives_up


# --- by MAVLink, and in flight


def message(frame: int = dialect.MAV_FRAME_BODY_FRD, **changes: float) -> object:
    distances = [100 + i for i in range(BINS)]
    fields = {"increment_f": 2.5, "angle_offset": -90.0, **changes}
    return dialect.MAVLink_obstacle_distance_message(
        7, dialect.MAV_DISTANCE_SENSOR_UNKNOWN, distances, 5, 20, 900, frame=frame, **fields
    )


def test_obstacle_distance_is_read() -> None:
    rig = mavlink_clients.Rig()
    now_us = rig.autopilot.time_us
    for sent in (
        message(),
        message(dialect.MAV_FRAME_LOCAL_NED, increment_f=0.0),
        message(dialect.MAV_FRAME_LOCAL_ENU),
        message(angle_offset=math.nan),
    ):
        rig.client.send(sent)
    rig.bench.tick()
    body, world = rig.autopilot.obstacles
    distances = tuple(range(100, 172))
    assert body == ObstacleBins(distances, 2.5, -90.0, 20, 900, False, now_us)
    assert world == ObstacleBins(distances, 5.0, -90.0, 20, 900, True, now_us)
    assert rig.client.received("STATUSTEXT") == []


class Wall:
    """A wall to the north, as a companion computer with a wide camera reports it at 20 Hz."""

    def __init__(self, rig: Rig, north_m: float) -> None:
        self.rig, self.north_m, self.told = rig, north_m, True
        self.nearest_m = math.inf
        self._next_us = 0

    def each(self) -> None:
        """Move the stick forward, and report."""
        rig, now_us = self.rig, self.rig.sim.time_us
        rig.ap.manual_control(Sticks(0.0, 1.0, 0.0, 0.0), Source.JOYSTICK, now_us)
        left_m = self.north_m - float(rig.truth.position[0])
        self.nearest_m = min(self.nearest_m, left_m)
        if self.told and now_us >= self._next_us:
            self._next_us = now_us + US_PER_S // 20
            ahead = [
                min(2001, round(100 * max(0.2, left_m) / math.cos(math.radians(5 * i))))
                if math.cos(math.radians(5 * i)) > 0.05
                else 2001
                for i in range(BINS)
            ]
            rig.ap.see_obstacles(ObstacleBins(tuple(ahead), 5.0, 0.0, 20, 2000, True, now_us))


def towards_a_wall(**parameters: float) -> Wall:
    rig = Rig(3, parameters={"COM_RC_IN_MODE": 1.0, **parameters})
    rig.take_off(4.0)
    wall = Wall(rig, 25.0)
    rig.ap.manual_control(Sticks(0.0, 0.0, 0.0, 0.0), Source.JOYSTICK, rig.sim.time_us)
    assert rig.ap.set_mode(Mode.POSITION) is Result.ACCEPTED
    return wall


@pytest.mark.slow
def test_a_full_stick_stops_before_a_wall() -> None:
    free = towards_a_wall()
    free.rig.run(8.0, free.each)
    assert free.nearest_m < 0.0
    kept = towards_a_wall(CP_DIST=3.0)
    kept.rig.run(20.0, kept.each)
    assert 2.5 < kept.nearest_m < 5.0
    assert kept.rig.mode is Mode.POSITION
    assert abs(float(kept.rig.truth.velocity[0])) < 0.2
    # Without obstacle data the vehicle stops, and after 5 s it switches to Hold.
    kept.told = False
    kept.rig.run(4.0, kept.each)
    modes = [kept.rig.mode]
    kept.rig.run(2.5, kept.each)
    assert [*modes, kept.rig.mode] == [Mode.POSITION, Mode.HOLD]
    assert kept.nearest_m > 2.5
