"""A mission and a geofence in flight."""

from __future__ import annotations

from typing import Any

from mavsdk.plugins.action import Action
from mavsdk.plugins.geofence import FenceType, Geofence, GeofenceData, Point, Polygon
from mavsdk.plugins.mission import Mission, MissionPlan
from mavsdk.plugins.offboard import VelocityNedYaw
from mavsdk.plugins.telemetry import FlightMode

from tests.support.mavsdk_items import waypoint
from tests.support.px4_walk.flight import HEIGHT_M, in_mode
from tests.support.px4_walk.offboard import offboard
from tests.support.px4_walk.row import Row
from tests.support.px4_walk.vehicle import OFFBOARD, Vehicle

FENCE_NORTH_M = 22.0


def _mission(vehicle: Vehicle) -> Mission:
    return vehicle.plugin(Mission)


def _upload(vehicle: Vehicle) -> None:
    places = [vehicle.place(*metres) for metres in ((10, 0), (10, 10), (0, 10), (0, 4))]
    items = [waypoint(*place, height_m=HEIGHT_M, speed_m_s=4.0) for place in places]
    _mission(vehicle).upload_mission(MissionPlan(items))
    vehicle.wait(1.0)  # PX4 checks it first, and refuses to start it until then


def _reached(item: int, limit_s: float) -> Any:
    """Wait until an item is the current one."""
    return lambda v: v.until(lambda: _mission(v).mission_progress().current >= item, limit_s)


def _stands(vehicle: Vehicle) -> None:
    vehicle.until(lambda: max(map(abs, vehicle.velocity)) < 0.3, 8.0)


def _fence(vehicle: Vehicle) -> None:
    corners = ((-30.0, -30.0), (-30.0, 30.0), (FENCE_NORTH_M, 30.0), (FENCE_NORTH_M, -30.0))
    points = [Point(*vehicle.place(*corner)) for corner in corners]
    data = GeofenceData([Polygon(points, FenceType.INCLUSION)], [])
    vehicle.plugin(Geofence).upload_geofence(data)


def _towards(vehicle: Vehicle) -> None:
    offboard(vehicle).set_velocity_ned(VelocityNedYaw(3.0, 0.0, 0.0, 0.0))
    offboard(vehicle).start()


def _at_the_fence(vehicle: Vehicle) -> FlightMode:
    """PX4 warns of the breach and holds (GF_ACTION = 2)."""
    vehicle.until(lambda: vehicle.position[0] > FENCE_NORTH_M - 8.0, 20.0, speed=OFFBOARD)
    vehicle.until(lambda: vehicle.mode != FlightMode.OFFBOARD, 10.0, speed=OFFBOARD)
    vehicle.wait(3.0)
    return vehicle.mode


ROWS = (
    Row("mission flown", "upload in flight", _upload),
    Row("mission flown", "start", lambda v: _mission(v).start_mission()),
    Row("mission flown", "... mode", in_mode(FlightMode.MISSION)),
    Row("mission flown", "the first waypoint", _reached(1, 25.0)),
    Row("mission flown", "pause_mission", lambda v: _mission(v).pause_mission()),
    Row("mission flown", "... mode of the pause", in_mode(FlightMode.HOLD)),
    Row("mission flown", "... stands", _stands),
    Row("mission flown", "start_mission (resume)", lambda v: _mission(v).start_mission()),
    Row("mission flown", "the second waypoint", _reached(2, 25.0)),
    Row(
        "mission flown",
        "set_current_mission_item 3",
        lambda v: _mission(v).set_current_mission_item(3),
    ),
    Row(
        "mission flown",
        "finished",
        lambda v: v.until(lambda: _mission(v).is_mission_finished(), 30.0),
    ),
    Row("mission flown", "... mode at the end", in_mode(FlightMode.HOLD)),
    Row("fence flown", "upload an inclusion polygon", _fence),
    Row("fence flown", "offboard across it", _towards),
    Row("fence flown", "the breach", _at_the_fence, check=lambda mode: mode == FlightMode.HOLD),
    Row("fence flown", "hold", lambda v: v.plugin(Action).hold()),
    Row("fence flown", "clear", lambda v: v.plugin(Geofence).clear_geofence()),
)
