"""The real MAVSDK against the MAVLink side, in process (raw://) and over UDP."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from mavsdk import ComponentType
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.action import Action
from mavsdk.plugins.info import Info
from mavsdk.plugins.mission_raw import MissionRaw
from mavsdk.plugins.offboard import (
    Offboard,
    PositionNedYaw,
    VelocityBodyYawspeed,
    VelocityNedYaw,
)
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import FlightMode, LandedState, Telemetry
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import HOME
from firmware_sim.autopilot.autopilot_state import Arming, OperatorText, Setpoint, Severity
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.interfaces import TrueState
from firmware_sim.mavlink.endpoint import UdpEndpoint
from tests.support.kinematic_autopilot import DEFAULT_PARAMETERS, ORIGIN, KinematicAutopilot
from tests.support.mavlink_clients import (
    BOOT_UNIX_US,
    PATIENT_US,
    Companion,
    Pacer,
    RawLane,
    mavsdk_over_memory,
    mavsdk_over_udp,
    wait_for,
)


def failure(call: Callable[[], Any]) -> str:
    """Return the name of the result that a MAVSDK call failed with."""
    with pytest.raises(MavsdkError) as caught:
        call()
    return str(caught.value).split(";")[0]


def ready(companion: Companion) -> Telemetry:
    """Return telemetry once the vehicle reports itself healthy."""
    telemetry = companion.plugin(Telemetry)
    wait_for(telemetry.health_all_ok)
    return telemetry


def last_setpoint(pacer: Pacer) -> Setpoint:
    with pacer.lock:
        return pacer.bench.autopilot.setpoints[-1][0]


def fly(companion: Companion, pacer: Pacer) -> None:
    """A whole flight: arm, take off, offboard in three ways, land."""
    telemetry = ready(companion)
    action, offboard = companion.plugin(Action), companion.plugin(Offboard)
    assert failure(offboard.start) == "NO_SETPOINT_SET"
    action.arm()
    wait_for(telemetry.armed)
    action.takeoff()
    wait_for(lambda: telemetry.flight_mode() == FlightMode.TAKEOFF)
    wait_for(lambda: telemetry.flight_mode() == FlightMode.HOLD and telemetry.in_air())
    assert failure(action.disarm) == "COMMAND_DENIED"

    offboard.set_velocity_ned(VelocityNedYaw(1.0, 2.0, -0.5, 90.0))
    offboard.start()
    wait_for(lambda: telemetry.flight_mode() == FlightMode.OFFBOARD)

    def velocity() -> list[float]:
        v = telemetry.position_velocity_ned().velocity
        return [v.north_m_s, v.east_m_s, v.down_m_s]

    wait_for(lambda: velocity() == pytest.approx([1.0, 2.0, -0.5], abs=1e-3))
    setpoint = last_setpoint(pacer)
    np.testing.assert_allclose(setpoint.velocity, [1.0, 2.0, -0.5])
    assert setpoint.yaw == pytest.approx(math.pi / 2)
    assert math.isnan(setpoint.yaw_rate)
    assert setpoint.wire == pytest.approx((1.0, 2.0, -0.5, math.pi / 2))

    offboard.set_velocity_body(VelocityBodyYawspeed(2.0, 1.0, 0.0, 0.0))
    wait_for(lambda: velocity() == pytest.approx([-1.0, 2.0, 0.0], abs=1e-3))
    offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 30.0))
    wait_for(lambda: last_setpoint(pacer).yaw_rate == pytest.approx(math.radians(30.0)))
    assert last_setpoint(pacer).wire == pytest.approx((0.0, 0.0, 0.0, math.radians(30.0)))
    rate = telemetry.attitude_angular_velocity_body
    wait_for(lambda: rate().yaw_rad_s == pytest.approx(math.radians(30.0), abs=1e-6))

    offboard.set_position_ned(PositionNedYaw(3.0, 4.0, -5.0, 0.0))

    def position() -> list[float]:
        p = telemetry.position_velocity_ned().position
        return [p.north_m, p.east_m, p.down_m]

    wait_for(lambda: position() == pytest.approx([3.0, 4.0, -5.0], abs=0.01))
    np.testing.assert_allclose(last_setpoint(pacer).position, [3.0, 4.0, -5.0])

    offboard.stop()
    wait_for(lambda: telemetry.flight_mode() == FlightMode.HOLD)
    action.land()
    wait_for(lambda: telemetry.landed_state() == LandedState.LANDING)
    wait_for(lambda: not telemetry.armed() and not telemetry.in_air())


@pytest.mark.nightly  # Over UDP: below; in memory: test_px4_walk.py.
def test_a_whole_flight_in_memory() -> None:
    with mavsdk_over_memory() as (companion, pacer):
        fly(companion, pacer)
    counters = pacer.bench.server.counters()["onboard"]
    assert (counters.malformed, counters.send_errors) == (0, 0)


def test_a_whole_flight_over_udp() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    endpoint = UdpEndpoint(
        ("127.0.0.1", 0), ("127.0.0.1", port), local_option="--a", remote_option="--b"
    )
    with mavsdk_over_udp(endpoint, f"udpin://127.0.0.1:{port}") as (companion, pacer):
        assert len(pacer.bench.server.filenos()) == 1
        fly(companion, pacer)
    counters = pacer.bench.server.counters()["onboard"]
    assert (counters.malformed, counters.send_errors) == (0, 0)
    assert counters.rx > 10


def test_health_and_identity() -> None:
    with mavsdk_over_memory() as (companion, _):
        health = ready(companion).health()
        assert health.is_armable
        assert health.is_home_position_ok
        info = companion.plugin(Info)
        version = info.get_version()
        assert (version.flight_sw_major, version.flight_sw_minor) == (1, 17)
        assert info.get_identification().legacy_uid != 0


def test_a_booting_vehicle_is_neither_healthy_nor_armable() -> None:
    autopilot = KinematicAutopilot()
    autopilot.ready_us = 10**12
    with mavsdk_over_memory(autopilot=autopilot) as (companion, _):
        telemetry, action = companion.plugin(Telemetry), companion.plugin(Action)
        wait_for(lambda: telemetry.health().is_accelerometer_calibration_ok)
        assert not telemetry.health().is_armable
        assert not telemetry.health_all_ok()
        assert failure(action.arm) == "COMMAND_DENIED"
        with_text = telemetry.status_text
        wait_for(lambda: with_text().text == "Arming denied: Resolve system health failures first")


def test_telemetry_is_what_the_autopilot_says() -> None:
    with mavsdk_over_memory() as (companion, pacer):
        telemetry = ready(companion)
        with pacer.lock:
            autopilot = pacer.bench.autopilot
            autopilot.frozen = True
            autopilot.position = np.array([12.5, -7.25, -3.5])
            autopilot.velocity = np.array([1.5, -0.5, 0.25])
            autopilot.roll, autopilot.pitch, autopilot.yaw = 0.1, -0.2, -1.25
            autopilot.yaw_rate = 0.4
            truth = autopilot.state()
        wait_for(lambda: telemetry.position_velocity_ned().position.north_m == 12.5)
        # The slowest stream used below comes every two simulated seconds.
        start_us = truth.time_us

        def settled() -> bool:
            with pacer.lock:
                return pacer.bench.autopilot.time_us > start_us + 3 * US_PER_S

        wait_for(settled)
        local = telemetry.position_velocity_ned()
        p, v = local.position, local.velocity
        assert [p.north_m, p.east_m, p.down_m] == [12.5, -7.25, -3.5]
        assert [v.north_m_s, v.east_m_s, v.down_m_s] == [1.5, -0.5, 0.25]
        world = telemetry.position()
        assert world.relative_altitude_m == pytest.approx(3.5)
        assert world.absolute_altitude_m == pytest.approx(492.9, abs=1e-3)
        metres_north = math.radians(world.latitude_deg - ORIGIN.latitude_deg) * 6_371_000.0
        assert metres_north == pytest.approx(12.5, abs=0.02)
        ned = telemetry.velocity_ned()
        assert [ned.north_m_s, ned.east_m_s, ned.down_m_s] == pytest.approx([1.5, -0.5, 0.25])
        euler = telemetry.attitude_euler()
        degrees = [euler.roll_deg, euler.pitch_deg, euler.yaw_deg]
        assert degrees == pytest.approx(np.degrees([0.1, -0.2, -1.25]), abs=1e-4)
        q = telemetry.attitude_quaternion()
        assert [q.w, q.x, q.y, q.z] == pytest.approx(truth.estimate.quaternion, abs=1e-6)
        body = telemetry.odometry().velocity_body
        speed = math.hypot(body.x_m_s, body.y_m_s, body.z_m_s)
        assert speed == pytest.approx(math.sqrt(1.5**2 + 0.5**2 + 0.25**2), abs=1e-5)
        assert telemetry.heading().heading_deg == pytest.approx(
            360.0 - math.degrees(1.25), abs=0.01
        )
        imu = telemetry.imu()
        accel = imu.acceleration_frd
        got = [accel.forward_m_s2, accel.right_m_s2, accel.down_m_s2]
        assert got == pytest.approx(truth.accel - truth.estimate.accel_bias, abs=1e-5)
        assert imu.magnetic_field_frd.down_gauss == pytest.approx(0.43)
        battery = telemetry.battery()
        assert battery.voltage_v == pytest.approx(15.8)
        assert battery.current_battery_a == pytest.approx(12.34)
        assert battery.capacity_consumed_ah == pytest.approx(0.456)
        assert battery.remaining_percent == pytest.approx(83.0)
        gps = telemetry.raw_gps()
        assert gps.horizontal_uncertainty_m == pytest.approx(0.9)
        assert gps.velocity_m_s == pytest.approx(math.hypot(1.5, 0.5), abs=0.01)
        assert telemetry.gps_info().num_satellites == 10
        home = telemetry.home()
        assert home.latitude_deg == pytest.approx(ORIGIN.latitude_deg, abs=1e-7)
        assert home.absolute_altitude_m == pytest.approx(489.4)
        altitude = telemetry.altitude()
        assert altitude.altitude_local_m == 3.5
        assert math.isnan(altitude.altitude_terrain_m)
        assert telemetry.scaled_pressure().absolute_pressure_hpa == pytest.approx(954.61)
        assert telemetry.unix_epoch_time() >= BOOT_UNIX_US + start_us
        origin = telemetry.get_gps_global_origin()
        assert origin.altitude_m == pytest.approx(489.4)


@pytest.mark.parametrize(
    ("method", "name", "rate_hz"),
    [
        ("set_rate_position_velocity_ned", "LOCAL_POSITION_NED", 100.0),
        ("set_rate_attitude_euler", "ATTITUDE", 20.0),
        ("set_rate_imu", "HIGHRES_IMU", 250.0),
        ("set_rate_altitude", "ALTITUDE", 40.0),
    ],
)
def test_rates_can_be_set(method: str, name: str, rate_hz: float) -> None:
    number = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
    with mavsdk_over_memory() as (companion, pacer):
        lane = pacer.bench.onboard
        assert isinstance(lane, RawLane)
        getattr(ready(companion), method)(rate_hz)

        def reading() -> tuple[int, int]:
            with pacer.lock:
                return pacer.bench.autopilot.time_us, lane.sent[number]

        start_us, start = reading()
        wait_for(lambda: reading()[0] >= start_us + US_PER_S)
        end_us, end = reading()
        assert end - start == pytest.approx((end_us - start_us) / US_PER_S * rate_hz, abs=1.01)


def test_parameters() -> None:
    with mavsdk_over_memory() as (companion, pacer):
        param = companion.plugin(Param)
        assert param.get_param_int("SYS_AUTOSTART") == 4001
        assert param.get_param_int("TEST_NEGATIVE") == -1
        assert param.get_param_float("MIS_TAKEOFF_ALT") == 2.5
        # All of these have bit patterns that a float would garble or cut.
        for value in (0, 1, -1, -5_000_000, 2_139_095_041, 2**31 - 1, -(2**31), 256):
            param.set_param_int("TEST_SIGNALLING", value)
            assert param.get_param_int("TEST_SIGNALLING") == value
            with pacer.lock:
                assert pacer.bench.autopilot.parameters.values["TEST_SIGNALLING"] == value
        param.set_param_float("MIS_TAKEOFF_ALT", 7.25)
        assert param.get_param_float("MIS_TAKEOFF_ALT") == 7.25
        everything = param.get_all_params()
        ints = {p.name: p.value for p in everything.int_params}
        floats = {p.name: p.value for p in everything.float_params}
        with pacer.lock:
            stored = dict(pacer.bench.autopilot.parameters.values)
        assert ints | floats == stored
        assert set(ints) == {n for n, v in DEFAULT_PARAMETERS.items() if isinstance(v, int)}

        assert failure(lambda: param.get_param_int("NOPE")) == "DOES_NOT_EXIST"
        assert failure(lambda: param.set_param_float("NOPE", 1.0)) == "DOES_NOT_EXIST"
        assert failure(lambda: param.set_param_float("SYS_AUTOSTART", 1.0)) == "TYPE_MISMATCH"
        nan = math.nan
        assert failure(lambda: param.set_param_float("COM_OF_LOSS_T", nan)) == "VALUE_OUT_OF_RANGE"


def test_refusals_come_at_once_and_by_name() -> None:
    with mavsdk_over_memory() as (companion, pacer):
        telemetry, action = ready(companion), companion.plugin(Action)
        assert failure(action.reboot) == "COMMAND_DENIED"
        telemetry.set_rate_distance_sensor(10.0)  # PX4 takes a rate for a device that it lacks
        assert failure(lambda: telemetry.set_rate_raw_imu(5.0)) == "UNKNOWN"  # and not this one
        companion.plugin(MissionRaw).clear_mission()
        action.arm()
        # MAVSDK 4.1 sends force-disarm here; the vehicle obeys.
        action.arm_force()
        with pacer.lock:
            assert pacer.bench.autopilot.commands[-1] == "disarm force=True"
            assert pacer.bench.autopilot.arming is Arming.STANDBY


def test_a_setpoint_is_repeated_by_mavsdk_and_keeps_offboard_alive() -> None:
    with mavsdk_over_memory() as (companion, pacer):
        telemetry, offboard = ready(companion), companion.plugin(Offboard)
        offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
        offboard.start()
        companion.plugin(Action).arm()
        wait_for(telemetry.armed)

        def simulated_us() -> int:
            with pacer.lock:
                return pacer.bench.autopilot.time_us

        start_us = simulated_us()
        wait_for(lambda: simulated_us() > start_us + 2 * PATIENT_US)
        with pacer.lock:
            assert pacer.bench.autopilot.mode is Mode.OFFBOARD


def test_long_texts_arrive_whole() -> None:
    text = "Preflight Fail: " + "x" * 84  # exactly two chunks: needs the empty third
    with mavsdk_over_memory() as (companion, pacer):
        telemetry = ready(companion)
        with pacer.lock:
            pacer.bench.autopilot.messages.append(OperatorText(Severity.ERROR, text))
        wait_for(lambda: telemetry.status_text().text == text)


def test_a_ground_stations_heartbeat_reaches_the_autopilot() -> None:
    with mavsdk_over_memory(ComponentType.GROUND_STATION) as (companion, pacer):
        ready(companion)

        def heard() -> bool:
            with pacer.lock:
                return bool(pacer.bench.autopilot.gcs_heartbeats)

        wait_for(heard)


def test_the_true_state_is_there_for_who_asks() -> None:
    """MAVSDK's ground truth: PX4 SITL has it, too."""
    with mavsdk_over_memory() as (companion, pacer):
        telemetry = companion.plugin(Telemetry)
        still = np.zeros(3)
        with pacer.lock:
            truth = TrueState(0, np.array([0.0, 0.0, -30.0]), still, np.eye(4)[0], still, 0.0, 1.0)
            pacer.bench.server.attach(pacer.bench.autopilot, lambda: truth)
        assert math.isnan(telemetry.ground_truth().latitude_deg)
        telemetry.set_rate_ground_truth(20.0)
        above = pytest.approx(HOME.altitude_m + 30.0, abs=0.01)
        wait_for(lambda: telemetry.ground_truth().absolute_altitude_m == above)
        assert telemetry.ground_truth().latitude_deg == pytest.approx(HOME.latitude_deg)
