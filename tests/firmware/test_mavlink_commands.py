"""Commands over raw pymavlink: answers as measured with a real PX4 1.16."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import common as dialect

from firmware_sim.autopilot.autopilot_state import Arming, Result
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.navigation.plan import MissionType
from tests.support.kinematic_autopilot import ORIGIN
from tests.support.mavlink_clients import RawClient, Rig, text_of
from tests.support.mission_kit import at

NAN = math.nan
ACCEPTED, REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_arming(rig: Rig) -> None:
    result, _ = rig.command(400, 1)
    assert result == ACCEPTED
    arming = rig.autopilot.arming
    assert arming is Arming.ARMED
    assert rig.autopilot.commands == ["arm force=False"]
    rig.command(400, 1, 21196)
    rig.command(400, 0)
    rig.command(400, 0, 21196)  # MAVSDK 4.1's arm_force() really sends this: kill
    assert rig.autopilot.commands[1:] == [
        "arm force=True",
        "disarm force=False",
        "disarm force=True",
    ]
    assert rig.autopilot.arming is Arming.STANDBY


def test_termination(rig: Rig) -> None:
    """PX4: denied while disarmed, and there is no way back."""
    assert rig.command(185, 1)[0] == DENIED
    rig.command(400, 1)
    assert rig.command(185, 0)[0] == DENIED
    assert rig.command(185, NAN)[0] == DENIED
    assert rig.command(185, 1)[0] == ACCEPTED
    assert rig.autopilot.commands == ["terminate", "arm force=False", "terminate"]


def test_texts_go_to_all_links(rig: Rig) -> None:
    rig.command(400, 1)
    rig.bench.tick()
    assert (6, "Armed by external command") in text_of(rig.station.received())


def test_refusals_and_their_words(rig: Rig) -> None:
    rig.climb()
    result, messages = rig.command(400, 0)
    assert result == REJECTED
    assert (2, "Disarming denied: not landed") in text_of(messages)
    result, messages = rig.command(176, 129, 6, 0)
    assert result == REJECTED
    assert (2, "Switching to Offboard is currently not available") in text_of(messages)


@pytest.mark.parametrize("action", [2.0, -1.0, NAN, math.inf])
def test_arm_parameter_must_be_0_or_1(rig: Rig, action: float) -> None:
    messages = rig.exchange(dialect.MAVLink_command_long_message(1, 1, 400, 0, action, *[NAN] * 6))
    assert [m for m in messages if m.get_type() == "COMMAND_ACK"] == []  # as PX4
    assert text_of(messages) == [(2, f"Unsupported ARM_DISARM param: {action:.3f}")]
    assert rig.autopilot.commands == []


def test_takeoff_altitudes(rig: Rig) -> None:
    above_sea = ORIGIN.altitude_m + 12.5
    rig.command(22)
    rig.command(22, 0, 0, 0, NAN, NAN, NAN, above_sea)
    int_fields = (1, 1, dialect.MAV_FRAME_GLOBAL_INT, 22, 0, 0, 0, 0, 0, NAN, 0, 0)
    for frame, altitude in (
        (dialect.MAV_FRAME_GLOBAL_INT, above_sea),
        (dialect.MAV_FRAME_GLOBAL, above_sea),
        (dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT, 7.0),
        (dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, 8.0),
    ):
        fields = (*int_fields[:2], frame, *int_fields[3:], altitude)
        rig.client.send(dialect.MAVLink_command_int_message(*fields))
        rig.bench.tick()
        assert rig.acknowledged(22)[0] == ACCEPTED
    expected = [12.5, 12.5, 12.5, 7.0, 8.0]
    assert rig.autopilot.takeoffs[0] is None
    assert rig.autopilot.takeoffs[1:] == pytest.approx(expected, abs=1e-4)


def test_takeoff_above_sea_level_needs_a_home(rig: Rig) -> None:
    rig.autopilot.home = None
    assert rig.command(22, 0, 0, 0, NAN, NAN, NAN, 500.0)[0] == REJECTED
    assert rig.autopilot.takeoffs == []


@pytest.mark.parametrize(
    ("number", "params", "expected"),
    [
        (21, (), "mode LAND"),
        (20, (), "mode RETURN"),
        (176, (129, 4, 3), "mode HOLD"),
        (176, (1, 4, 3), "mode HOLD"),
        (176, (1, 4, 6), "mode LAND"),
        (176, (1, 4, 5), "mode RETURN"),
        (176, (1, 4, 2), "mode TAKEOFF"),
        (176, (129, 6, 0), "mode OFFBOARD"),
        (176, (129, 6), "mode OFFBOARD"),  # parameter 3 NaN
    ],
)
def test_mode_commands(rig: Rig, number: int, params: tuple[float, ...], expected: str) -> None:
    assert rig.command(number, *params)[0] == ACCEPTED
    assert rig.autopilot.commands == [expected]


@pytest.mark.parametrize(
    ("params", "mode"),
    [
        ((1, 1, 0), Mode.MANUAL),
        ((1, 2, 0), Mode.ALTITUDE),
        ((1, 3, 1), Mode.ORBIT),
        ((1, 4, 8), Mode.FOLLOW),
        ((1, 5, 0), Mode.ACRO),
        ((1, 7, 0), Mode.STABILIZED),
        ((64, 0, 0), Mode.MANUAL),
        ((80, 0, 0), Mode.STABILIZED),
    ],
)
def test_modes_for_a_pilot_and_round_a_target(
    rig: Rig, params: tuple[float, ...], mode: Mode
) -> None:
    assert rig.command(176, *params)[0] == ACCEPTED
    assert rig.autopilot.mode is mode
    assert mode.spec.custom_mode >> 16 & 0xFF == params[1] or params[1] == 0


def test_an_unknown_main_mode_is_accepted_and_changes_nothing(rig: Rig) -> None:
    assert rig.command(176, 1, 99, 0)[0] == ACCEPTED
    assert rig.autopilot.commands == []
    assert rig.command(176, 0, 0, 0)[0] == ACCEPTED
    assert rig.autopilot.commands == []


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ((1, 3, 2), "Switching to Position Slow is currently not available"),
        ((1, 4, 99), "Unsupported auto mode"),
    ],
)
def test_modes_that_are_not_there(rig: Rig, params: tuple[float, ...], text: str) -> None:
    result, messages = rig.command(176, *params)
    assert result == REJECTED
    assert "".join(said for _, said in text_of(messages)) == text
    assert rig.autopilot.commands == []


@pytest.mark.parametrize("params", [(1, 4, 4), (1, 4, 0), (4, 0, 0)])
def test_mission_mode_is_asked_for_in_three_ways(rig: Rig, params: tuple[float, ...]) -> None:
    assert rig.command(176, *params)[0] == ACCEPTED
    assert rig.autopilot.commands == ["mode MISSION"]


def test_set_mode_message_has_no_acknowledgement(rig: Rig) -> None:
    messages = rig.exchange(dialect.MAVLink_set_mode_message(1, 129, 100_925_440))
    assert rig.autopilot.commands == ["mode LAND"]
    assert "COMMAND_ACK" not in {m.get_type() for m in messages}
    rig.exchange(dialect.MAVLink_set_mode_message(2, 129, 100_925_440))
    assert rig.autopilot.commands == ["mode LAND"]


def test_set_home(rig: Rig) -> None:
    rig.climb()
    assert rig.command(179, 1)[0] == ACCEPTED
    assert rig.autopilot.home is not None
    assert rig.autopilot.home.altitude_m > ORIGIN.altitude_m + 2.0
    assert rig.command(179, 0, 0, 0, 0, 47.0, 8.0, 500.0)[0] == ACCEPTED
    assert rig.autopilot.home == (47.0, 8.0, 500.0)
    assert rig.command(179, 0, 0, 0, 0, 47.0, math.nan, 500.0)[0] == DENIED


def test_missions_are_started_and_places_looked_at(rig: Rig) -> None:
    assert rig.command(300, 0)[0] == DENIED  # none is stored
    assert rig.command(189)[0] == Result.CANCELLED
    rig.autopilot.plans.store(MissionType.MISSION, (at(0, 0, 5), at(0, 0, 0, 21)), 1)
    assert rig.command(300, 0)[0] == ACCEPTED
    assert rig.command(300, math.nan)[0] == DENIED
    assert rig.command(189)[0] == ACCEPTED
    assert rig.autopilot.commands[-2:] == ["mission from 0", "mission from 1"]
    for number, params, seen in (
        (195, (0, 0, 0, 0, 47.0, 8.0, 500.0), (47.0, 8.0, 500.0)),
        (197, (), None),
        (201, (3, 0, 0, 0, 46.0, 8.0, 500.0), (46.0, 8.0, 500.0)),
        (201, (0,), None),
    ):
        assert rig.command(number, *params)[0] == ACCEPTED
        assert rig.autopilot.looked_at == seen


def test_reboot_is_refused(rig: Rig) -> None:
    assert rig.command(246, 0)[0] == ACCEPTED  # "do nothing"
    assert rig.command(246, 1)[0] == DENIED
    rig.command(400, 1)
    assert rig.command(246, 1)[0] == DENIED


@pytest.mark.parametrize("number", [192, 16, 18, 31_000])
def test_unknown_commands_are_unsupported(rig: Rig, number: int) -> None:
    assert rig.command(number, 1, 2, 3)[0] == UNSUPPORTED


@pytest.mark.parametrize("target", [(2, 1), (1, 100), (0, 0), (0, 1), (255, 190)])
def test_commands_for_others_are_ignored(rig: Rig, target: tuple[int, int]) -> None:
    rig.client.command(400, 1, target=target)
    before = rig.bench.server.counters()["onboard"].ignored
    rig.bench.tick()
    assert not [m for m in rig.client.received() if m.get_type() == "COMMAND_ACK"]
    assert rig.autopilot.arming is Arming.STANDBY
    assert rig.bench.server.counters()["onboard"].ignored == before + 1


def test_a_command_to_all_components_is_ours(rig: Rig) -> None:
    rig.client.command(400, 1, target=(1, 0))
    rig.bench.tick()
    assert rig.acknowledged(400)[0] == ACCEPTED


def test_own_words_coming_back_are_ignored(rig: Rig) -> None:
    echo = RawClient(rig.bench.memory, ids=(1, 1))
    echo.command(400, 1)
    echo.send(dialect.MAVLink_ping_message(1, 1, 0, 0))
    rig.bench.tick()
    assert rig.autopilot.arming is Arming.STANDBY
    assert not [m for m in rig.client.received() if m.get_type() in ("PING", "COMMAND_ACK")]


def test_answers_go_to_the_link_that_asked(rig: Rig) -> None:
    rig.command(400, 1)
    assert not [m for m in rig.station.received() if m.get_type() == "COMMAND_ACK"]
