"""Missions, the geofence and rally points, as stored aboard a vehicle that stands."""

from __future__ import annotations

import math
from typing import Any

from mavsdk.plugins import geofence, mission, mission_raw
from mavsdk.plugins.action import Action

from tests.support.px4_walk.row import Row
from tests.support.px4_walk.vehicle import Vehicle

NAN = math.nan
LATITUDE, LONGITUDE = 47.397743, 8.545594


def _waypoint(north_deg: float, height_m: float, loiter_s: float = NAN) -> Any:
    return mission.MissionItem(
        latitude_deg=LATITUDE + north_deg,
        longitude_deg=LONGITUDE,
        relative_altitude_m=height_m,
        speed_m_s=3.0,
        is_fly_through=math.isnan(loiter_s),
        gimbal_pitch_deg=NAN,
        gimbal_yaw_deg=NAN,
        camera_action=mission.MissionItem.CameraAction.NONE,
        loiter_time_s=loiter_s,
        camera_photo_interval_s=NAN,
        acceptance_radius_m=2.0,
        yaw_deg=NAN,
        camera_photo_distance_m=NAN,
        vehicle_action=mission.MissionItem.VehicleAction.NONE,
    )


def _raw(seq: int, command: int, *, kind: int = 0, frame: int = 6, east_deg: float = 0.0) -> Any:
    return mission_raw.MissionItem(
        seq=seq, frame=frame, command=command, current=int(seq == 0), autocontinue=1,
        param1=0.0, param2=0.0, param3=0.0, param4=NAN,
        x=round(LATITUDE * 1e7) if frame != 2 else 0,
        y=round((LONGITUDE + east_deg) * 1e7) if frame != 2 else 0,
        z=10.0, mission_type=kind,
    )  # fmt: skip


def _mission(vehicle: Vehicle) -> mission.Mission:
    return vehicle.plugin(mission.Mission)


def _items(vehicle: Vehicle) -> mission_raw.MissionRaw:
    return vehicle.plugin(mission_raw.MissionRaw)


def _upload(vehicle: Vehicle) -> None:
    items = [_waypoint(1e-4, 8.0), _waypoint(2e-4, 8.0), _waypoint(3e-4, 10.0, 2.0)]
    plan = mission.MissionPlan([*items, _waypoint(4e-4, 8.0)])
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
            [_raw(0, 22), _raw(1, 16), _raw(2, 178, frame=2), _raw(3, 19), _raw(4, 20, frame=2)]
        ),
    ),
    Row(
        "mission",
        "raw upload 5 km off",
        lambda v: _items(v).upload_mission([_raw(0, 22), _raw(1, 16, east_deg=0.066)]),
    ),
    Row(
        "mission",
        "raw upload of LOITER_TURNS",
        lambda v: _items(v).upload_mission([_raw(0, 22), _raw(1, 18)]),
        ("UNSUPPORTED",),
    ),
    Row(
        "mission",
        "raw upload_rally_points",
        lambda v: _items(v).upload_rally_points([_raw(0, 5100, kind=2)]),
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
