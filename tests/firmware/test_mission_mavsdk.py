"""The real MAVSDK's mission, mission_raw and geofence plugins against the mission protocol."""

from __future__ import annotations

import math
from typing import Any

import pytest
from mavsdk.plugins import geofence, mission, mission_raw

from firmware_sim.autopilot.navigation.plan import Kind
from tests.support.mavlink_clients import mavsdk_over_memory

NAN = math.nan
LATITUDE, LONGITUDE = 47.397743, 8.545594


def waypoint(north_deg: float, *, loiter_s: float = NAN, speed: float = 3.0) -> Any:
    return mission.MissionItem(
        latitude_deg=LATITUDE + north_deg,
        longitude_deg=LONGITUDE,
        relative_altitude_m=8.0,
        speed_m_s=speed,
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


def raw(seq: int, command: int, kind: int = 0, *, frame: int = 6, param1: float = 0.0) -> Any:
    return mission_raw.MissionItem(
        seq=seq, frame=frame, command=command, current=int(seq == 0), autocontinue=1,
        param1=param1, param2=2.0, param3=0.0, param4=NAN,
        x=round(LATITUDE * 1e7) + seq, y=round(LONGITUDE * 1e7), z=10.0, mission_type=kind,
    )  # fmt: skip


def test_mission_mission_raw_and_geofence() -> None:
    with mavsdk_over_memory() as (companion, pacer):
        plans = pacer.bench.autopilot.plans
        simple = companion.plugin(mission.Mission)
        items = [waypoint(0.0001), waypoint(0.0002, loiter_s=2.0), waypoint(0.0003)]
        simple.upload_mission(mission.MissionPlan(items))
        with pacer.lock:
            commands = [item.command for item in plans.mission]
        # As the walk of a real PX4: waypoint, speed, and a NAV_DELAY where it stays.
        assert commands == [16, 178, 16, 178, 93, 16, 178]
        back = simple.download_mission().mission_items
        assert [item.relative_altitude_m for item in back] == [8.0, 8.0, 8.0]
        assert [item.speed_m_s for item in back] == [3.0, 3.0, 3.0]
        assert back[1].loiter_time_s == 2.0
        simple.set_current_mission_item(2)
        with pacer.lock:
            assert plans.current == 5
        simple.set_current_mission_item(0)
        assert not simple.is_mission_finished()

        full = companion.plugin(mission_raw.MissionRaw)
        assert [item.command for item in full.download_mission()] == commands
        simple.clear_mission()
        assert full.download_mission() == []
        full.upload_mission([raw(0, 22), raw(1, 16), raw(2, 177, frame=2, param1=1.0)])
        assert [item.command for item in full.download_mission()] == [22, 16, 177]
        full.upload_rally_points([raw(0, 5100, 2), raw(1, 5100, 2)])
        assert [item.frame for item in full.download_rallypoints()] == [6, 6]
        with pytest.raises(mission_raw.MissionRawError, match="UNSUPPORTED"):
            full.upload_mission([raw(0, 16), raw(1, 18)])
        full.clear_mission()

        corners = [(0.0, 0.0), (0.001, 0.0), (0.001, 0.001), (0.0, 0.001)]
        points = [geofence.Point(LATITUDE + a, LONGITUDE + b) for a, b in corners]
        fence = companion.plugin(geofence.Geofence)
        fence.upload_geofence(
            geofence.GeofenceData(
                [geofence.Polygon(points, geofence.FenceType.INCLUSION)],
                [geofence.Circle(points[0], 30.0, geofence.FenceType.EXCLUSION)],
            )
        )
        data = fence.download_geofence()
        assert [len(polygon.points) for polygon in data.polygons] == [4]
        assert [circle.radius for circle in data.circles] == [30.0]
        assert [item.command for item in full.download_geofence()] == [5001] * 4 + [5004]
        fence.clear_geofence()
        with pacer.lock:
            assert plans.stored(Kind.FENCE).items == ()
