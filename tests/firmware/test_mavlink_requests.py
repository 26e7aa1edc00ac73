"""Messages on request and their rates."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from airl_mav.core.frames import HOME, Geodetic, geodetic_to_local
from firmware_sim.autopilot.modes.interface import Sticks
from firmware_sim.interfaces import TrueState
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.streams.status import CAPABILITIES, manual_control
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
    assert interval(132) == (132, 100_000)
    assert interval(26) == (26, 0)
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
        *(137, 192, 235, 290, 291, 300, 331, 375, 436),
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
    assert version.flight_sw_version == 0x0111_00FF
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


# --- messages that a PX4 SITL sends on request


def requested(rig: Rig, name: str) -> Any:
    result, messages = rig.command(512, getattr(dialect, f"MAVLINK_MSG_ID_{name}"))
    assert result == ACCEPTED
    (message,) = [m for m in messages if m.get_type() == name]
    return message


def test_the_true_state_is_sent_to_who_asks_and_to_nobody_else() -> None:
    rig = Rig()
    assert rig.command(512, dialect.MAVLINK_MSG_ID_HIL_STATE_QUATERNION)[0] == DENIED  # no plant
    truth = TrueState(
        rig.autopilot.time_us,
        np.array([100.0, -50.0, -20.0]),
        np.array([1.0, -2.0, 400.0]),
        np.array([math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5)]),
        np.array([0.1, -0.2, 0.3]),
        power_w=0.0,
        battery_remaining=1.0,
    )
    rig.bench.server.attach(rig.autopilot, lambda: truth)
    rig.bench.run(2.0)
    for end in (rig.client, rig.station):
        assert end.count()["HIL_STATE_QUATERNION"] == 0
    message = requested(rig, "HIL_STATE_QUATERNION")
    there = geodetic_to_local(
        Geodetic(message.lat / 1e7, message.lon / 1e7, message.alt / 1e3), HOME
    )
    np.testing.assert_allclose(there, truth.position, atol=0.01)
    assert (message.vx, message.vy, message.vz) == (100, -200, 32_767)  # saturated
    np.testing.assert_allclose(message.attitude_quaternion, truth.quaternion, atol=1e-6)
    assert message.yawspeed == pytest.approx(0.3)
    rig.command(511, dialect.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, 40_000)
    rig.client.received()
    rig.bench.run(1.0)
    assert rig.client.count()["HIL_STATE_QUATERNION"] == 25
    assert rig.station.count()["HIL_STATE_QUATERNION"] == 0


def test_the_whole_vehicle_in_one_message(rig: Rig) -> None:
    before = requested(rig, "HIGH_LATENCY2")
    assert (before.type, before.autopilot) == (2, 12)
    assert before.latitude == pytest.approx(47.397743e7, abs=100)
    assert before.altitude == 489
    assert before.wp_num == 0xFFFF
    assert before.failure_flags == dialect.HL_FAILURE_FLAG_RC_RECEIVER
    rig.climb()
    after = requested(rig, "HIGH_LATENCY2")
    assert after.altitude == 492
    assert after.custom_mode == 3 << 8 | 4  # AUTO, LOITER


def test_a_calibrated_compass_is_reported(rig: Rig) -> None:
    report = requested(rig, "MAG_CAL_REPORT")
    assert report.cal_status == dialect.MAG_CAL_SUCCESS
    assert (report.ofs_x, report.diag_y, report.offdiag_z) == (0.0, 1.0, 0.0)
    rig.autopilot.parameters.values["CAL_MAG0_ID"] = 0
    assert rig.command(512, dialect.MAVLINK_MSG_ID_MAG_CAL_REPORT)[0] == DENIED


def test_a_pilots_sticks_are_told(rig: Rig) -> None:
    """PX4 sends the throttle from -1000 on, though it takes it from 0 on."""
    assert rig.command(512, dialect.MAVLINK_MSG_ID_MANUAL_CONTROL)[0] == DENIED
    state = rig.autopilot.state()._replace(sticks=Sticks(0.5, -1.0, -0.25, 0.1))
    assert state.sticks is not None
    fields = dict(
        zip(
            dialect.MAVLink_manual_control_message.fieldnames,
            manual_control(state, 7) or (),
            strict=True,
        )
    )
    assert [fields[name] for name in ("target", "x", "y", "z", "r")] == [7, -1000, 500, -250, 100]


def override(**widths: int) -> Any:
    nothing = {f"chan{n}_raw": 65_535 if n <= 8 else 0 for n in range(1, 19)}
    return dialect.MAVLink_rc_channels_override_message(1, 1, **{**nothing, **widths})


def test_the_channels_of_a_radio_come_back_once_each(rig: Rig) -> None:
    """MAVROS shows them as rc/in, QGroundControl on its radio page."""
    rig.bench.run(1.0)
    assert rig.client.count()["RC_CHANNELS"] == rig.station.count()["RC_CHANNELS"] == 0
    rig.client.send(override(chan1_raw=1100, chan3_raw=1500, chan9_raw=1900))
    rig.bench.run(1.0)
    for end in (rig.client, rig.station):
        (channels,) = [m for m in end.received() if m.get_type() == "RC_CHANNELS"]
        assert (channels.chancount, channels.rssi) == (9, 100)
        assert (channels.chan1_raw, channels.chan2_raw, channels.chan9_raw) == (1100, 65_535, 1900)
        assert channels.chan10_raw == channels.chan18_raw == 65_535
    rig.client.send(override())
    rig.bench.run(0.5)
    (channels,) = [m for m in rig.client.received() if m.get_type() == "RC_CHANNELS"]
    assert (channels.chancount, channels.rssi, channels.chan1_raw) == (0, 0, 65_535)
