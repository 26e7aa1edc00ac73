"""The ports of a rehearsal: PX4's, and one for the camera."""

from __future__ import annotations

from dataclasses import dataclass

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Ports:
    """UDP ports of the MAVLink links, as PX4 SITL uses them, and the camera's TCP port."""

    api_port: int = 14540
    """UDP port of the onboard API: where MAVSDK listens."""

    api_local_port: int = 14580
    """UDP port that the flight controller's onboard link binds. 0: any free one."""

    gcs_port: int = 14550
    """UDP port of the ground station: where QGroundControl listens."""

    gcs_local_port: int = 18570
    """UDP port that the flight controller's ground station link binds. 0: any free one."""

    camera_port: int = 5600
    """TCP port (ZeroMQ) of the depth camera. 0: any free one."""
