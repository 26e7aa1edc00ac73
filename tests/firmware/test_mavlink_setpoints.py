"""SET_POSITION_TARGET_LOCAL_NED as a real PX4 1.16 was measured to read it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.control.demand import AttitudeDemand, RateDemand
from airl_mav.core.frames import local_to_geodetic
from firmware_sim.autopilot.flight_modes import Mode
from tests.support.kinematic_autopilot import ORIGIN
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
def test_other_frames_are_refused_aloud_once(rig: Rig, frame: int) -> None:
    for _ in range(3):
        rig.set_local(2503, frame=frame, vx=1.0)
        rig.bench.tick()
    text = f"SET_POSITION_TARGET_LOCAL_NED coordinate frame {frame} unsupported"
    assert rig.autopilot.setpoints == []
    chunks = text_of(rig.client.received())
    assert "".join(chunk for _, chunk in chunks) == text
    assert {severity for severity, _ in chunks} == {2}
    assert rig.autopilot.refusals[-1][0] == text
    # After an accepted setpoint the refusal is reported again.
    rig.set_local(2503, vx=1.0)
    rig.set_local(2503, frame=frame, vx=1.0)
    rig.bench.tick()
    assert "".join(chunk for _, chunk in text_of(rig.client.received())) == text


@pytest.mark.parametrize("mask", [0xFFF, 0b1101_1111_1111])
def test_masks_that_command_nothing(rig: Rig, mask: int) -> None:
    rig.set_local(mask, vx=1.0, afx=1.0)
    rig.bench.tick()
    assert rig.autopilot.setpoints == []
    assert text_of(rig.client.received()) == [(2, "SET_POSITION_TARGET_LOCAL_NED invalid")]


def test_accelerations_alone_and_on_top(rig: Rig) -> None:
    rig.set_local(0xC3F, vx=9.0, afx=1.0, afy=2.0, afz=-3.0)  # MAVSDK set_acceleration_ned
    rig.set_local(0b1100_0000_0111, vx=9.0, afx=1.0)
    rig.autopilot.yaw = math.radians(90.0)
    rig.set_local(0xC3F, frame=8, afx=1.0, afz=0.5)
    rig.bench.tick()
    alone, both, body = (setpoint for setpoint, _ in rig.autopilot.setpoints)
    assert list(alone.acceleration) == [1.0, 2.0, -3.0]
    assert np.isnan([*alone.position, *alone.velocity]).all()
    assert (list(both.velocity), list(both.acceleration)) == ([9.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    assert body.acceleration == pytest.approx([0.0, 1.0, 0.5], abs=1e-9)


def test_a_force_is_not_supported(rig: Rig) -> None:
    rig.set_local(0xE3F, afx=1.0)
    rig.bench.tick()
    assert rig.autopilot.setpoints == []
    said = "".join(text for _, text in text_of(rig.client.received()))
    assert said == "SET_POSITION_TARGET_LOCAL_NED force not supported"


GLOBAL = dialect.MAVLink_set_position_target_global_int_message


@pytest.mark.parametrize(("frame", "altitude"), [(5, ORIGIN.altitude_m + 7.0), (6, 7.0)])
def test_global_positions(rig: Rig, frame: int, altitude: float) -> None:
    place = local_to_geodetic(np.array([30.0, -20.0, 0.0]), ORIGIN)
    where = round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7)
    rig.client.send(GLOBAL(0, 1, 1, frame, 0xDF8, *where, altitude, *[0.0] * 6, 0.0, 0.0))
    rig.bench.tick()
    ((setpoint, _),) = rig.autopilot.setpoints
    assert setpoint.position == pytest.approx([30.0, -20.0, -7.0], abs=0.02)
    assert np.isnan([*setpoint.velocity, *setpoint.acceleration]).all()


def test_global_positions_in_other_frames(rig: Rig) -> None:
    """Above terrain PX4 drops them silently: nothing measures the terrain."""
    for frame in (11, 1, 1):
        rig.client.send(GLOBAL(0, 1, 1, frame, 0xDF8, 473977430, 85455940, 5.0, *[0.0] * 8))
    rig.bench.tick()
    assert rig.autopilot.setpoints == []
    said = "".join(text for _, text in text_of(rig.client.received()))
    assert said == "SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame 1"


def send_attitude(rig: Rig, mask: int, q: tuple[float, ...], *rates_thrust: float) -> None:
    rig.client.send(dialect.MAVLink_set_attitude_target_message(0, 1, 1, mask, q, *rates_thrust))
    rig.bench.tick()


def test_attitudes_and_body_rates(rig: Rig) -> None:
    send_attitude(rig, 7, (2.0, 0.0, 0.0, 0.0), 9.0, 9.0, 9.0, 0.5)  # MAVSDK set_attitude
    send_attitude(rig, 0, (0.6, 0.8, 0.0, 0.0), 9.0, 9.0, 0.25, 1.5)
    send_attitude(rig, 128, (0.0, 0.0, 0.0, 0.0), 0.1, -0.2, 0.3, 0.4)  # set_attitude_rate
    send_attitude(rig, 128 | 4 | 64, (0.0, 0.0, 0.0, 0.0), 0.1, -0.2, 0.3, 0.4)
    level, rolled, rates, open_yaw = (demand for demand, _ in rig.autopilot.attitudes)
    assert level == AttitudeDemand((1.0, 0.0, 0.0, 0.0), 0.0, 0.5)
    assert isinstance(rolled, AttitudeDemand)
    assert rolled.attitude == pytest.approx((0.6, 0.8, 0.0, 0.0))
    assert (rolled.yaw_rate, rolled.thrust) == (0.25, 1.0)
    assert isinstance(rates, RateDemand)
    assert (*rates.rates, rates.thrust) == pytest.approx((0.1, -0.2, 0.3, 0.4))
    assert isinstance(open_yaw, RateDemand)
    assert math.isnan(open_yaw.rates[2])
    assert open_yaw.thrust == 0.0
    # Latency analysis recognises setpoints by angles or rates, and thrust.
    roll = 2.0 * math.atan2(0.8, 0.6)
    assert rig.autopilot.wires[0] == pytest.approx((0.0, 0.0, 0.0, 0.5))
    assert rig.autopilot.wires[1] == pytest.approx((roll, 0.0, 0.0, 1.0), abs=1e-6)
    assert rig.autopilot.wires[2] == pytest.approx((0.1, -0.2, 0.3, 0.4))


def test_an_attitude_that_commands_nothing_is_no_setpoint(rig: Rig) -> None:
    send_attitude(rig, 128 | 1, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.5)
    send_attitude(rig, 7, (0.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.5)
    send_attitude(rig, 7, (NAN, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.5)
    assert rig.autopilot.attitudes == []


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
