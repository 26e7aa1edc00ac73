"""The real MAVSDK's mission, mission_raw and geofence plugins against the mission protocol."""

from __future__ import annotations

import math

import pytest
from mavsdk.plugins import geofence, mission, mission_raw

from firmware_sim.autopilot.navigation.plan import MissionType
from tests.support.mavlink_clients import mavsdk_over_memory
from tests.support.mavsdk_items import LATITUDE, LONGITUDE, raw_item, waypoint


def test_mission_mission_raw_and_geofence() -> None:
    with mavsdk_over_memory() as (companion, pacer):
        plans = pacer.bench.autopilot.plans
        simple = companion.plugin(mission.Mission)
        items = [
            waypoint(LATITUDE + 1e-4 * i, loiter_s=2.0 if i == 2 else math.nan) for i in (1, 2, 3)
        ]
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
        full.upload_mission(
            [raw_item(0, 22), raw_item(1, 16), raw_item(2, 177, frame=2, param1=1.0)]
        )
        assert [item.command for item in full.download_mission()] == [22, 16, 177]
        full.upload_rally_points([raw_item(0, 5100, kind=2), raw_item(1, 5100, kind=2)])
        assert [item.frame for item in full.download_rallypoints()] == [6, 6]
        with pytest.raises(mission_raw.MissionRawError, match="UNSUPPORTED"):
            full.upload_mission([raw_item(0, 16), raw_item(1, 18)])
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
            assert plans.stored(MissionType.FENCE).items == ()
