"""Messages on request and their rates."""

from __future__ import annotations

import math

import pytest

from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.streams.status import CAPABILITIES
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import Rig

NAN = math.nan
ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_message_interval(rig: Rig) -> None:
    attitude, local = dialect.MAVLINK_MSG_ID_ATTITUDE, dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED

    def rate() -> tuple[int, int]:
        rig.client.received()
        rig.bench.run(2.0)
        counts = rig.client.count()
        return counts["ATTITUDE"], counts["LOCAL_POSITION_NED"]

    assert rate() == (200, 60)
    assert rig.command(511, attitude, 4_000)[0] == ACCEPTED
    assert rig.command(511, local, -1)[0] == ACCEPTED
    assert rate() == (500, 0)
    assert rig.command(511, attitude, 100_000.4)[0] == ACCEPTED
    assert rig.command(511, local, 1e12)[0] == ACCEPTED
    rig.bench.tick()
    assert rate() == (20, 0)
    assert rig.command(511, attitude, 0)[0] == ACCEPTED
    assert rig.command(511, local, 0)[0] == ACCEPTED
    assert rate() == (200, 60)
    rig.command(511, attitude, 4_000)
    assert rig.command(511, attitude, NAN)[0] == ACCEPTED  # not given: the default
    assert rig.command(511, attitude, math.inf)[0] == ACCEPTED
    assert rig.command(511, attitude, 0)[0] == ACCEPTED
    for no_stream in (9_999, dialect.MAVLINK_MSG_ID_HEARTBEAT):
        assert rig.command(511, no_stream, 10_000)[0] == FAILED
    for silent in (NAN, 370, 371):  # nothing, BATTERY_INFO, FUEL_STATUS
        assert rig.command(511, silent, 10_000)[0] == ACCEPTED
    assert rig.command(511, dialect.MAVLINK_MSG_ID_DISTANCE_SENSOR, 10_000)[0] == ACCEPTED
    assert rate() == (200, 60)


def test_the_rate_of_one_link_does_not_change_another(rig: Rig) -> None:
    rig.command(511, dialect.MAVLINK_MSG_ID_ATTITUDE, -1)
    rig.station.received()
    rig.bench.run(1.0)
    assert rig.station.count()["ATTITUDE"] == 50


def test_get_message_interval(rig: Rig) -> None:
    def interval(number: float) -> tuple[int, int]:
        result, messages = rig.command(510, number)
        assert result == ACCEPTED
        (message,) = [m for m in messages if m.get_type() == "MESSAGE_INTERVAL"]
        return message.message_id, message.interval_us

    assert interval(30) == (30, 10_000)
    rig.command(511, 30, -1)
    assert interval(30) == (30, 0)
    assert interval(9_999) == (9_999, 0)
    assert interval(132) == (132, 0)
    assert interval(NAN) == (0, 1_000_000)
    assert interval(-5) == (65_531, 0)
    result, messages = rig.command(512, 244, 32)
    assert result == ACCEPTED
    (message,) = [m for m in messages if m.get_type() == "MESSAGE_INTERVAL"]
    assert (message.message_id, message.interval_us) == (32, 33_333)


@pytest.mark.parametrize(
    "number",
    [
        *(148, 242, 245, 0, 1, 2, 4, 24, 26, 30, 32, 49, 93, 105, 111, 147, 264),
        *(290, 291, 300, 331, 375, 436),
    ],
)
def test_requested_messages_come_before_their_acknowledgement(rig: Rig, number: int) -> None:
    rig.client.command(512, number)
    rig.bench.server.receive(rig.autopilot.time_us)
    message, ack = rig.client.received()
    assert message.get_msgId() == number
    assert (ack.get_type(), ack.result) == ("COMMAND_ACK", ACCEPTED)


@pytest.mark.parametrize("number", [132, 225, 410, 412, 437, 9_999])
def test_requests_for_what_has_nothing_to_say(rig: Rig, number: float) -> None:
    result, messages = rig.command(512, number)
    assert result == DENIED
    assert [m for m in messages if m.get_msgId() == number] == []


def test_requests_for_what_is_not_known_yet() -> None:
    autopilot = KinematicAutopilot()
    autopilot.ready_us = 10**9
    assert Rig(autopilot).command(512, 242)[0] == DENIED
    assert Rig(autopilot).command(410)[0] == DENIED


def test_identity(rig: Rig) -> None:
    for number in (520, 512):
        result, messages = rig.command(number, 148)
        assert result == ACCEPTED
        (version,) = [m for m in messages if m.get_type() == "AUTOPILOT_VERSION"]
    assert version.capabilities == CAPABILITIES
    assert CAPABILITIES & ~0xE8FF == 0, "a real PX4 has no such bit"
    assert version.flight_sw_version == 0x0110_00FF
    assert version.uid != 0
    assert version.board_version == 1


def test_capabilities_may_be_asked_of_all_systems(rig: Rig) -> None:
    rig.client.command(520, 1, target=(0, 0))
    rig.bench.tick()
    assert rig.acknowledged(520)[0] == ACCEPTED


def test_data_streams_only_ever_speed_up(rig: Rig) -> None:
    def ask(group: int, hz: int, start: int = 1) -> None:
        rig.exchange(dialect.MAVLink_request_data_stream_message(1, 1, group, hz, start))

    def count(seconds: int = 2) -> dict[str, float]:
        rig.client.received()
        rig.bench.run(seconds)
        return {name: n / seconds for name, n in rig.client.count().items()}

    before = count()
    ask(0, 4)  # MAVProxy on connecting
    after = count()
    assert all(after[name] >= hz for name, hz in before.items())
    assert after["SCALED_PRESSURE"] == 4
    assert after["ATTITUDE"] == 100
    ask(dialect.MAV_DATA_STREAM_POSITION, 125)
    assert count()["LOCAL_POSITION_NED"] == 125
    ask(0, 4, start=0)
    assert count() == before
    before_ignored = rig.bench.server.counters()["onboard"].ignored
    ask(77, 4)
    assert rig.bench.server.counters()["onboard"].ignored == before_ignored + 1
