"""PX4's multicopter tests (test/mavsdk_tests), for a PX4 or the built-in flight controller.

    airl-firmware --arena open-field &
    python scripts/px4_mavsdk_tests.py --test "Takeoff and Land"
    python scripts/px4_mavsdk_tests.py --list

Scenarios, limits and timeouts are PX4's; places are scaled to a field of 200 x 200 m. A test starts
on the ground, and needs a vehicle that has just booted. Exit status 1 if a test failed.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.action import Action
from mavsdk.plugins.failure import Failure, FailureType, FailureUnit
from mavsdk.plugins.follow_me import Config, FollowMe, TargetLocation
from mavsdk.plugins.geofence import FenceType, Geofence, GeofenceData, Point, Polygon
from mavsdk.plugins.manual_control import ManualControl
from mavsdk.plugins.mission import Mission, MissionPlan
from mavsdk.plugins.mission_raw import MissionItem as RawItem
from mavsdk.plugins.mission_raw import MissionRaw
from mavsdk.plugins.offboard import (
    Attitude,
    Offboard,
    OffboardError,
    PositionNedYaw,
    VelocityNedYaw,
)
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import FlightMode, LandedState

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.support.mavlink_clients import Companion
from tests.support.mavsdk_items import waypoint
from tests.support.px4_walk.vehicle import RefusedError, Vehicle

NAN = math.nan
Place = tuple[float, float]
"""Metres north and east of the local origin."""

LEG_M, HEIGHT_M = 20.0, 10.0
"""Length of a mission's leg and its height above home."""
DISARM_S = 180.0
"""Maximum time until the vehicle has landed and disarmed [s]."""
SQUARE: tuple[Place, ...] = ((LEG_M, 0.0), (LEG_M, LEG_M), (0.0, LEG_M))
CORRIDOR_M = 5.0
"""Maximum distance from the line between two waypoints."""


@dataclass(frozen=True)
class Px4Test:
    """Test of a flight."""

    name: str
    fly: Callable[[Vehicle], None]
    since: tuple[int, int] = (0, 0)
    """First release with the tested behaviour: major, minor."""
    own: bool = False
    """True if PX4 has no such test."""


TESTS: list[Px4Test] = []


def test(name: str, **options: Any) -> Callable[[Callable[[Vehicle], None]], Any]:
    """Add a test to `TESTS`."""

    def add(fly: Callable[[Vehicle], None]) -> Callable[[Vehicle], None]:
        TESTS.append(Px4Test(name, fly, **options))
        return fly

    return add


# --- steps of a test


def check(condition: object, finding: str) -> None:
    """Raise AssertionError with a finding unless a condition is true."""
    if not condition:
        raise AssertionError(finding)


def set_int(v: Vehicle, name: str, value: int) -> None:
    """Set an integer parameter."""
    v.plugin(Param).set_param_int(name, value)


def ready(v: Vehicle) -> None:
    """Wait until the vehicle is healthy and can be armed."""
    v.until(v.telemetry.health_all_ok, 30.0)
    v.until(lambda: v.telemetry.health().is_armable, 45.0)


def accepted(v: Vehicle, request: Callable[[], object], limit_s: float) -> None:
    """Repeat a denied request until it is accepted."""

    def made() -> bool:
        with suppress(MavsdkError):
            request()
            return True
        return False

    v.until(made, limit_s)


def arm(v: Vehicle) -> None:
    """Arm; a denial is repeated for 30 s."""
    accepted(v, lambda: v.plugin(Action).arm(), 30.0)


def hovering(v: Vehicle) -> None:
    """Wait until the vehicle reports that it is in the air."""
    v.until(lambda: v.telemetry.landed_state() == LandedState.IN_AIR, 45.0)


def at_height(v: Vehicle, height_m: float, limit_s: float, within_m: float) -> None:
    """Wait for a height above the local origin."""
    v.until(lambda: abs(height_m + v.position[2]) <= within_m, limit_s)


def disarmed(v: Vehicle, limit_s: float = DISARM_S) -> None:
    """Wait until the vehicle has disarmed."""
    v.until(lambda: not v.telemetry.armed(), limit_s)


def take_off(v: Vehicle, height_m: float | None = None) -> None:
    """Arm and take off, to PX4's default altitude or another."""
    if height_m is not None:
        v.plugin(Action).set_takeoff_altitude(height_m)
        found = v.plugin(Action).get_takeoff_altitude()
        check(math.isclose(found, height_m, rel_tol=1e-5), f"take-off altitude {found}")
        v.wait(1.0)
    arm(v)
    v.plugin(Action).takeoff()
    hovering(v)


def return_home(v: Vehicle) -> None:
    """Return, land and disarm."""
    v.plugin(Action).return_to_launch()
    disarmed(v)


def land(v: Vehicle, limit_s: float = DISARM_S) -> None:
    """Land and disarm."""
    v.plugin(Action).land()
    disarmed(v, limit_s)


def home_within(v: Vehicle, home: Place, radius_m: float) -> None:
    """Check the horizontal distance from a place."""
    off_m = math.dist(v.position[:2], home)
    check(off_m < radius_m, f"{off_m:.1f} m from home")


def upload(
    v: Vehicle, places: Sequence[Place], *, returns: bool, fly_through: bool = False
) -> None:
    """Upload a mission."""
    items = [waypoint(*v.place(*each), height_m=HEIGHT_M, speed_m_s=NAN) for each in places]
    for item in items:
        item.is_fly_through = fly_through
        item.acceptance_radius_m = NAN
    v.plugin(Mission).set_return_to_launch_after_mission(returns)
    v.plugin(Mission).upload_mission(MissionPlan(items))
    v.wait(1.0)  # PX4 checks a new mission first.


def start_mission(v: Vehicle) -> None:
    """Start the mission; a denial is repeated for 3 s."""
    accepted(v, lambda: v.plugin(Mission).start_mission(), 3.0)


def item_reached(v: Vehicle, item: int, limit_s: float = 60.0) -> None:
    """Wait until a mission item is the current one."""
    v.until(lambda: v.plugin(Mission).mission_progress().current >= item, limit_s)


def finished(v: Vehicle, limit_s: float, each: Callable[[], None] = lambda: None) -> None:
    """Wait for the end of the mission; call `each` in every loop."""

    def done() -> bool:
        each()
        return bool(v.plugin(Mission).is_mission_finished())

    v.until(done, limit_s)


def on_track(v: Vehicle, places: Sequence[Place]) -> None:
    """Check the distance from the leg to the current item; the leg to the first is free."""
    current = v.plugin(Mission).mission_progress().current
    if not 0 < current < len(places):
        return
    legs = list(pairwise(places))[max(0, current - 2) : current]
    off_m = min(_distance(v.position[:2], *leg) for leg in legs)
    check(off_m < CORRIDOR_M, f"{off_m:.1f} m from the mission's line to item {current}")


def _distance(place: Place, start: Place, end: Place) -> float:
    along = (end[0] - start[0], end[1] - start[1])
    size = along[0] ** 2 + along[1] ** 2
    share = (
        ((place[0] - start[0]) * along[0] + (place[1] - start[1]) * along[1]) / size
        if size
        else 0.0
    )
    share = min(max(share, 0.0), 1.0)
    return math.dist(place, (start[0] + share * along[0], start[1] + share * along[1]))


def inject(v: Vehicle, unit: FailureUnit, kind: FailureType) -> None:
    """Inject a failure."""
    v.plugin(Failure).inject(unit, kind, 0)


def offboard(v: Vehicle, set_setpoint: Callable[[Offboard], object]) -> None:
    """Set a setpoint and enter offboard; MAVSDK may forget a setpoint before the start."""
    plugin = v.plugin(Offboard)
    for attempt in range(10):
        set_setpoint(plugin)
        try:
            plugin.start()
            return
        except OffboardError:
            if attempt == 9:
                raise
            time.sleep(0.02)


def go_to(v: Vehicle, target: PositionNedYaw, limit_s: float) -> None:
    """Fly to a position setpoint; it is reached within 0.3 m."""
    offboard(v, lambda plugin: plugin.set_position_ned(target))
    place = (target.north_m, target.east_m, target.down_m)
    v.until(lambda: math.dist(v.position, place) < 0.3, limit_s)


def sticks(v: Vehicle, seconds: float, x: float = 0.0, z: float = 0.5) -> None:
    """Hold the sticks: `x` forward, `z` thrust."""
    v.wait(seconds, lambda: v.plugin(ManualControl).set_manual_control_input(x, 0.0, z, 0.0))


def fence(v: Vehicle, corners: Sequence[Place], kind: FenceType) -> None:
    """Upload a geofence of one polygon."""
    polygon = Polygon([Point(*v.place(*corner)) for corner in corners], kind)
    v.plugin(Geofence).upload_geofence(GeofenceData([polygon], []))


# --- basics and missions


@test("Takeoff and hold position")
def takeoff_and_hold(v: Vehicle) -> None:
    """Hold the altitude within 0.2 m for 15 s."""
    ready(v)
    ground_m = -v.position[2]
    take_off(v, HEIGHT_M)
    at_height(v, ground_m + HEIGHT_M, 15.0, 0.1)
    v.wait(5.0)
    held_m, worst_m = v.position[2], [0.0]
    v.wait(15.0, lambda: worst_m.append(abs(v.position[2] - held_m)))
    check(max(worst_m) <= 0.2, f"altitude off by {max(worst_m):.2f} m")
    land(v)


@test("Takeoff and Land")
def takeoff_and_land(v: Vehicle) -> None:
    """Take off, land, disarm."""
    ready(v)
    take_off(v)
    land(v)


@test("Fly square Multicopter Missions including RTL")
def square_with_return(v: Vehicle) -> None:
    """Fly a mission that ends with Return."""
    ready(v)
    upload(v, SQUARE, returns=True)
    arm(v)
    start_mission(v)
    finished(v, 500.0)
    disarmed(v)


@test("Fly square Multicopter Missions with manual RTL")
def square_then_return(v: Vehicle) -> None:
    """Fly a mission on its track, then return."""
    ready(v)
    upload(v, SQUARE, returns=False)
    arm(v)
    start_mission(v)
    finished(v, 500.0, lambda: on_track(v, SQUARE))
    hovering(v)
    return_home(v)


@test("Fly straight Multicopter Mission")
def straight(v: Vehicle) -> None:
    """Fly through the waypoints of a line faster than 4 m/s."""
    ready(v)
    places = [(step * LEG_M, 0.0) for step in range(5)]
    upload(v, places, returns=False, fly_through=True)
    slowest = [math.inf]

    def each() -> None:
        on_track(v, places)
        if v.plugin(Mission).mission_progress().current == 2:
            slowest.append(math.hypot(*v.velocity[:2]))

    arm(v)
    start_mission(v)
    finished(v, 500.0, each)
    # A stop at item 1, of the same place as the take-off, is left out.
    check(len(slowest) > 1 and min(slowest) > 4.0, f"{min(slowest):.1f} m/s on the way to item 2")
    hovering(v)
    return_home(v)


def _raw(v: Vehicle, sequence: int, command: int, place: Place | None, **values: Any) -> RawItem:
    latitude, longitude = v.place(*place) if place is not None else (0.0, 0.0)
    fields = {"param1": 0.0, "param2": 0.0, "param3": 0.0, "param4": 0.0, "z": 15.0, **values}
    return RawItem(
        seq=sequence,
        frame=2 if place is None else 3,
        command=command,
        current=int(sequence == 0),
        autocontinue=1,
        x=round(latitude * 1e7),
        y=round(longitude * 1e7),
        mission_type=0,
        **fields,
    )


@test("Fly Multicopter Mission with external set-current onto a DO_JUMP item", since=(1, 18))
def jump(v: Vehicle) -> None:
    """Select a DO_JUMP as the current item: the mission continues to its landing."""
    ready(v)
    leg, jump_item = 50.0, 3
    items = [
        _raw(v, 0, 22, (0.0, 0.0)),
        _raw(v, 1, 16, (leg, 0.0)),
        _raw(v, 2, 16, (leg, leg)),
        _raw(v, jump_item, 177, None, param1=1.0, param2=1.0, z=0.0),
        _raw(v, 4, 16, (0.0, leg)),
        _raw(v, 5, 21, (0.0, 0.0), z=0.0),
    ]
    v.plugin(MissionRaw).upload_mission(items)
    v.wait(1.0)
    arm(v)
    start_mission(v)
    v.until(lambda: v.plugin(MissionRaw).mission_progress().current >= 2, 120.0)
    v.send("MISSION_SET_CURRENT", seq=jump_item)
    disarmed(v, 240.0)


@test("RTL direct with geofence obstruction", since=(1, 19))
def return_around_a_fence(v: Vehicle) -> None:
    """Return around an exclusion polygon on the straight way home."""
    ready(v)
    home = v.position[:2]
    fence(v, [(40.0, -30.0), (40.0, 30.0), (70.0, 30.0), (70.0, -30.0)], FenceType.EXCLUSION)
    for name, value in (("GF_ACTION", 1), ("RTL_TYPE", 0), ("RTL_APPR_FORCE", 0)):
        set_int(v, name, value)
    places = [(0.0, 60.0), (110.0, 60.0), (110.0, 0.0), (125.0, 0.0)]
    upload(v, places, returns=False)
    v.wait(3.0)
    arm(v)
    start_mission(v)
    item_reached(v, 3, 120.0)
    v.plugin(Action).return_to_launch()
    inside: list[Place] = []

    def down() -> bool:
        north, east, _ = v.position
        if 40.0 < north < 70.0 and abs(east) < 30.0:
            inside.append((north, east))
        return not v.telemetry.armed()

    v.until(down, 400.0)
    check(not inside, f"inside the fence at {inside[:1]}")
    home_within(v, home, 5.0)


# --- offboard


def _offboard_ready(v: Vehicle) -> Place:
    ready(v)
    set_int(v, "COM_RCL_EXCEPT", 1 << 2)
    arm(v)
    return v.position[:2]


def _offboard_landing(v: Vehicle, home: Place) -> None:
    v.plugin(Offboard).stop()
    land(v, 120.0)
    home_within(v, home, 2.0)


@test("Offboard takeoff and land")
def offboard_takeoff(v: Vehicle) -> None:
    """Take off by a position setpoint."""
    home = _offboard_ready(v)
    go_to(v, PositionNedYaw(0.0, 0.0, -2.0, 0.0), 90.0)
    _offboard_landing(v, home)


@test("Offboard position control")
def offboard_position(v: Vehicle) -> None:
    """Reach positions within 0.3 m and 10 s each."""
    home = _offboard_ready(v)
    start = (0.0, 0.0, -2.0, 0.0)
    places = ((0.0, 5.0, -2.0, 180.0), (5.0, 5.0, -4.0, 180.0), (5.0, 0.0, -4.0, 90.0))
    for place in (start, *places, start):
        go_to(v, PositionNedYaw(*place), 10.0)
    _offboard_landing(v, home)


@test("Offboard attitude control")
def offboard_attitude(v: Vehicle) -> None:
    """Climb and fly forward by attitude and thrust; the attitude is within 5 deg."""
    set_int(v, "COM_RCL_EXCEPT", 1 << 2)
    v.until(lambda: v.telemetry.raw_gps().altitude_ellipsoid_m > 0.0, 20.0)
    offboard(v, lambda plugin: plugin.set_attitude(Attitude(0.0, 0.0, 0.0, 0.0)))
    v.until(lambda: v.telemetry.health().is_armable, 20.0)
    arm(v)
    begun_m = v.position[2]

    def hold(pitch_deg: float, thrust: float) -> None:
        v.plugin(Offboard).set_attitude(Attitude(0.0, pitch_deg, 0.0, thrust))

    hold(0.0, 0.8)
    v.until(lambda: begun_m - v.position[2] > 10.0, 30.0)
    v.wait(3.0, lambda: hold(-20.0, 0.8))
    found = v.telemetry.attitude_euler()
    v.wait(6.0, lambda: hold(0.0, 0.4))
    hold(0.0, 0.0)
    disarmed(v, 120.0)
    finding = f"roll {found.roll_deg:.1f}, pitch {found.pitch_deg:.1f} deg"
    check(abs(found.roll_deg) < 5.0 and abs(found.pitch_deg + 20.0) < 5.0, finding)


@test("Offboard velocity control", own=True)
def offboard_velocity(v: Vehicle) -> None:
    """Fly 2 m/s north and east; the mean of 2 s is within 0.2 m/s."""
    home = _offboard_ready(v)
    go_to(v, PositionNedYaw(0.0, 0.0, -4.0, 0.0), 20.0)
    for north, east in ((2.0, 0.0), (0.0, 2.0), (-2.0, 0.0), (0.0, -2.0), (0.0, 0.0)):
        v.plugin(Offboard).set_velocity_ned(VelocityNedYaw(north, east, 0.0, 0.0))
        v.wait(3.0)
        begun, begun_s = v.position, v.now_s
        v.wait(2.0)
        end, seconds = v.position, v.now_s - begun_s
        found = ((end[0] - begun[0]) / seconds, (end[1] - begun[1]) / seconds)
        off = math.dist(found, (north, east))
        check(off < 0.2, f"{found[0]:.2f}, {found[1]:.2f} m/s, not {north:g}, {east:g}")
    return_home(v)
    home_within(v, home, 2.0)


@test("Offboard lost", own=True)
def offboard_lost(v: Vehicle) -> None:
    """Leave offboard within 2 s of the last setpoint; end on the ground."""
    ready(v)
    take_off(v, HEIGHT_M)
    at_height(v, HEIGHT_M, 30.0, 1.0)

    def send() -> None:
        zeros = dict.fromkeys(("x", "y", "z", "vy", "vz", "afx", "afy", "afz", "yaw_rate"), 0.0)
        v.send(
            "SET_POSITION_TARGET_LOCAL_NED",
            **{"time_boot_ms": 0, "coordinate_frame": 1, "type_mask": 0x9C7, **zeros},
            vx=1.0,
            yaw=0.0,
        )

    v.wait(1.0, send)
    # DO_SET_MODE: custom mode 6, offboard; 129 = custom mode and armed.
    result = v.command(176, 129.0, 6.0)
    check(result == "ACCEPTED", f"offboard: {result}")
    v.wait(2.0, send)
    check(v.mode == FlightMode.OFFBOARD, f"mode {v.mode.name}")
    v.until(lambda: v.mode != FlightMode.OFFBOARD, 2.5)
    disarmed(v)


# --- manual control


def _manual(v: Vehicle, mode: Callable[[ManualControl], object]) -> None:
    sticks(v, 1.0)
    mode(v.plugin(ManualControl))
    sticks(v, 1.0)
    home = v.position[:2]

    def armable() -> bool:
        sticks(v, 0.1)
        return bool(v.telemetry.health_all_ok() and v.telemetry.health().is_armable)

    v.until(armable, 75.0)
    arm(v)
    sticks(v, 5.0, z=1.0)
    sticks(v, 10.0, x=0.5)

    def down() -> bool:
        sticks(v, 0.2, z=0.0)
        return not v.telemetry.in_air()

    v.until(down, 60.0)
    disarmed(v)
    away_m = math.dist(v.position[:2], home)
    check(away_m > 5.0, f"only {away_m:.1f} m from home")


@test("Fly forward in position control")
def position_control(v: Vehicle) -> None:
    """Fly by the sticks in Position mode."""
    _manual(v, lambda plugin: plugin.start_position_control())


@test("Fly forward in altitude control")
def altitude_control(v: Vehicle) -> None:
    """Fly by the sticks in Altitude mode."""
    _manual(v, lambda plugin: plugin.start_altitude_control())


@test("Manual control lost", own=True)
def manual_control_lost(v: Vehicle) -> None:
    """Return when the sticks fall silent in Position mode (NAV_RCL_ACT, COM_FAIL_ACT_T)."""
    ready(v)
    take_off(v, HEIGHT_M)
    sticks(v, 1.0)
    v.plugin(ManualControl).start_position_control()
    sticks(v, 3.0)
    check(v.mode == FlightMode.POSCTL, f"mode {v.mode.name}")
    v.until(lambda: v.mode == FlightMode.RETURN_TO_LAUNCH, 10.0)
    disarmed(v)


# --- failsafes


BARO, GPS = 0, 1
"""EKF2_HGT_REF."""


def _failing_mission(v: Vehicle, unit: str, kind: str, height: int | None, end_s: float) -> None:
    """Fly the square; a sensor fails before its second corner."""
    if height is not None:
        set_int(v, "EKF2_HGT_REF", height)
    ready(v)
    upload(v, SQUARE, returns=True)
    arm(v)
    set_int(v, "SYS_FAILURE_EN", 1)
    start_mission(v)
    item_reached(v, 1)
    inject(v, FailureUnit[unit], FailureType[kind])
    if unit != "SENSOR_GPS":
        finished(v, 90.0)
    disarmed(v, end_s)


FAILURES: tuple[tuple[str, str, str, int | None, float], ...] = (
    ("Land on GPS lost during mission (baro height mode)", "SENSOR_GPS", "OFF", BARO, 300.0),
    ("Land on GPS lost during mission (GPS height mode)", "SENSOR_GPS", "OFF", GPS, DISARM_S),
    ("Continue on mag lost during mission", "SENSOR_MAG", "OFF", None, DISARM_S),
    ("Continue on baro lost during mission (baro height mode)", "SENSOR_BARO", "OFF", BARO, 180.0),
    ("Continue on baro lost during mission (GPS height mode)", "SENSOR_BARO", "OFF", GPS, 180.0),
    ("Continue on baro stuck during mission (baro height mode)", "SENSOR_BARO", "STUCK", 0, 180.0),
    ("Continue on baro stuck during mission (GPS height mode)", "SENSOR_BARO", "STUCK", 1, 180.0),
)
"""Name, unit, failure, EKF2_HGT_REF, and maximum time to disarm [s]."""

for _name, _unit, _kind, _height, _end_s in FAILURES:
    _fly = functools.partial(_failing_mission, unit=_unit, kind=_kind, height=_height, end_s=_end_s)
    TESTS.append(Px4Test(_name, _fly))


@test("Failure Injection - Reject mid-air when it is disabled")
def failures_disabled(v: Vehicle) -> None:
    """Refuse a failure while SYS_FAILURE_EN is 0."""
    ready(v)
    set_int(v, "SYS_FAILURE_EN", 0)
    take_off(v)
    try:
        v.plugin(Failure).inject(FailureUnit.SYSTEM_MOTOR, FailureType.OFF, 1)
        answer = "SUCCESS"
    except MavsdkError as error:
        answer = str(error)
    check("DISABLED" in answer or "DENIED" in answer, f"answered {answer}")
    return_home(v)


@test("Geofence breach returns", own=True)
def fence_breached(v: Vehicle) -> None:
    """Return from the edge of an inclusion polygon (GF_ACTION 3)."""
    ready(v)
    fence(v, [(-30.0, -30.0), (-30.0, 30.0), (30.0, 30.0), (30.0, -30.0)], FenceType.INCLUSION)
    set_int(v, "GF_ACTION", 3)
    take_off(v, HEIGHT_M)
    at_height(v, HEIGHT_M, 30.0, 1.0)
    offboard(v, lambda plugin: plugin.set_velocity_ned(VelocityNedYaw(4.0, 0.0, 0.0, 0.0)))
    v.until(lambda: v.mode == FlightMode.RETURN_TO_LAUNCH, 30.0)
    north_m = v.position[0]
    check(10.0 < north_m < 40.0, f"returns from {north_m:.1f} m north")
    disarmed(v)


# --- follow me


@contextmanager
def _following(v: Vehicle, config: Config) -> Iterator[FollowMe]:
    plugin = v.plugin(FollowMe)
    plugin.set_config(config)
    v.wait(1.0)
    plugin.start()
    v.wait(1.0)
    yield plugin
    plugin.stop()
    land(v, 300.0)


ANGLES: dict[int, float] = {5: 180.0, 20: 0.0, 35: 45.0, 55: -45.0}
"""Follow angle [deg] from an update of the target on."""
CHECKED = (range(15, 20), range(30, 35), range(45, 55), range(65, 75))
"""Updates after which the vehicle has to be in its place."""
FOLLOW_M, WITHIN_M = 8.0, 11.0


def _follow(v: Vehicle, *, with_velocity: bool) -> None:
    """Follow a target that moves north at 2 m/s, from four sides."""
    ready(v)
    take_off(v, HEIGHT_M)
    config = Config(10.0, FOLLOW_M, max_tangential_vel_m_s=15.0, follow_angle_deg=0.0)
    home_m = v.telemetry.home().absolute_altitude_m
    noise = np.random.default_rng(1)
    north, east, _ = v.position
    with _following(v, config) as plugin:
        for update in range(75):
            if update in ANGLES:
                config.follow_angle_deg = ANGLES[update]
                plugin.set_config(config)
            if update > 5:
                north += 1.0  # 2 m/s would leave the field
            if any(update in each for each in CHECKED):
                angle = math.radians(config.follow_angle_deg)
                off = v.position[0] - north, v.position[1] - east
                expected = FOLLOW_M * math.cos(angle), FOLLOW_M * math.sin(angle)
                check(abs(v.height - 10.0) < 1.5, f"height {v.height:.1f} m")
                apart = max(abs(a - b) for a, b in zip(off, expected, strict=True))
                check(apart < WITHIN_M, f"{apart:.1f} m from its place at update {update}")
            place = v.place(north + noise.normal(), east + noise.normal())
            velocity = (1.0 if update > 5 else 0.0, 0.0, 0.0) if with_velocity else (NAN,) * 3
            plugin.set_target_location(TargetLocation(*place, home_m, *velocity))
            v.wait(1.0)


@test("Follow target - Position streaming")
def follow_position(v: Vehicle) -> None:
    """Follow a target that sends its position."""
    _follow(v, with_velocity=False)


@test("Follow target - Position and velocity streaming")
def follow_position_and_velocity(v: Vehicle) -> None:
    """Follow a target that sends its position and velocity."""
    _follow(v, with_velocity=True)


@test("Follow target - Velocity streaming only")
def follow_velocity(v: Vehicle) -> None:
    """Stay in place for a target without a position."""
    ready(v)
    home = v.position[:2]
    take_off(v, HEIGHT_M)
    with _following(v, Config(follow_angle_deg=180.0)) as plugin:
        begun = v.position
        for _ in range(15):
            plugin.set_target_location(TargetLocation(NAN, NAN, NAN, 2.0, 1.0, 0.5))
            v.wait(1.0)
        moved_m = math.dist(v.position, begun)
        check(moved_m < 4.0, f"moved {moved_m:.1f} m")
    home_within(v, home, 1.0)


# --- the command


def run(each: Px4Test, vehicle: Vehicle) -> dict[str, Any]:
    """Fly a test; return its outcome as plain data."""
    began, problem = time.monotonic(), ""
    try:
        each.fly(vehicle)
    except (AssertionError, RefusedError, MavsdkError) as error:
        # The place in the test says which wait was in vain.
        frames = _lines_of(error)
        problem = f"{str(error).split(';')[0] or type(error).__name__} ({frames})"
    return {
        "name": each.name,
        "own": each.own,
        "since": each.since,
        "passed": not problem,
        "finding": problem,
        "mode": vehicle.mode.name,
        "wall_s": round(time.monotonic() - began, 1),
    }


def _lines_of(error: BaseException) -> str:
    names = []
    trace = error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if code.co_filename == __file__ and code.co_name not in ("run", "check"):
            names.append(f"{code.co_name}:{trace.tb_lineno}")
        trace = trace.tb_next
    return " > ".join(names)


def main() -> int:
    """Fly the tests; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--connect", default="udpin://127.0.0.1:14540", help="MAVSDK connection")
    parser.add_argument("--system", type=int, default=1, help="MAVLink system id of the vehicle")
    parser.add_argument("--test", action="append", help="name of a test; repeat it; default: all")
    parser.add_argument("--list", action="store_true", help="print the names and exit")
    parser.add_argument("--json", type=Path, help="file for the outcomes")
    asked = parser.parse_args()
    if asked.list:
        print("\n".join(each.name for each in TESTS))
        return 0
    names = {each.name: each for each in TESTS}
    for name in asked.test or ():
        if name not in names:
            parser.error(f"--test {name}: accepted: {', '.join(names)}")
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    if mavsdk.add_any_connection(asked.connect) != 0:
        parser.error(f"--connect {asked.connect}: cannot be used")
    companion = Companion(mavsdk)
    vehicle = Vehicle(companion, asked.system)
    vehicle.until(lambda: vehicle.now_s > 0.0, 30.0)
    outcomes = []
    for name in asked.test or names:
        outcomes.append(run(names[name], vehicle))
        found = outcomes[-1]
        print(
            f"{'passed' if found['passed'] else 'FAILED'}  {name}  {found['finding']}", flush=True
        )
    companion.destroy()
    if asked.json is not None:
        asked.json.write_text(json.dumps(outcomes, indent=1) + "\n")
    return 0 if all(each["passed"] for each in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
