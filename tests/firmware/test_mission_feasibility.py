"""Missions that PX4 rejects, with the reasons and texts."""

from __future__ import annotations

import pytest

from firmware_sim.addons.missions.feasibility import check
from firmware_sim.addons.missions.items import NavCommand, PlanFrame
from firmware_sim.autopilot.navigation.plan import PlanItem
from tests.support.mission_kit import DEFAULTS, ORIGIN, at, do

N = NavCommand
TAKEOFF, WAYPOINT, LAND = at(0, 0, 10, N.TAKEOFF), at(20, 0, 10), at(20, 0, 0, N.LAND)


def checked(*items: PlanItem, landed: bool = True, **parameters: float) -> tuple[bool, list[str]]:
    verdict = check(
        items,
        ORIGIN,
        {**DEFAULTS, **parameters}.__getitem__,
        landed=landed,
        inside_fence=lambda place: place.latitude_deg < ORIGIN.latitude_deg + 0.0005,
    )
    assert all(message.event is not None for message in verdict.messages)
    return verdict.valid, [message.text for message in verdict.messages]


def test_a_sound_mission() -> None:
    assert checked(TAKEOFF, WAYPOINT, do(N.DO_CHANGE_SPEED, 1, 3), LAND) == (True, [])


@pytest.mark.parametrize(
    ("items", "text"),
    [
        ((WAYPOINT, do(N.CONDITION_DELAY, 3)), "Mission rejected: item 2: unsupported cmd: 112"),
        ((LAND, WAYPOINT), "Mission rejected: starts with landing"),
        ((WAYPOINT, TAKEOFF), "Mission rejected: takeoff not first waypoint item"),
        (
            (at(0, 0, 489.0, N.TAKEOFF, frame=PlanFrame.GLOBAL_INT),),
            "Mission rejected: Takeoff altitude below home altitude!",
        ),
        (
            (at(0, 0, 10, N.VTOL_TAKEOFF),),
            "Mission rejected: Mission contains VTOL items but vehicle is not a VTOL",
        ),
        ((TAKEOFF, WAYPOINT, at(100, 0, 10)), "Geofence violation for waypoint 3"),
    ],
)
def test_rejected(items: tuple[PlanItem, ...], text: str) -> None:
    assert checked(*items) == (False, [text])


def test_speeds_and_cameras_before_take_off_are_no_waypoints() -> None:
    assert checked(do(N.DO_CHANGE_SPEED, 1, 3), do(N.IMAGE_START_CAPTURE), TAKEOFF)[0]


def test_a_landing_may_come_first_in_the_air() -> None:
    assert checked(LAND, landed=False)[0]


@pytest.mark.parametrize(
    ("required", "items", "landed", "text"),
    [
        (1, (WAYPOINT,), True, "Takeoff waypoint required."),
        (2, (TAKEOFF,), True, "Landing waypoint/pattern required."),
        (3, (TAKEOFF, WAYPOINT), True, "Takeoff or Landing item missing."),
        (4, (TAKEOFF, WAYPOINT), True, "Add Landing item or remove Takeoff."),
        (4, (WAYPOINT, LAND), True, "Add Takeoff item or remove Landing."),
        (4, (WAYPOINT,), True, None),
        (5, (WAYPOINT, LAND), True, "Add Takeoff item or remove Landing."),
        (5, (WAYPOINT, LAND), False, None),
        (5, (WAYPOINT,), False, "Landing waypoint/pattern required."),
        (3, (TAKEOFF, LAND), True, None),
    ],
)
def test_mis_tko_land_req(
    required: int, items: tuple[PlanItem, ...], landed: bool, text: str | None
) -> None:
    found = checked(*items, landed=landed, MIS_TKO_LAND_REQ=required)
    assert found == (text is None, [] if text is None else [f"Mission rejected: {text}"])


def test_a_first_waypoint_far_away_is_only_a_warning() -> None:
    far = at(0, 5000, 10)
    warning = "First waypoint far away from home: 5000m. Correct mission loaded?"
    assert checked(far, MIS_DIST_1WP=900.0) == (True, [warning])
    assert checked(far, MIS_DIST_1WP=0.0) == (True, [])
    assert checked(far) == (True, [])


def test_neither_mission_nor_home() -> None:
    assert checked() == (False, [])
    verdict = check(
        (WAYPOINT,), None, DEFAULTS.__getitem__, landed=True, inside_fence=lambda _: True
    )
    assert verdict.messages[0].text == "Not yet ready for mission, no position lock."
    assert not verdict.valid
