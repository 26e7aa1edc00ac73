"""A mission flown on the real airl-firmware by the real MAVSDK: the mission rows of PX4's walk."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from mavsdk.plugins.mission import Mission, MissionError, MissionItem, MissionPlan
from mavsdk.plugins.telemetry import FlightMode

from airl_mav.core.constants import EARTH_RADIUS_M
from tests.flight.test_mavsdk_firmware import Client, client
from tests.support.mavsdk_items import waypoint

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("flight"), pytest.mark.timeout(300)]


def place(c: Client, north: float, east: float) -> MissionItem:
    """Return a waypoint at metres from home, 4 m above it."""
    home = c.telemetry.home()
    shrink = math.cos(math.radians(home.latitude_deg))
    return waypoint(
        home.latitude_deg + math.degrees(north / EARTH_RADIUS_M),
        home.longitude_deg + math.degrees(east / EARTH_RADIUS_M / shrink),
        height_m=4.0,
        speed_m_s=4.0,
        acceptance_m=1.0,
    )


@pytest.mark.nightly  # In simulated time: test_px4_walk.py.
def test_upload_start_pause_resume_jump_and_finish(tmp_path: Path) -> None:
    with client(tmp_path) as c:
        mission: Mission = c.companion.plugin(Mission)
        c.take_off(4.0)
        with pytest.raises(MissionError):
            mission.start_mission()  # none is stored
        places = [(8, 0), (8, 8), (0, 8), (0, 4)]
        mission.upload_mission(MissionPlan([place(c, *metres) for metres in places]))
        mission.start_mission()
        c.until(lambda: c.telemetry.flight_mode() == FlightMode.MISSION, "mission")
        c.until(lambda: mission.mission_progress().current == 1, "the first waypoint")
        mission.pause_mission()
        c.until(lambda: c.telemetry.flight_mode() == FlightMode.HOLD, "a pause")
        mission.start_mission()
        c.until(lambda: c.telemetry.flight_mode() == FlightMode.MISSION, "mission again")
        assert mission.mission_progress().current == 1
        mission.set_current_mission_item(3)
        c.until(mission.is_mission_finished, "the end")
        c.until(lambda: c.telemetry.flight_mode() == FlightMode.HOLD, "hold at the end")
        assert math.hypot(c.position()[0], c.position()[1] - 4.0) < 1.5
