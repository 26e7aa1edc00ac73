"""Mission items as MAVSDK's two mission plugins want them."""

from __future__ import annotations

import math

from mavsdk.plugins.mission import MissionItem
from mavsdk.plugins.mission_raw import MissionItem as RawItem

NAN = math.nan
LATITUDE, LONGITUDE = 47.397743, 8.545594
"""Home position of PX4's simulated vehicles [deg]."""


def waypoint(
    latitude_deg: float,
    longitude_deg: float = LONGITUDE,
    *,
    height_m: float = 8.0,
    speed_m_s: float = 3.0,
    loiter_s: float = NAN,
    acceptance_m: float = 2.0,
) -> MissionItem:
    """Return a waypoint; the vehicle flies through it unless it stays there for a time."""
    return MissionItem(
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        relative_altitude_m=height_m,
        speed_m_s=speed_m_s,
        is_fly_through=math.isnan(loiter_s),
        gimbal_pitch_deg=NAN,
        gimbal_yaw_deg=NAN,
        camera_action=MissionItem.CameraAction.NONE,
        loiter_time_s=loiter_s,
        camera_photo_interval_s=NAN,
        acceptance_radius_m=acceptance_m,
        yaw_deg=NAN,
        camera_photo_distance_m=NAN,
        vehicle_action=MissionItem.VehicleAction.NONE,
    )


def raw_item(
    seq: int,
    command: int,
    *,
    kind: int = 0,
    frame: int = 6,
    param1: float = 0.0,
    param2: float = 0.0,
    longitude_deg: float = LONGITUDE,
) -> RawItem:
    """Return an item of the mission protocol; one in MAV_FRAME_MISSION (2) has no place."""
    placed = frame != 2
    return RawItem(
        seq=seq, frame=frame, command=command, current=int(seq == 0), autocontinue=1,
        param1=param1, param2=param2, param3=0.0, param4=NAN,
        x=round(LATITUDE * 1e7) if placed else 0, y=round(longitude_deg * 1e7) if placed else 0,
        z=10.0, mission_type=kind,
    )  # fmt: skip
