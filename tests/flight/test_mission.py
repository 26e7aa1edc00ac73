"""Missions flown by the built-in autopilot in simulated time."""

from __future__ import annotations

import math

from firmware_sim.addons.missions.items import NavCommand
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.navigation.plan import MissionType, PlanItem
from tests.support.flight_rig import Rig, flight
from tests.support.mission_kit import at, do

N = NavCommand


def item(rig: Rig, north: float, east: float, up: float, *words: float) -> PlanItem:
    origin = rig.ap.estimator.origin
    assert origin is not None
    command, *params = words or (N.WAYPOINT,)
    return at(north, east, up, int(command), *params, origin=origin)


def away(rig: Rig, north: float, east: float) -> float:
    position = rig.truth.position
    return math.hypot(position[0] - north, position[1] - east)


def test_a_mission_with_a_jump_a_pause_and_hold_at_its_end() -> None:
    with flight() as rig:
        rig.boot()
        plans = rig.ap.plans
        places = [(0, 0), (10, 0), (10, 10), None, (0, 10)]
        items = (
            item(rig, 0, 0, 3, N.TAKEOFF),
            item(rig, 10, 0, 4),
            item(rig, 10, 10, 4, N.WAYPOINT, 1.0),
            do(N.DO_JUMP, 1, 1),
            item(rig, 0, 10, 4),
        )
        plans.store(MissionType.MISSION, items, 1, 0)
        assert rig.ap.set_mode(Mode.MISSION) is Result.ACCEPTED
        assert rig.ap.arm(force=False) is Result.ACCEPTED

        reached: list[tuple[int, float]] = []

        def watch() -> None:
            index = plans.reached
            if index >= 0 and (not reached or reached[-1][0] != index):
                where = places[index]
                assert where is not None
                reached.append((index, away(rig, *where)))

        rig.until(lambda: watch() or len(reached) == 2, 40.0)  # type: ignore[func-returns-value]
        # Paused before item 2: the vehicle stops, and resumes with the same item.
        rig.run(1.0, watch)
        assert rig.ap.set_mode(Mode.HOLD) is Result.ACCEPTED
        rig.run(4.0)
        assert math.hypot(*rig.truth.velocity[:2]) < 0.3
        assert plans.current == 2
        assert rig.ap.set_mode(Mode.MISSION) is Result.ACCEPTED
        rig.until(lambda: watch() or rig.mode is Mode.HOLD, 60.0)  # type: ignore[func-returns-value]
        assert [index for index, _ in reached] == [0, 1, 2, 1, 2, 4]
        # Within the acceptance radius of 2 m, and the estimator's error.
        assert max(distance for _, distance in reached) < 2.4
        assert not math.isnan(rig.said("Mission finished, loitering"))
        rig.run(2.0)
        assert away(rig, 0, 10) < 2.4


def test_land_ends_it_on_the_ground() -> None:
    with flight() as rig:
        rig.boot()
        rig.ap.plans.store(
            MissionType.MISSION,
            (item(rig, 0, 0, 2, N.TAKEOFF), item(rig, 6, 0, 0, N.LAND)),
            1,
            0,
        )
        assert rig.ap.start_mission(0) is Result.ACCEPTED
        assert rig.mode is Mode.MISSION
        rig.until(lambda: rig.ap.flight.phase == 1, 60.0)
        assert away(rig, 6, 0) < 1.0
        assert not math.isnan(rig.said("Mission finished, landed"))


def test_without_a_mission_it_neither_arms_nor_changes_the_mode_in_the_air() -> None:
    with flight() as rig:
        rig.boot()
        # Disarmed, PX4 grants every mode.
        assert rig.ap.set_mode(Mode.MISSION) is Result.ACCEPTED
        assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED
        assert rig.ap.start_mission(-1) is Result.DENIED
        assert not math.isnan(rig.said("Mission start denied! No valid mission"))
        assert rig.ap.set_mode(Mode.HOLD) is Result.ACCEPTED
        rig.take_off(2.0, settle_s=0.0)
        assert rig.ap.set_mode(Mode.MISSION) is Result.TEMPORARILY_REJECTED
        assert not math.isnan(rig.said("Switching to Mission is currently not available"))
        assert rig.mode is Mode.HOLD
