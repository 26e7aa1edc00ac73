"""SET_POSITION_TARGET_LOCAL_NED as a real PX4 1.16 was measured to read it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from firmware_sim.autopilot.autopilot_state import Mode
from tests.support.mavlink_clients import Rig, text_of

NAN = math.nan
ACCEPTED = 0


@pytest.fixture
def rig() -> Rig:
    return Rig()


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
