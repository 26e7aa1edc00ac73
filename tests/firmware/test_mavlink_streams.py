"""Streamed messages: rates, units, unknown values, against scipy, ISA and a measured PX4."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as dialect
from scipy.spatial.transform import Rotation

from airl_mav.core.constants import EARTH_RADIUS_M, GRAVITY_M_S2, TICK_US, US_PER_S
from airl_mav.profiles.px4_release import px4_release
from firmware_sim.autopilot.autopilot_state import Arming, Health, Landed, Setpoint
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.interfaces import BatterySample
from firmware_sim.mavlink.message_rates import OFF, StreamScheduler
from firmware_sim.mavlink.services.commands import requested_mode
from firmware_sim.mavlink.streams import status, units
from firmware_sim.mavlink.streams.status import base_mode, system_status, time_estimate_to_target
from tests.support.kinematic_autopilot import ORIGIN, KinematicAutopilot
from tests.support.mavlink_clients import BOOT_UNIX_US, Bench, RawClient

# Measured on PX4 1.16 SITL, messages per second (names that pymavlink's dialect lacks left out).
MEASURED_ONBOARD = {
    "ATTITUDE": 100, "GLOBAL_POSITION_INT": 50, "HIGHRES_IMU": 50, "ATTITUDE_QUATERNION": 50,
    "LOCAL_POSITION_NED": 30, "ODOMETRY": 30, "TIMESYNC": 10, "ALTITUDE": 10,
    "ATTITUDE_TARGET": 10, "POSITION_TARGET_LOCAL_NED": 10, "SERVO_OUTPUT_RAW": 10, "VFR_HUD": 10,
    "GPS_RAW_INT": 10, "EXTENDED_SYS_STATE": 5, "SYS_STATUS": 5, "HEARTBEAT": 1,
    "ESTIMATOR_STATUS": 1, "PING": 1, "SCALED_PRESSURE": 1, "SYSTEM_TIME": 1,
    "MISSION_CURRENT": 1, "BATTERY_STATUS": 0.5, "HOME_POSITION": 0.5, "VIBRATION": 0.5,
    "CURRENT_MODE": 0.5, "TIME_ESTIMATE_TO_TARGET": 0.5, "ESC_INFO": 10, "ESC_STATUS": 10,
}  # fmt: skip
MEASURED_GCS = {
    "ATTITUDE_TARGET": 50, "GLOBAL_POSITION_INT": 50, "SERVO_OUTPUT_RAW": 50, "ATTITUDE": 50,
    "ATTITUDE_QUATERNION": 50, "LOCAL_POSITION_NED": 50, "POSITION_TARGET_LOCAL_NED": 50,
    "GPS_RAW_INT": 5, "VFR_HUD": 4, "HEARTBEAT": 1, "ALTITUDE": 1, "EXTENDED_SYS_STATE": 1,
    "SCALED_PRESSURE": 1, "SYS_STATUS": 1, "MISSION_CURRENT": 1, "BATTERY_STATUS": 0.5,
    "ESTIMATOR_STATUS": 0.5, "HOME_POSITION": 0.5, "PING": 0.1, "VIBRATION": 0.1,
    "CURRENT_MODE": 0.5, "TIME_ESTIMATE_TO_TARGET": 0.5, "ESC_INFO": 1, "ESC_STATUS": 1,
}  # fmt: skip


def flown() -> KinematicAutopilot:
    """An autopilot in a state where every value differs from every other."""
    autopilot = KinematicAutopilot()
    for _ in range(30):
        autopilot.step()
    autopilot.position = np.array([12.5, -7.25, -3.5])
    autopilot.velocity = np.array([1.5, -0.5, 0.25])
    autopilot.roll, autopilot.pitch, autopilot.yaw = 0.1, -0.2, -1.25
    autopilot.yaw_rate = 0.4
    return autopilot


def newest(autopilot: KinematicAutopilot, name: str) -> Any:
    """Return the first message of that name that the onboard link sends."""
    bench = Bench(autopilot=autopilot)
    client = RawClient(bench.memory)
    client.command(
        dialect.MAV_CMD_REQUEST_MESSAGE, getattr(dialect, f"MAVLINK_MSG_ID_{name}"), 0, 0, 0, 0, 0
    )
    bench.server.receive(autopilot.time_us)
    (message,) = client.received(name)
    return message


# --- rates


def test_rates_are_exactly_those_of_a_real_px4() -> None:
    bench = Bench()
    onboard, gcs = RawClient(bench.memory), RawClient(bench.gcs)
    bench.run(10.0)
    onboard.count()
    gcs.count()
    seconds = 20
    bench.run(seconds)
    # Not a stream with an adjustable rate: its period is slightly more than three seconds.
    events = {"CURRENT_EVENT_SEQUENCE": 6}
    streams = {name: hz * seconds for name, hz in MEASURED_ONBOARD.items()}
    assert onboard.count() == {**streams, **events}
    streams = {name: hz * seconds for name, hz in MEASURED_GCS.items()}
    assert gcs.count() == {**streams, **events}


def test_streams_start_with_a_heartbeat_in_the_first_tick_and_spread_out() -> None:
    bench = Bench()
    client = RawClient(bench.memory)
    per_tick = []
    for _ in range(250):
        bench.tick()
        per_tick.append([m.get_type() for m in client.received()])
    assert per_tick[0][0] == "HEARTBEAT"
    assert max(map(len, per_tick)) <= 8


@given(
    interval=st.integers(1, 2_000_000),
    first=st.integers(0, 10**9),
    ticks=st.integers(1, 400),
)
def test_a_stream_drifts_never(interval: int, first: int, ticks: int) -> None:
    scheduler = StreamScheduler(["A"], {})
    scheduler.set_interval("A", interval, first)
    sent = [t for t in range(first, first + ticks * TICK_US, TICK_US) if scheduler.due(t)]
    if interval <= TICK_US:
        assert len(sent) == ticks
    else:
        # The k-th message leaves in the first tick at or after first + k * interval.
        due = range(first, first + (ticks - 1) * TICK_US + 1, interval)
        assert sent == [first - (-(d - first) // TICK_US) * TICK_US for d in due]


def test_a_stream_that_fell_behind_skips_and_keeps_its_phase() -> None:
    scheduler = StreamScheduler(["A"], {"A": 10_000})
    assert scheduler.due(0) == ["A"]
    assert scheduler.due(57_000) == ["A"]
    assert scheduler.due(59_999) == []
    assert scheduler.due(60_000) == ["A"]


def test_intervals_can_be_changed_stopped_and_restored() -> None:
    scheduler = StreamScheduler(["A", "B"], {"A": 8_000})
    assert (scheduler.default_us("A"), scheduler.interval_us("B")) == (8_000, OFF)
    scheduler.due(0)
    scheduler.set_interval("A", OFF, 4_000)
    scheduler.set_interval("B", 4_000, 4_000)
    assert [scheduler.due(t) for t in (4_000, 8_000)] == [["B"], ["B"]]
    scheduler.set_interval("A", scheduler.default_us("A"), 12_000)
    assert sorted(scheduler.due(12_000)) == ["A", "B"]
    with pytest.raises(ValueError, match="interval_us=-1"):
        scheduler.set_interval("A", -1, 0)


def test_time_may_start_anew() -> None:
    scheduler = StreamScheduler(["A"], {"A": 10_000})
    scheduler.due(10**12)
    scheduler.restart()
    assert [bool(scheduler.due(t)) for t in (0, 4_000, 8_000, 12_000)] == [True, False, False, True]


def test_setting_the_present_interval_again_sends_nothing_extra() -> None:
    scheduler = StreamScheduler(["A"], {"A": 10_000})
    scheduler.due(0)
    scheduler.set_interval("A", 10_000, 4_000)
    assert scheduler.due(4_000) == []


# --- values


def test_attitude() -> None:
    autopilot = flown()
    expected = Rotation.from_euler("ZYX", [-1.25, -0.2, 0.1])
    message = newest(autopilot, "ATTITUDE")
    got = Rotation.from_euler("ZYX", [message.yaw, message.pitch, message.roll])
    assert (got * expected.inv()).magnitude() < 1e-6
    assert (message.rollspeed, message.pitchspeed) == (0.0, 0.0)
    assert message.yawspeed == pytest.approx(0.4)
    assert message.time_boot_ms == autopilot.time_us // 1000
    q = newest(autopilot, "ATTITUDE_QUATERNION")
    got = Rotation.from_quat([q.q2, q.q3, q.q4, q.q1])
    assert (got * expected.inv()).magnitude() < 1e-6
    assert q.repr_offset_q == [0.0, 0.0, 0.0, 0.0]


def test_local_and_global_position() -> None:
    autopilot = flown()
    local = newest(autopilot, "LOCAL_POSITION_NED")
    assert [local.x, local.y, local.z] == [12.5, -7.25, -3.5]
    assert [local.vx, local.vy, local.vz] == [1.5, -0.5, 0.25]
    world = newest(autopilot, "GLOBAL_POSITION_INT")
    north = math.degrees(12.5 / EARTH_RADIUS_M)
    east = math.degrees(-7.25 / EARTH_RADIUS_M / math.cos(math.radians(ORIGIN.latitude_deg)))
    assert world.lat / 1e7 == pytest.approx(ORIGIN.latitude_deg + north, abs=1e-7)
    assert world.lon / 1e7 == pytest.approx(ORIGIN.longitude_deg + east, abs=1e-7)
    assert (world.alt, world.relative_alt) == (492_900, 3_500)
    assert [world.vx, world.vy, world.vz] == [150, -50, 25]
    assert world.hdg == round(math.degrees(-1.25 + 2 * math.pi) * 100)


def test_height_is_above_home_not_above_the_origin() -> None:
    autopilot = flown()
    autopilot.home = ORIGIN._replace(altitude_m=ORIGIN.altitude_m + 2.0)
    assert newest(autopilot, "GLOBAL_POSITION_INT").relative_alt == 1_500
    altitude = newest(autopilot, "ALTITUDE")
    assert altitude.altitude_relative == pytest.approx(1.5, abs=1e-4)
    assert altitude.altitude_local == 3.5
    assert altitude.altitude_amsl == pytest.approx(492.9)
    # ISO 2533: 954.61 hPa at 500 m.
    assert altitude.altitude_monotonic == pytest.approx(500.0, abs=0.1)
    assert math.isnan(altitude.altitude_terrain)
    assert math.isnan(altitude.bottom_clearance)
    home = newest(autopilot, "HOME_POSITION")
    assert (home.latitude, home.longitude) == (473_977_430, 85_455_940)
    assert (home.altitude, home.x, home.y) == (491_400, 0.0, 0.0)
    assert home.z == pytest.approx(-2.0)
    assert home.q == pytest.approx([math.cos(0.3), 0.0, 0.0, math.sin(0.3)])
    origin = newest(autopilot, "GPS_GLOBAL_ORIGIN")
    assert (origin.latitude, origin.longitude) == (473_977_430, 85_455_940)
    assert origin.altitude == 489_400


def test_odometry_is_in_the_local_frame() -> None:
    """PX4 1.16 sends velocity in the local frame, too."""
    message = newest(flown(), "ODOMETRY")
    assert [message.vx, message.vy, message.vz] == [1.5, -0.5, 0.25]
    assert (message.frame_id, message.child_frame_id) == (1, 1)  # LOCAL_NED both
    assert [message.x, message.y, message.z] == [12.5, -7.25, -3.5]
    sigma = np.arange(1.0, 16.0) / 100.0
    pose = np.full((6, 6), math.nan)
    pose[np.triu_indices(6)] = message.pose_covariance
    assert np.diag(pose) == pytest.approx(sigma[[0, 1, 2, 6, 7, 8]] ** 2)
    rates = np.full((6, 6), math.nan)
    rates[np.triu_indices(6)] = message.velocity_covariance
    assert np.diag(rates)[:3] == pytest.approx(sigma[3:6] ** 2)
    assert np.isnan(rates).sum() == 33
    assert (message.estimator_type, message.quality) == (8, 0)


def test_vfr_hud() -> None:
    autopilot = flown()
    message = newest(autopilot, "VFR_HUD")
    assert message.groundspeed == pytest.approx(math.hypot(1.5, 0.5))
    assert message.climb == -0.25
    assert message.heading == 288
    assert message.alt == pytest.approx(492.9)
    assert (message.throttle, message.airspeed) == (0, 0.0)
    autopilot.arming = Arming.ARMED
    assert newest(autopilot, "VFR_HUD").throttle == 50
    autopilot.yaw = math.radians(359.7)
    assert newest(autopilot, "VFR_HUD").heading == 0


def test_imu_and_pressure() -> None:
    autopilot = flown()
    message = newest(autopilot, "HIGHRES_IMU")
    accel = [message.xacc, message.yacc, message.zacc]
    assert accel == pytest.approx([0.09, -0.22, -9.80665 - 0.03])
    assert [message.xgyro, message.ygyro, message.zgyro] == pytest.approx([-0.001, -0.002, -0.003])
    assert [message.xmag, message.ymag, message.zmag] == pytest.approx([0.21, 0.01, 0.43])
    assert message.abs_pressure == pytest.approx(954.61)
    assert message.pressure_alt == pytest.approx(500.0, abs=0.1)
    assert message.temperature == pytest.approx(25.31)
    assert message.fields_updated == 0x1FFF & ~(1 << 10)
    assert message.time_usec == autopilot.time_us
    baro = newest(autopilot, "SCALED_PRESSURE")
    assert (baro.press_abs, baro.temperature) == (pytest.approx(954.61), 2531)


def test_gps() -> None:
    message = newest(flown(), "GPS_RAW_INT")
    assert (message.fix_type, message.satellites_visible) == (3, 10)
    assert (message.eph, message.epv) == (65_535, 65_535)
    assert (message.h_acc, message.v_acc) == (900, 1_800)
    assert message.vel == round(100 * math.hypot(1.5, 0.5))
    assert message.cog == round(100 * (360 - math.degrees(math.atan2(0.5, 1.5))))
    assert message.alt == 492_900


def test_battery() -> None:
    autopilot = flown()
    autopilot.parameters.values |= {
        "BAT_LOW_THR": 0.15,
        "BAT_CRIT_THR": 0.07,
        "BAT_EMERGEN_THR": 0.05,
    }
    message = newest(autopilot, "BATTERY_STATUS")
    assert message.voltages == [15_800] + [65_535] * 9
    assert (message.current_battery, message.current_consumed) == (1_234, 456)
    assert (message.battery_remaining, message.energy_consumed) == (83, -1)
    assert message.temperature == 32_767
    states = []
    for remaining in (0.5, 0.14, 0.06, 0.04):
        autopilot.battery = BatterySample(14.0, 1.0, 1.0, remaining)
        states.append(newest(autopilot, "BATTERY_STATUS").charge_state)
    assert states == [1, 2, 3, 4]  # OK, LOW, CRITICAL, EMERGENCY
    nan = math.nan
    autopilot.battery = BatterySample(nan, nan, nan, nan)
    unknown = newest(autopilot, "BATTERY_STATUS")
    assert (unknown.voltages[0], unknown.current_battery) == (65_535, -1)
    assert (unknown.current_consumed, unknown.battery_remaining) == (-1, -1)


def test_battery_state_is_undefined_without_thresholds() -> None:
    assert newest(flown(), "BATTERY_STATUS").charge_state == 0


def test_sys_status() -> None:
    """The expected bits are from a running PX4 1.16 SITL, disarmed and armed, without a radio."""
    prearm, ahrs, gps, radio = 0x1000_0000, 0x20_0000, 0x20, 0x1_0000
    booting = newest(KinematicAutopilot(), "SYS_STATUS")
    assert booting.onboard_control_sensors_health & (gps | prearm | ahrs) == 0
    assert booting.onboard_control_sensors_enabled & gps
    autopilot = flown()
    message = newest(autopilot, "SYS_STATUS")
    assert message.onboard_control_sensors_present == 33_603_629
    assert message.onboard_control_sensors_enabled == 33_669_165
    assert message.onboard_control_sensors_health == 857_786_431
    assert not message.onboard_control_sensors_health & radio
    assert message.onboard_control_sensors_health_extended == 1
    autopilot.arming = Arming.ARMED
    assert newest(autopilot, "SYS_STATUS").onboard_control_sensors_present == 50_380_845
    assert (message.voltage_battery, message.current_battery) == (15_800, 1_234)
    assert (message.battery_remaining, message.load) == (83, 123)


def test_estimator_status() -> None:
    message = newest(flown(), "ESTIMATOR_STATUS")
    good, stands = 1 | 2 | 4 | 8 | 16 | 32 | 256 | 512, 128
    assert message.flags == good | stands
    assert message.pos_horiz_ratio == pytest.approx(0.1)
    assert message.pos_vert_ratio == pytest.approx(0.2)
    assert message.mag_ratio == pytest.approx(0.3)
    assert message.vel_ratio == pytest.approx(0.4)
    assert math.isnan(message.hagl_ratio)
    assert math.isnan(message.tas_ratio)
    assert message.pos_horiz_accuracy == pytest.approx(math.hypot(0.01, 0.02))
    assert message.pos_vert_accuracy == pytest.approx(0.03)
    assert newest(KinematicAutopilot(), "ESTIMATOR_STATUS").flags == 0


def healthy_sensors(state: AutopilotState) -> int:
    return int(status.sensor_bits(state)[2])


def estimator_flags(state: AutopilotState) -> int:
    return int(status.estimator_status(state)[1])


@pytest.mark.parametrize(
    ("lost", "sensor", "estimator"),
    [
        ({"gyro": False}, 0x1, 0),
        ({"accel": False}, 0x2, 0),
        ({"mag": False}, 0x4, 0),
        ({"baro": False}, 0x8, 0),
        ({"gps": False}, 0x20, 0),
        ({"attitude": False}, 0x20_0000 | 0x800, 1),
        ({"battery": False}, 0x200_0000, 0),
        ({"velocity": False}, 0, 2),
        ({"altitude": False}, 0, 4 | 32),
        ({"position": False}, 0x4000, 8 | 16 | 256 | 512),
    ],
)
def test_what_has_failed_clears_its_bits(
    lost: dict[str, bool], sensor: int, estimator: int
) -> None:
    state = flown().state()
    failed = state._replace(health=Health(**lost))
    assert healthy_sensors(state) & ~healthy_sensors(failed) == sensor
    assert estimator_flags(state) & ~estimator_flags(failed) == estimator


def test_the_prearm_bit_is_that_of_the_checks_until_armed() -> None:
    state = flown().state()
    for arming, armable, shown in (
        (Arming.BOOT, True, False),
        (Arming.STANDBY, True, True),
        (Arming.STANDBY, False, False),
        (Arming.ARMED, False, True),
    ):
        changed = state.status._replace(arming=arming)
        told = state._replace(status=changed, health=Health(armable=armable))
        assert bool(healthy_sensors(told) & 0x1000_0000) is shown


def test_estimator_faults_set_their_bits() -> None:
    state = flown().state()
    ratios = np.array([1.5, 0.0, 0.0, 0.0])
    glitch = state._replace(estimate=state.estimate._replace(innovation_ratio=ratios))
    assert estimator_flags(glitch) & 0x400
    doubted = state._replace(health=Health(accel_error=True))
    assert estimator_flags(doubted) & 0x800
    assert not estimator_flags(state) & 0xC00


def test_motors() -> None:
    autopilot = flown()
    message = newest(autopilot, "SERVO_OUTPUT_RAW")
    names = [f"servo{i}_raw" for i in range(1, 9)]
    assert [getattr(message, name) for name in names] == [900] * 8
    autopilot.arming = Arming.ARMED
    message = newest(autopilot, "SERVO_OUTPUT_RAW")
    assert [getattr(message, name) for name in names] == [1000, 1250, 1500, 2000, *[900] * 4]


def test_setpoints_and_their_masks() -> None:
    autopilot = flown()
    autopilot.mode, autopilot.arming = Mode.OFFBOARD, Arming.ARMED
    nan = math.nan
    autopilot.offer_setpoint(
        Setpoint(np.array([nan, nan, -2.0]), np.array([1.0, 2.0, nan]), nan, 0.5), 0
    )
    message = newest(autopilot, "POSITION_TARGET_LOCAL_NED")
    assert message.coordinate_frame == 1
    assert message.type_mask == 1 | 2 | 32
    # The thrust of a hover along a body that is tilted.
    tilted = Rotation.from_euler("ZYX", [-1.25, -0.2, 0.1]).apply([0.0, 0.0, GRAVITY_M_S2])
    acceleration = [message.afx, message.afy, message.afz]
    assert acceleration == pytest.approx([0.0, 0.0, GRAVITY_M_S2] - tilted, abs=1e-5)
    assert message.yaw == pytest.approx(-1.25)
    assert (message.z, message.vx, message.vy, message.yaw_rate) == (-2.0, 1.0, 2.0, 0.5)
    target = newest(autopilot, "ATTITUDE_TARGET")
    assert (target.thrust, target.type_mask) == (0.5, 0)
    assert target.q == pytest.approx(autopilot.state().attitude_setpoint)
    autopilot.arming = Arming.STANDBY
    message = newest(autopilot, "POSITION_TARGET_LOCAL_NED")
    assert (message.type_mask, message.afz) == (63, 100.0)


def test_where_an_automatic_mode_is_going() -> None:
    autopilot = flown()
    autopilot.destination = (0.0, 0.0, -4.0)
    message = newest(autopilot, "POSITION_TARGET_GLOBAL_INT")
    assert (message.coordinate_frame, message.type_mask) == (5, 0)
    assert (message.lat_int, message.lon_int) == (473_977_430, 85_455_940)
    assert message.alt == pytest.approx(493.4)


def test_how_long_the_way_home_takes() -> None:
    lookup = {spec.name: float(spec.default) for spec in px4_release().specs}.__getitem__
    autopilot = flown()
    assert time_estimate_to_target(autopilot.state(), lookup) == (0, -1, -1, -1, -1)
    autopilot.landed = Landed.IN_AIR
    estimate = time_estimate_to_target(autopilot.state(), lookup)
    assert estimate is not None
    assert estimate[0] > 100


def test_vibration_metrics_are_px4s() -> None:
    autopilot = flown()
    bench = Bench(autopilot=autopilot)
    client = RawClient(bench.memory)
    rng = np.random.default_rng(3)
    accels = rng.normal(size=(500, 3))
    gyros = rng.normal(size=(500, 3))
    for accel, gyro in zip(accels, gyros, strict=True):
        autopilot.accel, autopilot.gyro = accel, gyro
        bench.tick()
    autopilot.accel = np.array([0.0, 16.0 * 9.80665, 0.0])
    bench.tick()
    client.received()
    client.command(512, dialect.MAVLINK_MSG_ID_VIBRATION)
    bench.server.receive(autopilot.time_us)
    (message,) = client.received("VIBRATION")
    accels = np.vstack([accels, autopilot.accel])
    gyros = np.vstack([gyros, gyros[-1]])
    weights = 0.01 * 0.99 ** np.arange(499, -1, -1)
    steps = np.linalg.norm(np.diff(accels, axis=0), axis=1)
    assert message.vibration_z == pytest.approx(weights @ steps)
    steps = np.linalg.norm(np.diff(gyros, axis=0), axis=1)
    assert message.vibration_y == pytest.approx(weights @ steps)
    angles = gyros * 0.004
    steps = np.linalg.norm(np.cross(angles[1:], angles[:-1]), axis=1)
    assert message.vibration_x == pytest.approx(weights @ steps)
    assert (message.clipping_0, message.clipping_1) == (1, 0)


def test_calendar_time() -> None:
    autopilot = flown()
    message = newest(autopilot, "SYSTEM_TIME")
    assert message.time_unix_usec == BOOT_UNIX_US + autopilot.time_us
    assert message.time_boot_ms == autopilot.time_us // 1000


def test_mission_is_empty() -> None:
    message = newest(flown(), "MISSION_CURRENT")
    assert (message.seq, message.total, message.mission_state) == (0, 65_535, 1)


# --- modes, measured on a real PX4


@pytest.mark.parametrize(
    ("arming", "mode", "failsafe", "base", "custom", "status"),
    [
        (Arming.BOOT, Mode.HOLD, False, 29, 50_593_792, 0),
        (Arming.STANDBY, Mode.HOLD, False, 29, 50_593_792, 3),
        (Arming.ARMED, Mode.HOLD, False, 157, 50_593_792, 4),
        (Arming.ARMED, Mode.TAKEOFF, False, 157, 33_816_576, 4),
        (Arming.ARMED, Mode.LAND, False, 157, 100_925_440, 4),
        (Arming.ARMED, Mode.RETURN, False, 157, 84_148_224, 4),
        (Arming.ARMED, Mode.OFFBOARD, False, 145, 393_216, 4),
        (Arming.STANDBY, Mode.OFFBOARD, False, 17, 393_216, 3),
        (Arming.ARMED, Mode.POSITION, True, 209, 196_608, 5),
        (Arming.ARMED, Mode.DESCEND, True, 157, 100_925_440, 5),
        (Arming.ARMED, Mode.TERMINATION, True, 145, 655_360, 8),
        (Arming.STANDBY, Mode.TERMINATION, False, 17, 655_360, 8),
    ],
)
def test_heartbeat(
    arming: Arming, mode: Mode, failsafe: bool, base: int, custom: int, status: int
) -> None:
    autopilot = flown()
    autopilot.arming, autopilot.mode, autopilot.failsafe = arming, mode, failsafe
    snapshot = autopilot.state().status
    state = system_status(snapshot, can_arm=True)
    assert (base_mode(snapshot), mode.spec.custom_mode, state) == (
        base,
        custom,
        status,
    )
    message = newest(autopilot, "HEARTBEAT")
    assert (message.base_mode, message.custom_mode, message.system_status) == (base, custom, status)
    assert (message.type, message.autopilot, message.mavlink_version) == (2, 12, 3)


@pytest.mark.parametrize("mode", list(Mode))
def test_a_requested_mode_is_the_reported_one(mode: Mode) -> None:
    """PX4: Descend is shown as Land, and termination cannot be requested as a mode."""
    number = mode.spec.custom_mode
    requested = requested_mode(129, number >> 16 & 0xFF, number >> 24)
    alike = {Mode.DESCEND: Mode.LAND, Mode.TERMINATION: None}
    assert requested is alike.get(mode, mode)


@pytest.mark.parametrize(
    ("landed", "expected"),
    [
        (Landed.ON_GROUND, 1),
        (Landed.IN_AIR, 2),
        (Landed.TAKEOFF, 3),
        (Landed.LANDING, 4),
    ],
)
def test_landed_state(landed: Landed, expected: int) -> None:
    autopilot = flown()
    autopilot.landed = landed
    message = newest(autopilot, "EXTENDED_SYS_STATE")
    assert (message.landed_state, message.vtol_state) == (expected, 0)


# --- before anything is known, and when it all goes wrong


def test_nothing_is_claimed_before_it_is_known() -> None:
    autopilot = KinematicAutopilot()
    autopilot.ready_us = 10 * US_PER_S
    bench = Bench(autopilot=autopilot)
    client = RawClient(bench.memory)
    bench.run(3.0)
    counts = client.count()
    absent = {"LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "GPS_RAW_INT", "HOME_POSITION"}
    assert not (absent | {"GPS_GLOBAL_ORIGIN"}) & set(counts)
    assert {"HEARTBEAT", "ATTITUDE", "SYS_STATUS"} <= set(counts)


def test_the_origin_is_announced_once_on_every_link() -> None:
    bench = Bench()
    links = [RawClient(bench.memory), RawClient(bench.gcs)]
    bench.run(3.0)
    assert [len(link.received("GPS_GLOBAL_ORIGIN")) for link in links] == [1, 1]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
def test_a_diverged_estimate_silences_no_heartbeat(
    bad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    autopilot = flown()
    bench = Bench(autopilot=autopilot)
    client = RawClient(bench.memory)
    autopilot.arming = Arming.ARMED
    autopilot.mode = Mode.HOLD
    autopilot.frozen = True
    sane = autopilot.state

    def diverged() -> AutopilotState:
        for name in ("position", "velocity", "accel", "gyro"):
            setattr(autopilot, name, np.zeros(3))
        state = sane()
        for field in (state.estimate.position, state.estimate.velocity, state.accel, state.gyro):
            field[:] = bad
        return state

    monkeypatch.setattr(autopilot, "state", diverged)
    bench.run(2.0)
    counts = client.count()
    assert counts["HEARTBEAT"] == 2
    assert counts["SYS_STATUS"] == 10


def test_extreme_but_finite_values_saturate() -> None:
    autopilot = flown()
    autopilot.velocity = np.array([400.0, -400.0, 1e6])
    message = newest(autopilot, "GLOBAL_POSITION_INT")
    assert [message.vx, message.vy, message.vz] == [32_767, -32_768, 32_767]


@given(value=st.floats(allow_nan=True, allow_infinity=True))
def test_field_conversions_fit_their_types(value: float) -> None:
    assert -(2**15) <= units.int16(value) < 2**15
    assert -(2**31) <= units.int32(value) < 2**31
    assert 0 <= units.uint16(value) < 2**16
    assert 0 <= units.uint32(value) < 2**32
    degrees = units.centidegrees(value)
    assert 0 <= degrees < 36_000 or degrees == 65_535
