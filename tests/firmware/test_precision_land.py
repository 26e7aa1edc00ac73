"""Precision landing: states, refusals, and flights onto a landing target."""

from __future__ import annotations

import math

import pytest

from airl_mav.core.constants import US_PER_S
from firmware_sim.addons.missions.items import NavCommand
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import LandingTarget
from firmware_sim.autopilot.navigation.plan import MissionType
from firmware_sim.mavlink.codec import dialect
from tests.support import mavlink_clients
from tests.support.flight_rig import Rig
from tests.support.mission_kit import at

_N = NavCommand
PERIOD_US = US_PER_S // 10


class Beacon:
    """Reports a landing target at 10 Hz as long as it is lit."""

    def __init__(self, rig: Rig, north: float, east: float) -> None:
        self.rig, self.place, self.lit = rig, (north, east, 0.0), True
        self._next_us = 0

    def shine(self) -> None:
        if self.lit and self.rig.sim.time_us >= self._next_us:
            self._next_us = self.rig.sim.time_us + PERIOD_US
            self.rig.ap.landing_target(LandingTarget(self.place, self.rig.sim.time_us))

    def run(self, seconds: float) -> None:
        self.rig.run(seconds, self.shine)

    def until_landed(self, limit_s: float = 60.0) -> None:
        for _ in range(round(limit_s * 10)):
            if self.rig.ap.flight.phase < FlightPhase.AIR:
                return
            self.run(0.1)
        raise AssertionError(f"not landed: {self.rig.texts}")

    @property
    def missed_m(self) -> float:
        north, east, _ = self.rig.truth.position
        return math.hypot(north - self.place[0], east - self.place[1])


def test_it_lands_on_the_target_and_follows_it() -> None:
    rig = Rig()
    rig.take_off(6.0, settle_s=0.0)
    beacon = Beacon(rig, 5.0, -3.0)
    beacon.run(0.2)
    assert rig.ap.set_mode(Mode.PRECISION_LAND, commanded=True) is Result.ACCEPTED
    assert rig.said("Precision landing") > 0.0
    beacon.run(6.0)
    # It stays at its height until it is above the target.
    assert beacon.missed_m < 0.6 and rig.height > 5.0
    beacon.place = (5.5, -3.0, 0.0)
    beacon.until_landed()
    assert beacon.missed_m < 0.3
    rig.until(lambda: rig.ap.flight.phase < FlightPhase.GROUND, 5.0)
    assert rig.mode is Mode.HOLD
    rig.close()


def test_without_a_target_it_climbs_to_search_and_then_lands() -> None:
    rig = Rig(parameters={"PLD_SRCH_TOUT": 8.0})
    rig.take_off(4.0, settle_s=0.0)
    rig.ap.set_mode(Mode.PRECISION_LAND)
    rig.run(1.8)
    assert rig.height == pytest.approx(4.0, abs=0.7)
    rig.run(7.0)
    assert rig.height > 8.5
    rig.until(lambda: rig.ap.flight.phase < FlightPhase.AIR, 40.0)
    assert math.hypot(*rig.truth.position[:2]) < 1.0
    rig.close()


def test_a_target_that_the_search_finds_is_landed_on() -> None:
    rig = Rig()
    rig.take_off(4.0, settle_s=0.0)
    rig.ap.set_mode(Mode.PRECISION_LAND)
    rig.run(4.0)
    found = rig.height
    assert found > 4.5
    beacon = Beacon(rig, 2.0, 2.0)
    beacon.until_landed()
    assert beacon.missed_m < 0.3
    rig.close()


def test_a_target_that_is_lost_on_the_way_down_is_searched_for() -> None:
    rig = Rig(parameters={"PLD_BTOUT": 1.0, "PLD_MAX_SRCH": 1, "PLD_SRCH_ALT": 8.0})
    rig.take_off(6.0, settle_s=0.0)
    beacon = Beacon(rig, 0.0, 0.0)
    beacon.run(0.2)
    rig.ap.set_mode(Mode.PRECISION_LAND)
    for _ in range(200):
        beacon.run(0.1)
        if rig.height < 4.0:
            break
    beacon.lit = False
    rig.run(7.0)
    assert rig.height > 5.0  # it climbs to look for it
    beacon.lit = True
    beacon.run(4.0)
    for _ in range(200):
        beacon.run(0.1)
        if rig.height < 4.0:
            break
    beacon.lit = False  # a second time it is not searched for
    rig.until(lambda: rig.ap.flight.phase < FlightPhase.AIR, 20.0)
    rig.close()


@pytest.mark.parametrize(("precision", "on_target"), [(0, False), (1, True), (2, True)])
def test_a_missions_landing_asks_for_it(precision: int, on_target: bool) -> None:
    rig = Rig()
    rig.take_off(5.0, settle_s=0.0)
    landing = at(0, 8, 0, _N.LAND, 0.0, precision)
    rig.ap.plans.store(MissionType.MISSION, (at(0, 0, 5, _N.TAKEOFF), landing), 1, 1)
    beacon = Beacon(rig, 1.5, 8.0)
    beacon.run(0.3)
    rig.ap.set_mode(Mode.MISSION)
    beacon.until_landed()
    assert (beacon.missed_m < 0.3) is on_target
    assert abs(rig.truth.position[1] - 8.0) < 0.6
    rig.close()


def test_an_opportunistic_landing_does_not_search() -> None:
    rig = Rig(parameters={"RTL_PLD_MD": 1})
    rig.take_off(5.0, settle_s=0.0)
    rig.ap.set_mode(Mode.RETURN)
    rig.until(lambda: math.isfinite(rig.said("RTL: land at destination")), 20.0)
    highest = rig.height
    rig.until(lambda: rig.ap.flight.phase < FlightPhase.AIR, 30.0)
    assert highest < 6.0
    rig.close()


def test_a_return_lands_on_the_target_where_it_is_asked_to() -> None:
    rig = Rig(parameters={"RTL_PLD_MD": 2})
    rig.take_off(5.0, settle_s=0.0)
    beacon = Beacon(rig, 1.0, 1.0)
    rig.ap.set_mode(Mode.RETURN)
    beacon.until_landed()
    assert beacon.missed_m < 0.3
    rig.close()


# --- MAVLink


def target(
    frame: int = 1, *, valid: int = 1, x: float = 1.0
) -> dialect.MAVLink_landing_target_message:
    bearings = (0.1, 0.2, 3.0, 0.0, 0.0)
    return dialect.MAVLink_landing_target_message(
        0, 0, frame, *bearings, x, 2.0, -0.5, [1.0, 0.0, 0.0, 0.0], 2, valid
    )


def test_a_position_in_local_ned_is_taken_and_nothing_else() -> None:
    rig = mavlink_clients.Rig()
    rig.exchange(target())
    (taken,) = rig.autopilot.landing_targets
    assert taken == LandingTarget((1.0, 2.0, -0.5), taken.time_us)
    rig.exchange(target(valid=0))
    rig.exchange(target(x=math.nan))
    said = [
        text for _ in range(2) for _, text in mavlink_clients.text_of(rig.exchange(target(frame=8)))
    ]
    assert said == ["Landing target: coordinate frame 8 unsupported"]
    assert len(rig.autopilot.landing_targets) == 1


def test_it_is_asked_for_in_two_ways() -> None:
    rig = mavlink_clients.Rig()
    for number, params in ((dialect.MAV_CMD_NAV_LAND_LOCAL, ()), (176, (1, 4, 9))):
        rig.client.command(number, *params)
        rig.bench.tick()
        (ack,) = rig.client.received("COMMAND_ACK")
        assert ack.result == dialect.MAV_RESULT_ACCEPTED
        assert rig.autopilot.commands[-1] == "mode PRECISION_LAND"
    rig.client.received()
    rig.client.command(512, dialect.MAVLINK_MSG_ID_AVAILABLE_MODES, 0)
    rig.bench.tick()
    modes = rig.client.received("AVAILABLE_MODES")
    assert 4 << 16 | 9 << 24 in [mode.custom_mode for mode in modes]
