"""Microservices over raw pymavlink: what a real PX4 1.16 was measured to answer."""

from __future__ import annotations

import binascii
import math
import struct
from typing import Any

import numpy as np
import pytest
from kinematic_autopilot import DEFAULT_PARAMETERS, ORIGIN, KinematicAutopilot, Parameters
from mavlink_clients import CLIENT_IDS, Bench, RawClient, text_of
from pymavlink.dialects.v20 import common as dialect

from airl_mav.constants import TICK_US
from firmware_sim.autopilot.state import Arming, Landed, Message, Mode, Severity
from firmware_sim.mavlink.identity import CAPABILITIES
from firmware_sim.mavlink.texts import TextEncoder

ACCEPTED, REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
NAN = math.nan


class Rig:
    """A ready vehicle and a raw client on its onboard link."""

    def __init__(self, autopilot: KinematicAutopilot | None = None) -> None:
        self.bench = Bench(autopilot=autopilot)
        self.autopilot = self.bench.autopilot
        self.client = RawClient(self.bench.onboard)
        self.station = RawClient(self.bench.gcs)
        self.bench.run(0.2)
        self.client.received()
        self.station.received()

    def exchange(self, message: Any) -> list[Any]:
        """Send a message, run one tick, return everything that came back."""
        self.client.send(message)
        self.bench.tick()
        return self.client.received()

    def command(self, number: int, *params: float) -> tuple[int, list[Any]]:
        """Send a COMMAND_LONG; return its result and everything that came back in that tick."""
        self.client.command(number, *params)
        self.bench.tick()
        return self.acknowledged(number)

    def acknowledged(self, number: int) -> tuple[int, list[Any]]:
        messages = self.client.received()
        (ack,) = [m for m in messages if m.get_type() == "COMMAND_ACK"]
        assert ack.command == number
        assert (ack.target_system, ack.target_component) == CLIENT_IDS
        return ack.result, messages

    def climb(self) -> None:
        """Arm, take off, hold."""
        assert self.command(400, 1)[0] == ACCEPTED
        assert self.command(22)[0] == ACCEPTED
        self.bench.run(3.0)
        assert self.autopilot.mode is Mode.HOLD
        self.client.received()

    def set_local(self, mask: int, frame: int = 1, **fields: float) -> None:
        """Send SET_POSITION_TARGET_LOCAL_NED; fields not given are 0."""
        order = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
        values = [fields.get(name, 0.0) for name in order]
        self.client.send(
            dialect.MAVLink_set_position_target_local_ned_message(7, 1, 1, frame, mask, *values)
        )


@pytest.fixture
def rig() -> Rig:
    return Rig()


# --- commands


def test_arming(rig: Rig) -> None:
    result, _ = rig.command(400, 1)
    assert result == ACCEPTED
    assert rig.autopilot.arming is Arming.ARMED
    assert rig.autopilot.commands == ["arm force=False"]
    rig.command(400, 1, 21196)
    rig.command(400, 0)
    rig.command(400, 0, 21196)  # what MAVSDK 4.1's arm_force() really sends: kill
    assert rig.autopilot.commands[1:] == [
        "arm force=True",
        "disarm force=False",
        "disarm force=True",
    ]
    assert rig.autopilot.arming is Arming.STANDBY


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
    result, messages = rig.command(400, action)
    assert result == UNSUPPORTED
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


def test_an_unknown_main_mode_is_accepted_and_changes_nothing(rig: Rig) -> None:
    assert rig.command(176, 1, 99, 0)[0] == ACCEPTED
    assert rig.autopilot.commands == []
    assert rig.command(176, 0, 0, 0)[0] == ACCEPTED
    assert rig.autopilot.commands == []


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ((1, 1, 0), "Switching to Manual is currently not available"),
        ((1, 7, 0), "Switching to Stabilized is currently not available"),
        ((1, 4, 4), "Switching to Mission is currently not available"),
        ((1, 4, 0), "Switching to Mission is currently not available"),
        ((1, 4, 99), "Unsupported auto mode"),
        ((4, 0, 0), "Switching to Mission is currently not available"),  # base mode: auto
        ((64, 0, 0), "Switching to Manual is currently not available"),
        ((80, 0, 0), "Switching to Stabilized is currently not available"),
    ],
)
def test_modes_that_need_a_pilot_or_a_mission(
    rig: Rig, params: tuple[float, ...], text: str
) -> None:
    result, messages = rig.command(176, *params)
    assert result == REJECTED
    assert text_of(messages) == [(2, text)]
    assert rig.autopilot.commands == []


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
    assert rig.command(179, 0, 0, 0, 0, 47.0, 8.0, 500.0)[0] == DENIED


def test_reboot_is_refused(rig: Rig) -> None:
    assert rig.command(246, 0)[0] == ACCEPTED  # "do nothing"
    assert rig.command(246, 1)[0] == DENIED
    rig.command(400, 1)
    assert rig.command(246, 1)[0] == DENIED


@pytest.mark.parametrize("number", [192, 16, 300, 519, 31_000])
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
    echo = RawClient(rig.bench.onboard, ids=(1, 1))
    echo.command(400, 1)
    echo.send(dialect.MAVLink_ping_message(1, 1, 0, 0))
    rig.bench.tick()
    assert rig.autopilot.arming is Arming.STANDBY
    assert not [m for m in rig.client.received() if m.get_type() in ("PING", "COMMAND_ACK")]


def test_answers_go_to_the_link_that_asked(rig: Rig) -> None:
    rig.command(400, 1)
    assert not [m for m in rig.station.received() if m.get_type() == "COMMAND_ACK"]


# --- messages on request


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
    assert rig.command(511, attitude, NAN)[0] == DENIED
    assert rig.command(511, 132, 10_000)[0] == UNSUPPORTED  # DISTANCE_SENSOR
    assert rig.command(511, NAN, 10_000)[0] == UNSUPPORTED
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
    assert interval(30) == (30, -1)
    assert interval(132) == (132, 0)
    assert rig.command(510, NAN)[0] == DENIED
    assert rig.command(510, -5)[0] == DENIED
    result, messages = rig.command(512, 244, 32)
    assert result == ACCEPTED
    (message,) = [m for m in messages if m.get_type() == "MESSAGE_INTERVAL"]
    assert (message.message_id, message.interval_us) == (32, 33_333)


@pytest.mark.parametrize("number", [148, 242, 245, 0, 1, 2, 4, 24, 30, 32, 49, 105, 111, 147, 331])
def test_requested_messages_come_before_their_acknowledgement(rig: Rig, number: int) -> None:
    rig.client.command(512, number)
    rig.bench.server.receive(rig.autopilot.time_us)
    message, ack = rig.client.received()
    assert message.get_msgId() == number
    assert (ack.get_type(), ack.result) == ("COMMAND_ACK", ACCEPTED)


@pytest.mark.parametrize("number", [435, 397, 395, 300, 264, 132, NAN])
def test_requests_for_what_we_do_not_have(rig: Rig, number: float) -> None:
    assert rig.command(512, number)[0] == UNSUPPORTED


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


# --- setpoints


@pytest.mark.parametrize(
    ("mask", "position", "velocity", "yaw", "rate"),
    [
        (2503, None, (1.0, 2.0, -3.0), 0.5, None),  # MAVSDK set_velocity_ned
        (2552, (4.0, 5.0, -6.0), None, 0.5, None),  # MAVSDK set_position_ned
        (3527, None, (1.0, 2.0, -3.0), None, None),  # velocity only
        (0xFC7, None, (1.0, 2.0, -3.0), None, None),  # with the force bit
        (0, (4.0, 5.0, -6.0), (1.0, 2.0, -3.0), 0.5, 0.25),
        (1 | 2 | 32 | 2048, (NAN, NAN, -6.0), (1.0, 2.0, NAN), 0.5, None),
    ],
)
def test_setpoint_masks(
    rig: Rig,
    mask: int,
    position: tuple[float, ...] | None,
    velocity: tuple[float, ...] | None,
    yaw: float | None,
    rate: float | None,
) -> None:
    rig.set_local(mask, x=4.0, y=5.0, z=-6.0, vx=1.0, vy=2.0, vz=-3.0, yaw=0.5, yaw_rate=0.25)
    now_us = rig.autopilot.time_us
    rig.bench.tick()
    ((setpoint, time_us),) = rig.autopilot.setpoints
    np.testing.assert_equal(setpoint.position, position or (NAN, NAN, NAN))
    np.testing.assert_equal(setpoint.velocity, velocity or (NAN, NAN, NAN))
    np.testing.assert_equal(setpoint.yaw, NAN if yaw is None else yaw)
    np.testing.assert_equal(setpoint.yaw_rate, NAN if rate is None else rate)
    assert setpoint.wire == (1.0, 2.0, -3.0, 0.5 if rate is None else 0.25)
    assert time_us == now_us


def test_body_velocity_turns_with_the_heading_only(rig: Rig) -> None:
    rig.autopilot.roll, rig.autopilot.pitch, rig.autopilot.yaw = 0.3, -0.4, math.radians(90.0)
    rig.set_local(1479, frame=8, x=9.0, vx=2.0, vy=1.0, vz=0.5, yaw=1.0, yaw_rate=0.25)
    rig.bench.tick()
    ((setpoint, _),) = rig.autopilot.setpoints
    assert setpoint.velocity == pytest.approx([-1.0, 2.0, 0.5], abs=1e-9)
    assert np.isnan(setpoint.position).all()
    assert math.isnan(setpoint.yaw)
    assert setpoint.yaw_rate == 0.25
    assert setpoint.wire == (2.0, 1.0, 0.5, 0.25)


def test_body_velocity_is_all_or_nothing(rig: Rig) -> None:
    rig.set_local(1479 | 8, frame=8, vx=2.0, vy=1.0)
    rig.bench.tick()
    assert rig.autopilot.setpoints == []
    assert text_of(rig.client.received()) == [(2, "SET_POSITION_TARGET_LOCAL_NED invalid")]


@pytest.mark.parametrize("frame", [0, 7, 9, 12, 20])
def test_other_frames_are_refused_aloud_every_time(rig: Rig, frame: int) -> None:
    for _ in range(3):
        rig.set_local(2503, frame=frame, vx=1.0)
        rig.bench.tick()
    text = f"SET_POSITION_TARGET_LOCAL_NED coordinate frame {frame} unsupported"
    assert rig.autopilot.setpoints == []
    chunks = text_of(rig.client.received())
    assert "".join(chunk for _, chunk in chunks) == 3 * text
    assert {severity for severity, _ in chunks} == {2}


@pytest.mark.parametrize("mask", [0xFFF, 0b111111, 0b1101_1111_1111, 0xC3F])
def test_masks_that_command_nothing(rig: Rig, mask: int) -> None:
    # 0xC3F commands an acceleration only, which the controller has no input for.
    rig.set_local(mask, vx=1.0, afx=1.0)
    rig.bench.tick()
    assert rig.autopilot.setpoints == []
    assert text_of(rig.client.received()) == [(2, "SET_POSITION_TARGET_LOCAL_NED invalid")]


def test_numbers_that_are_none(rig: Rig) -> None:
    rig.set_local(2503, vx=NAN, vy=1.0, vz=math.inf, yaw=NAN)
    rig.bench.tick()
    ((setpoint, _),) = rig.autopilot.setpoints
    np.testing.assert_equal(setpoint.velocity, [NAN, 1.0, NAN])
    assert math.isnan(setpoint.yaw)
    rig.set_local(2503, vx=NAN, vy=NAN, vz=NAN)
    rig.bench.tick()
    assert len(rig.autopilot.setpoints) == 1


@pytest.mark.parametrize(("target", "count"), [((0, 0), 1), ((1, 0), 1), ((2, 1), 0), ((1, 7), 0)])
def test_setpoint_addressees(rig: Rig, target: tuple[int, int], count: int) -> None:
    rig.client.send(
        dialect.MAVLink_set_position_target_local_ned_message(0, *target, 1, 3527, *[0.0] * 11)
    )
    rig.bench.tick()
    assert len(rig.autopilot.setpoints) == count


def test_offboard_loss_and_return_are_visible_in_the_heartbeat(rig: Rig) -> None:
    rig.climb()
    rig.set_local(3527, vx=1.0)
    assert rig.command(176, 129, 6, 0)[0] == ACCEPTED
    rig.bench.run(0.9)
    assert rig.autopilot.mode is Mode.OFFBOARD
    for frame in (7, 9, 12):  # refused frames are no sign of life
        rig.set_local(3527, frame=frame, vx=1.0)
        rig.bench.tick()
    rig.bench.run(2.0)
    messages = rig.client.received()
    assert (2, "Failsafe activated") in text_of(messages)
    beat = [m for m in messages if m.get_type() == "HEARTBEAT"][-1]
    assert (beat.base_mode, beat.custom_mode, beat.system_status) == (209, 196_608, 5)
    rig.set_local(3527, vx=1.0)
    rig.bench.tick()
    assert rig.autopilot.mode is Mode.OFFBOARD


# --- parameters


def read(rig: Rig, name: str = "", index: int = -1) -> list[Any]:
    request = dialect.MAVLink_param_request_read_message(1, 1, name.encode(), index)
    return [m for m in rig.exchange(request) if m.get_type().startswith("PARAM")]


def set_parameter(rig: Rig, name: str, raw: bytes, kind: int) -> list[Any]:
    (as_float,) = struct.unpack("<f", raw)
    request = dialect.MAVLink_param_set_message(1, 1, name.encode(), as_float, kind)
    return [m for m in rig.exchange(request) if m.get_type().startswith("PARAM")]


def as_int(message: Any) -> int:
    (value,) = struct.unpack("<i", bytes(message.get_msgbuf())[10:14])
    return int(value)


def test_read_by_name_and_index(rig: Rig) -> None:
    names = sorted(DEFAULT_PARAMETERS)
    for index, name in enumerate(names):
        (by_name,) = read(rig, name)
        (by_index,) = read(rig, index=index)
        for message in (by_name, by_index):
            assert (message.param_id, message.param_index) == (name, index)
            assert message.param_count == len(names)
            value = DEFAULT_PARAMETERS[name]
            if isinstance(value, int):
                assert (message.param_type, as_int(message)) == (6, value)
            else:
                assert (message.param_type, message.param_value) == (9, value)


@pytest.mark.parametrize(("name", "index"), [("NOPE", -1), ("", 99), ("", 32_767), ("", -1)])
def test_read_what_does_not_exist(rig: Rig, name: str, index: int) -> None:
    (error,) = read(rig, name, index)
    assert error.get_type() == "PARAM_ERROR"
    assert (error.error, error.param_id, error.param_index) == (1, name, index)
    assert (error.target_system, error.target_component) == CLIENT_IDS


def test_set_is_told_to_all_links(rig: Rig) -> None:
    (answer,) = set_parameter(rig, "MIS_TAKEOFF_ALT", struct.pack("<f", 7.5), 9)
    assert answer.param_value == 7.5
    assert rig.autopilot.parameters.values["MIS_TAKEOFF_ALT"] == 7.5
    (heard,) = rig.station.received("PARAM_VALUE")
    assert (heard.param_id, heard.param_value) == ("MIS_TAKEOFF_ALT", 7.5)
    (answer,) = set_parameter(rig, "MIS_TAKEOFF_ALT", struct.pack("<f", 500.0), 9)
    assert answer.param_value == 80.0  # what is stored now
    (answer,) = set_parameter(rig, "NAV_DLL_ACT", struct.pack("<i", -3), 6)
    assert as_int(answer) == -3
    assert rig.autopilot.parameters.values["NAV_DLL_ACT"] == -3


@pytest.mark.parametrize(
    ("name", "raw", "kind", "error"),
    [
        ("NOPE", struct.pack("<f", 1.0), 9, 1),
        ("SYS_AUTOSTART", struct.pack("<f", 1.0), 9, 7),
        ("MIS_TAKEOFF_ALT", struct.pack("<i", 1), 6, 7),
        ("MIS_TAKEOFF_ALT", struct.pack("<f", NAN), 9, 2),
        ("MIS_TAKEOFF_ALT", struct.pack("<f", math.inf), 9, 2),
    ],
)
def test_set_refusals(rig: Rig, name: str, raw: bytes, kind: int, error: int) -> None:
    before = dict(rig.autopilot.parameters.values)
    (answer,) = set_parameter(rig, name, raw, kind)
    assert (answer.get_type(), answer.error) == ("PARAM_ERROR", error)
    assert rig.autopilot.parameters.values == before


def test_the_full_list_is_paced_and_complete() -> None:
    rig = Rig(KinematicAutopilot(Parameters({f"P_{i:03}": float(i) for i in range(100)})))
    rig.client.send(dialect.MAVLink_param_request_list_message(1, 1))
    per_tick = []
    values: list[Any] = []
    for _ in range(60):
        rig.bench.tick()
        new = rig.client.received("PARAM_VALUE")
        per_tick.append(len(new))
        values += new
    assert max(per_tick) == 3
    assert values[0].param_id == "_HASH_CHECK"
    assert values[0].param_index == 65_535
    assert [v.param_index for v in values[1:]] == list(range(100))
    assert {v.param_count for v in values} == {100}


def px4_crc32part(data: bytes, crc: int) -> int:
    """PX4's crc32part(), bit by bit."""
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB8_8320 if crc & 1 else 0)
    return crc


def test_the_hash_is_px4s_and_stops_a_list(rig: Rig) -> None:
    (message,) = read(rig, "_HASH_CHECK")
    expected = 0
    for name, value in sorted(DEFAULT_PARAMETERS.items()):
        raw = struct.pack("<i" if isinstance(value, int) else "<f", value)
        expected = px4_crc32part(name.encode() + raw, expected)
    assert message.param_type == dialect.MAV_PARAM_TYPE_UINT32
    assert as_int(message) & 0xFFFF_FFFF == expected
    rig.client.send(dialect.MAVLink_param_request_list_message(1, 1))
    rig.bench.tick()
    assert len(rig.client.received("PARAM_VALUE")) == 3
    assert set_parameter(rig, "_HASH_CHECK", b"\0\0\0\0", 5) == []
    rig.bench.run(0.1)
    assert rig.client.received("PARAM_VALUE") == []


def test_asking_again_restarts_without_the_hash(rig: Rig) -> None:
    for _ in range(2):
        rig.client.send(dialect.MAVLink_param_request_list_message(1, 1))
        rig.bench.tick()
    rig.bench.run(0.1)
    ids = [v.param_id for v in rig.client.received("PARAM_VALUE")]
    assert ids == ["_HASH_CHECK", *sorted(DEFAULT_PARAMETERS)[:2], *sorted(DEFAULT_PARAMETERS)]


def test_parameters_of_others_are_not_ours(rig: Rig) -> None:
    for message in (
        dialect.MAVLink_param_request_list_message(2, 1),
        dialect.MAVLink_param_request_read_message(1, 42, b"NAV_DLL_ACT", -1),
        dialect.MAVLink_param_set_message(2, 1, b"MIS_TAKEOFF_ALT", 1.0, 9),
    ):
        rig.client.send(message)
    rig.bench.run(0.1)
    assert not [m for m in rig.client.received() if m.get_type().startswith("PARAM")]
    assert rig.autopilot.parameters.values == DEFAULT_PARAMETERS


# --- time, ping, mission, files, heartbeats


def test_timesync_answers_in_our_time(rig: Rig) -> None:
    rig.client.send(dialect.MAVLink_timesync_message(0, 123_456_789))
    now_us = rig.autopilot.time_us
    rig.bench.server.receive(now_us)
    (answer,) = rig.client.received("TIMESYNC")
    assert (answer.tc1, answer.ts1) == (now_us * 1000, 123_456_789)
    rig.client.send(dialect.MAVLink_timesync_message(5, now_us * 1000))
    rig.bench.server.receive(now_us)
    assert rig.client.received("TIMESYNC") == []


def test_timesync_requests_carry_our_time(rig: Rig) -> None:
    rig.bench.run(1.0)
    stamps = [m.ts1 for m in rig.client.received("TIMESYNC") if m.tc1 == 0]
    assert np.diff(stamps) == pytest.approx(1e8)


def test_ping(rig: Rig) -> None:
    rig.client.send(dialect.MAVLink_ping_message(42, 7, 0, 0))
    rig.client.send(dialect.MAVLink_ping_message(42, 8, 1, 1))  # an answer
    rig.client.send(dialect.MAVLink_ping_message(42, 9, 5, 5))
    rig.bench.server.receive(rig.autopilot.time_us)
    (answer,) = rig.client.received("PING")
    assert (answer.time_usec, answer.seq) == (42, 7)
    assert (answer.target_system, answer.target_component) == CLIENT_IDS
    rig.bench.run(3.0)
    assert np.diff([m.seq for m in rig.client.received("PING")]).tolist() == [1, 1]


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_there_are_no_missions(rig: Rig, kind: int) -> None:
    def ask(message: Any, answer: str) -> Any:
        (found,) = [m for m in rig.exchange(message) if m.get_type() == answer]
        assert (found.target_system, found.target_component) == CLIENT_IDS
        assert found.mission_type == kind
        return found

    listed = ask(dialect.MAVLink_mission_request_list_message(1, 1, kind), "MISSION_COUNT")
    assert listed.count == 0
    for message, result in (
        (dialect.MAVLink_mission_count_message(1, 1, 3, kind), 3),  # UNSUPPORTED
        (dialect.MAVLink_mission_count_message(1, 190, 0, kind), 0),
        (dialect.MAVLink_mission_clear_all_message(1, 0, kind), 0),
        (dialect.MAVLink_mission_request_int_message(1, 1, 0, kind), 13),  # INVALID_SEQUENCE
        (dialect.MAVLink_mission_write_partial_list_message(1, 1, 0, 1, kind), 3),
    ):
        assert ask(message, "MISSION_ACK").type == result
    assert not [
        m
        for m in rig.exchange(dialect.MAVLink_mission_request_list_message(2, 1, kind))
        if m.get_type() == "MISSION_COUNT"
    ]


@pytest.mark.parametrize("opcode", [0, 1, 2, 3, 4, 14, 15])
def test_there_are_no_files(rig: Rig, opcode: int) -> None:
    body = struct.pack("<HBBBBBxI", 65_535, 4, opcode, 5, 0, 0, 0) + b"@PARA"
    message = dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, list(body.ljust(251, b"\0")))
    (answer,) = [m for m in rig.exchange(message) if m.get_type() == "FILE_TRANSFER_PROTOCOL"]
    sequence, session, code, size, asked, _, _ = struct.unpack_from(
        "<HBBBBBxI", bytes(answer.payload)
    )
    assert (sequence, session, code, size, asked) == (0, 4, 129, 1, opcode)
    assert answer.payload[12] == 7  # unknown command


def test_answers_about_files_are_not_answered(rig: Rig) -> None:
    for opcode in (128, 129):
        body = struct.pack("<HBBBBBxI", 1, 0, opcode, 0, 0, 0, 0).ljust(251, b"\0")
        message = dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, list(body))
        assert not [m for m in rig.exchange(message) if m.get_type() == "FILE_TRANSFER_PROTOCOL"]


def test_only_ground_stations_heartbeats_count(rig: Rig) -> None:
    for kind in (dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_TYPE_GCS):
        rig.client.send(dialect.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3))
        rig.bench.tick()
    assert rig.autopilot.gcs_heartbeats == [rig.autopilot.time_us - TICK_US]


# --- texts


@pytest.mark.parametrize("length", [0, 1, 49, 50, 51, 99, 100, 101, 250])
def test_long_texts_come_in_chunks(length: int) -> None:
    text = "".join(chr(ord("a") + i % 26) for i in range(length))
    encoder = TextEncoder()
    first = encoder.encode(Message(Severity.ERROR, text))
    second = encoder.encode(Message(Severity.ERROR, text))
    parser = dialect.MAVLink(None)
    received = [parser.parse_buffer(m.pack(dialect.MAVLink(None, 1, 1)))[0] for m in first]
    assert {m.severity for m in received} == {3}
    assert "".join(m.text for m in received) == text
    if length <= 50:
        assert (len(received), received[0].id) == (1, 0)
        return
    # The MAVLink rule: same id, counted chunks, a NUL in the last one and in no other.
    assert {m.id for m in received} == {1}
    assert {m.id for m in second} == {2}
    assert [m.chunk_seq for m in received] == list(range(len(received)))
    full = [len(m.text) == 50 for m in received]
    assert full == [True] * (len(received) - 1) + [False]


def test_text_ids_are_never_zero() -> None:
    encoder = TextEncoder()
    encoder._id = 65_534
    ids = [encoder.encode(Message(Severity.INFO, "x" * 60))[0].id for _ in range(3)]
    assert ids == [65_535, 1, 2]


def test_texts_beyond_ascii_stay_readable() -> None:
    (message,) = TextEncoder().encode(Message(Severity.INFO, "80 µs"))
    assert message.text == "80 ?s"


# --- a new episode


def test_a_new_autopilot_takes_over_the_links(rig: Rig) -> None:
    rig.command(511, dialect.MAVLINK_MSG_ID_ATTITUDE, 20_000)
    rig.client.send(dialect.MAVLink_param_request_list_message(1, 1))
    rig.bench.tick()
    rig.autopilot.messages.append(Message(Severity.INFO, "from the old flight"))
    rig.set_local(3527, frame=7, vx=1.0)
    rig.bench.server.receive(rig.autopilot.time_us)  # leaves a text that was not sent
    rig.set_local(3527, vx=1.0)  # arrives too late for the old, must not reach the new
    rig.client.received()

    fresh = KinematicAutopilot()  # time starts at 0 again
    rig.bench.autopilot = fresh
    rig.bench.server.attach(fresh)
    rig.bench.run(2.0)
    messages = rig.client.received()
    names = [m.get_type() for m in messages]
    assert messages[0].get_type() == "HEARTBEAT"
    assert fresh.setpoints == []
    assert text_of(messages) == []
    assert "PARAM_VALUE" not in names
    assert names.count("ATTITUDE") == 100  # the client's rate stays
    assert names.count("HEARTBEAT") == 2
    assert names.count("GPS_GLOBAL_ORIGIN") == 1
    rig.autopilot = fresh
    assert rig.command(400, 1)[0] == ACCEPTED
    assert fresh.arming is Arming.ARMED


def test_without_an_autopilot_the_vehicle_is_off() -> None:
    bench = Bench()
    client = RawClient(bench.onboard)
    bench.server._port = None
    for session in bench.server._sessions:
        session.context = None
    client.command(400, 1)
    assert bench.server.receive(0) == 0
    bench.server.send(0)
    assert client.received() == []
    assert bench.server.counters()["onboard"].ignored == 1
    bench.server.attach(bench.autopilot)
    bench.run(1.0)
    assert client.count()["HEARTBEAT"] == 1
    assert bench.autopilot.landed is Landed.ON_GROUND


def test_counters(rig: Rig) -> None:
    start = rig.bench.server.counters()["onboard"]
    rig.client.send(dialect.MAVLink_ping_message(1, 1, 0, 0))
    rig.client.send(dialect.MAVLink_rc_channels_message(0, *[0] * 20))
    rig.bench.onboard.inbox.append(b"noise")
    rig.bench.run(1.0)
    end = rig.bench.server.counters()["onboard"]
    assert end.rx - start.rx == 2
    assert end.ignored - start.ignored == 1
    assert end.malformed - start.malformed == 1
    assert end.tx - start.tx == sum(rig.client.count().values())
    assert end.send_errors == 0
    assert rig.bench.server.filenos() == []


def test_binascii_agrees_with_the_reference_crc() -> None:
    # zlib's CRC-32 is PX4's with both inversions: pins the reference above.
    assert px4_crc32part(b"123456789", 0xFFFF_FFFF) ^ 0xFFFF_FFFF == binascii.crc32(b"123456789")
