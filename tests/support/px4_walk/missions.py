"""Missions, the geofence and rally points, as stored aboard a vehicle that stands."""

from __future__ import annotations

from mavsdk.plugins import geofence, mission, mission_raw
from mavsdk.plugins.action import Action

from tests.support.mavsdk_items import LATITUDE, LONGITUDE, raw_item, waypoint
from tests.support.px4_walk.row import Row
from tests.support.px4_walk.vehicle import Vehicle


def _mission(vehicle: Vehicle) -> mission.Mission:
    return vehicle.plugin(mission.Mission)


def _items(vehicle: Vehicle) -> mission_raw.MissionRaw:
    return vehicle.plugin(mission_raw.MissionRaw)


def _upload(vehicle: Vehicle) -> None:
    third = waypoint(LATITUDE + 3e-4, height_m=10.0, loiter_s=2.0)
    items = [waypoint(LATITUDE + 1e-4), waypoint(LATITUDE + 2e-4), third]
    plan = mission.MissionPlan([*items, waypoint(LATITUDE + 4e-4)])
    _mission(vehicle).upload_mission(plan)


def _upload_fence(vehicle: Vehicle) -> None:
    corners = [(-1e-3, -1e-3), (1e-3, -1e-3), (1e-3, 1e-3), (-1e-3, 1e-3)]
    points = [geofence.Point(LATITUDE + a, LONGITUDE + b) for a, b in corners]
    center = geofence.Point(LATITUDE + 9e-4, LONGITUDE + 9e-4)
    vehicle.plugin(geofence.Geofence).upload_geofence(
        geofence.GeofenceData(
            [geofence.Polygon(points, geofence.FenceType.INCLUSION)],
            [geofence.Circle(center, 5.0, geofence.FenceType.EXCLUSION)],
        )
    )


def _downloaded(vehicle: Vehicle) -> list[float]:
    return [item.relative_altitude_m for item in _mission(vehicle).download_mission().mission_items]


def _commands(vehicle: Vehicle) -> list[int]:
    return [item.command for item in _items(vehicle).download_mission()]


def _fence(vehicle: Vehicle) -> tuple[int, int]:
    data = vehicle.plugin(geofence.Geofence).download_geofence()
    return len(data.polygons), len(data.circles)


ROWS = (
    Row("mission", "start_mission with none stored", lambda v: _mission(v).start_mission()),
    Row("mission", "hold again", lambda v: v.plugin(Action).hold()),
    Row("mission", "upload", _upload),
    Row("mission", "download", _downloaded, check=lambda heights: heights == [8, 8, 10, 8]),
    Row("mission", "set_current 2", lambda v: _mission(v).set_current_mission_item(2)),
    Row("mission", "set_current 0", lambda v: _mission(v).set_current_mission_item(0)),
    Row(
        "mission",
        "get_return_to_launch_after_mission",
        lambda v: _mission(v).get_return_to_launch_after_mission(),
        check=lambda value: value is False,
    ),
    Row(
        "mission",
        "set_return_to_launch_after_mission",
        lambda v: _mission(v).set_return_to_launch_after_mission(False),
    ),
    Row(
        "mission",
        "is_mission_finished",
        lambda v: _mission(v).is_mission_finished(),
        check=lambda value: value is False,
    ),
    Row(
        "mission",
        "raw download",
        _commands,
        check=lambda commands: commands == [16, 178, 16, 178, 16, 178, 93, 16, 178],
    ),
    Row("mission", "clear", lambda v: _mission(v).clear_mission()),
    Row("mission", "download after clear", _downloaded, check=lambda heights: heights == []),
    Row(
        "mission",
        "raw upload",
        lambda v: _items(v).upload_mission(
            [
                raw_item(0, 22),
                raw_item(1, 16),
                raw_item(2, 178, frame=2),
                raw_item(3, 19),
                raw_item(4, 20, frame=2),
            ]
        ),
    ),
    Row(
        "mission",
        "raw upload 5 km off",
        lambda v: _items(v).upload_mission(
            [raw_item(0, 22), raw_item(1, 16, longitude_deg=LONGITUDE + 0.066)]
        ),
    ),
    Row(
        "mission",
        "raw upload of LOITER_TURNS",
        lambda v: _items(v).upload_mission([raw_item(0, 22), raw_item(1, 18)]),
        ("UNSUPPORTED",),
    ),
    Row(
        "mission",
        "raw upload of DO_DIGICAM_CONTROL",
        lambda v: _items(v).upload_mission([raw_item(0, 22), raw_item(1, 203, frame=2)]),
    ),
    Row(
        "mission",
        "raw upload of DO_DIGICAM_CONFIGURE",
        lambda v: _items(v).upload_mission([raw_item(0, 22), raw_item(1, 202, frame=2)]),
        ("UNSUPPORTED",),
    ),
    Row(
        "mission",
        "raw upload_rally_points",
        lambda v: _items(v).upload_rally_points([raw_item(0, 5100, kind=2)]),
    ),
    Row(
        "mission",
        "raw download_rallypoints",
        lambda v: len(_items(v).download_rallypoints()),
        check=lambda count: count == 1,
    ),
    Row("mission", "raw clear_mission", lambda v: _items(v).clear_mission()),
    Row("geofence", "upload polygon and circle", _upload_fence),
    Row("geofence", "download", _fence, check=lambda counts: counts == (1, 1)),
    Row(
        "geofence",
        "raw download_geofence",
        lambda v: len(_items(v).download_geofence()),
        check=lambda count: count == 5,
    ),
    Row("geofence", "clear", lambda v: v.plugin(geofence.Geofence).clear_geofence()),
)
