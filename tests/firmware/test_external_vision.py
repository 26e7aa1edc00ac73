"""External vision: parsing of ODOMETRY, and flights of a vehicle without GPS."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from mavsdk.plugins.mocap import mocap
from pymavlink.dialects.v20 import common as dialect
from scipy.spatial.transform import Rotation

from airl_mav.addons.fault_matrix.matrix import fly_fault
from airl_mav.core.constants import TICK_S, TICK_US, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import HOME, Vector, geodetic_to_local, quat_wxyz_to_xyzw, quat_yaw
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from firmware_sim.addons.auxiliary_estimation.external_vision import Control, yaw_by_turn
from firmware_sim.addons.auxiliary_estimation.simulated_sensors import PlantVision
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.external import hil_messages as hil
from firmware_sim.interfaces import Odometry
from firmware_sim.mavlink.codec import Encoder
from firmware_sim.plant.sensors import Site
from firmware_sim.simulation import TOUCHDOWN_M_S
from tests.support import mavlink_clients
from tests.support.flight_rig import Rig, aids_of, quad, velocity_setpoint

NAN = math.nan
TRIANGLE = tuple(float(i) for i in range(21))
DIAGONAL = [0.0, 6.0, 11.0, 15.0, 18.0, 20.0]
"""Diagonal of a matrix sent as TRIANGLE."""
LEVEL = (1.0, 0.0, 0.0, 0.0)

# Which of our axes each axis of a frame is, as rotation matrices.
ENU = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FLU = Rotation.from_matrix([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
OURS = Rotation.identity()


def odometry_message(**changes: Any) -> Any:
    fields: dict[str, Any] = {
        "time_usec": 1,
        "frame_id": dialect.MAV_FRAME_LOCAL_NED,
        "child_frame_id": dialect.MAV_FRAME_BODY_FRD,
        "x": 1.0,
        "y": 2.0,
        "z": -3.0,
        "q": LEVEL,
        "vx": 0.5,
        "vy": -0.25,
        "vz": 0.125,
        "rollspeed": NAN,
        "pitchspeed": NAN,
        "yawspeed": NAN,
        "pose_covariance": TRIANGLE,
        "velocity_covariance": TRIANGLE,
        "reset_counter": 3,
        "estimator_type": dialect.MAV_ESTIMATOR_TYPE_VIO,
        "quality": 80,
    }
    return dialect.MAVLink_odometry_message(**{**fields, **changes})


def read(message: Any) -> list[Odometry]:
    rig = mavlink_clients.Rig()
    rig.client.send(message)
    rig.bench.tick()
    return rig.autopilot.received["odometry"]


@pytest.mark.parametrize(
    ("frame", "axes", "read_as"),
    [
        (dialect.MAV_FRAME_LOCAL_NED, OURS, "ned"),
        (dialect.MAV_FRAME_LOCAL_ENU, ENU, "ned"),
        (dialect.MAV_FRAME_LOCAL_FRD, OURS, "frd"),
        (dialect.MAV_FRAME_LOCAL_FLU, FLU, "frd"),
    ],
)
def test_frames_of_a_pose(frame: int, axes: Rotation, read_as: str) -> None:
    (seen,) = read(odometry_message(frame_id=frame))
    assert seen.pose_frame == read_as
    assert seen.position is not None
    np.testing.assert_allclose(seen.position, axes.apply([1.0, 2.0, -3.0]))
    moved = np.abs(axes.as_matrix()) @ DIAGONAL[:3]
    np.testing.assert_allclose(seen.position_variance, moved)
    np.testing.assert_allclose(seen.orientation_variance, DIAGONAL[3:])
    assert (seen.reset_counter, seen.quality) == (3, 80)


@pytest.mark.parametrize(
    ("frame", "axes", "read_as"),
    [
        (dialect.MAV_FRAME_LOCAL_NED, OURS, "ned"),
        (dialect.MAV_FRAME_LOCAL_ENU, ENU, "ned"),
        (dialect.MAV_FRAME_LOCAL_FLU, FLU, "frd"),
        (dialect.MAV_FRAME_BODY_FRD, OURS, "body"),
        (dialect.MAV_FRAME_BODY_NED, OURS, "body"),
    ],
)
def test_frames_of_a_velocity(frame: int, axes: Rotation, read_as: str) -> None:
    (seen,) = read(odometry_message(child_frame_id=frame))
    assert seen.velocity_frame == read_as
    assert seen.velocity is not None
    np.testing.assert_allclose(seen.velocity, axes.apply([0.5, -0.25, 0.125]))
    np.testing.assert_allclose(seen.velocity_variance, np.abs(axes.as_matrix()) @ DIAGONAL[:3])


def test_what_is_not_measured_is_none() -> None:
    (seen,) = read(odometry_message(x=NAN, frame_id=99, child_frame_id=dialect.MAV_FRAME_GLOBAL))
    assert seen.position is None and seen.velocity is None
    assert seen.quaternion is not None
    (seen,) = read(odometry_message(q=(0.5, 0.0, 0.0, 0.0)))
    assert seen.quaternion is None and seen.position is not None
    (seen,) = read(odometry_message(estimator_type=dialect.MAV_ESTIMATOR_TYPE_NAIVE))
    assert np.isnan(seen.position_variance).all() and np.isnan(seen.velocity_variance).all()
    assert read(odometry_message(x=NAN, vx=math.inf, q=(NAN, 0.0, 0.0, 0.0))) == []


def test_motion_capture_has_no_effect_and_other_estimators_are_told_once() -> None:
    assert read(odometry_message(estimator_type=dialect.MAV_ESTIMATOR_TYPE_MOCAP)) == []
    rig = mavlink_clients.Rig()
    for _ in range(3):
        rig.client.send(odometry_message(estimator_type=dialect.MAV_ESTIMATOR_TYPE_GPS))
        rig.bench.tick()
    assert rig.autopilot.received["odometry"] == []
    told = mavlink_clients.text_of(rig.client.received())
    assert told == [(2, "ODOMETRY: estimator_type 4 unsupported")]


def test_vision_position_estimate() -> None:
    angles = 0.1, -0.2, 1.5
    (seen,) = read(
        dialect.MAVLink_vision_position_estimate_message(1, 1.0, 2.0, -3.0, *angles, TRIANGLE, 7)
    )
    assert (seen.pose_frame, seen.velocity, seen.reset_counter) == ("ned", None, 7)
    assert seen.position is not None and seen.quaternion is not None
    np.testing.assert_allclose(seen.position, [1.0, 2.0, -3.0])
    found = Rotation.from_quat(quat_wxyz_to_xyzw(seen.quaternion))
    expected = Rotation.from_euler("ZYX", angles[::-1])
    assert (found * expected.inv()).magnitude() < 1e-6
    np.testing.assert_allclose(seen.position_variance, DIAGONAL[:3])
    np.testing.assert_allclose(seen.orientation_variance, DIAGONAL[3:])


def test_mavsdk_s_mocap_plugin_is_understood() -> None:
    """Odometry that an onboard program sends with MAVSDK reaches the estimator."""
    unknown = mocap.Covariance([NAN])
    with mavlink_clients.mavsdk_over_memory() as (companion, pacer):
        autopilot = pacer.bench.autopilot
        plugin = companion.plugin(mocap.Mocap)
        plugin.set_odometry(
            mocap.Odometry(
                1,
                mocap.Odometry.MavFrame.LOCAL_FRD,
                mocap.PositionBody(1.0, 2.0, -3.0),
                mocap.Quaternion(1.0, 0.0, 0.0, 0.0),
                mocap.SpeedBody(0.5, -0.25, 0.125),
                mocap.AngularVelocityBody(0.0, 0.0, 0.0),
                unknown,
                unknown,
                4,
                mocap.Odometry.MavEstimatorType.VIO,
                90,
            )
        )
        plugin.set_vision_position_estimate(
            mocap.VisionPositionEstimate(
                1, mocap.PositionBody(4.0, 5.0, -6.0), mocap.AngleBody(0.0, 0.0, 1.5), unknown, 0
            )
        )
        mavlink_clients.wait_for(lambda: len(autopilot.received["odometry"]) == 2)
    odometry, estimate = autopilot.received["odometry"]
    assert odometry.position is not None and odometry.velocity is not None
    assert estimate.position is not None and estimate.quaternion is not None
    assert (odometry.pose_frame, odometry.velocity_frame) == ("frd", "body")
    np.testing.assert_allclose(odometry.position, [1.0, 2.0, -3.0])
    np.testing.assert_allclose(odometry.velocity, [0.5, -0.25, 0.125])
    assert np.isnan(odometry.position_variance).any()
    assert estimate.pose_frame == "ned"
    np.testing.assert_allclose(estimate.position, [4.0, 5.0, -6.0])
    np.testing.assert_allclose(
        estimate.quaternion, [math.cos(0.75), 0, 0, math.sin(0.75)], atol=1e-6
    )


def test_what_px4_is_told_is_read_as_it_was_meant() -> None:
    """There and back: the simulator's message to PX4, read as a message of a companion."""
    meant = Odometry(
        np.array([1.0, 2.0, -3.0]),
        np.array([0.5, -0.25, 0.125]),
        np.array(LEVEL),
        "frd",
        "body",
        np.array([1.0, 2.0, 3.0]),
        np.array([4.0, 5.0, 6.0]),
        np.array([7.0, 8.0, 9.0]),
        2,
        50,
    )
    frame = Encoder().frame(hil.ODOMETRY, hil.ODOMETRY.payload(hil.odometry(meant, 5)))
    (message,) = dialect.MAVLink(None).parse_buffer(frame)
    (found,) = read(message)
    for a, b in zip(found, meant, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("seed", range(4))
def test_how_the_heading_changes_by_a_turn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = rng.uniform([-3.0, -1.2, -1.2], [3.0, 1.2, 1.2])
    attitude = Rotation.from_euler("ZYX", angles)
    x, y, z, w = attitude.as_quat()
    step = 1e-6
    changes = [
        (attitude * Rotation.from_rotvec(step * axis)).as_euler("ZYX")[0] - angles[0]
        for axis in np.eye(3)
    ]
    np.testing.assert_allclose(yaw_by_turn((w, x, y, z)), np.array(changes) / step, atol=1e-4)


# --- flights


def without_gps(**changes: Any) -> Rig:
    """A vehicle that has visual-inertial odometry and no GPS, and knows its place."""
    profile = load_vehicle("quad-vio")
    sensors = profile.sensors.model_dump()
    sensors["vision"].update(changes.pop("vision", {}))
    parameters = {**profile.parameters, **changes}
    vehicle = quad(sensors=sensors).model_copy(update={"parameters": parameters})
    rig = Rig(3, vehicle=vehicle)
    assert rig.ap.set_origin(HOME) is Result.ACCEPTED
    rig.run(3.0)
    return rig


def off(rig: Rig) -> Vector:
    """Return the true minus the estimated position and velocity (6,)."""
    estimate, truth = rig.ap.state().estimate, rig.truth
    return np.concatenate([truth.position - estimate.position, truth.velocity - estimate.velocity])


def test_it_flies_by_vision_alone() -> None:
    rig = without_gps()
    assert aids_of(rig).vision.fused == Control.HORIZONTAL | Control.VERTICAL | Control.VELOCITY
    rig.take_off(4.0)
    errors: list[Vector] = []
    rig.go_offboard(velocity_setpoint(3.0, 1.0, 0.0, yaw=1.0))
    rig.run(8.0, lambda: errors.append(off(rig)))
    rig.stream(velocity_setpoint(-2.0, 2.0, -0.2, yaw=-2.0))
    rig.run(8.0, lambda: errors.append(off(rig)))
    far = np.abs(errors).max(axis=0)
    # 40 m of way: a drift of 0.2 m (one sigma) per axis, besides the frame's heading.
    assert 0.02 < far[:2].max() < 1.0 and far[2] < 0.6
    assert far[3:5].max() < 0.2
    # On the globe it took off where it says.
    state = rig.ap.state()
    assert state.origin == HOME and state.home is not None and state.gps is None
    assert np.abs(geodetic_to_local(state.home, HOME)).max() < 0.2
    assert rig.ap.set_mode(Mode.LAND) is Result.ACCEPTED
    rig.until(lambda: rig.ap.flight.phase == 1, 40.0)


def test_without_vision_or_gps_it_is_not_armed() -> None:
    rig = without_gps(EKF2_EV_CTRL=0)
    rig.run(5.0)
    assert rig.ap.arm(force=False) is not Result.ACCEPTED


def test_hold_needs_a_place_on_the_globe_and_position_does_not() -> None:
    """PX4: without north, or an origin, there is no global position."""
    vehicle = load_vehicle("quad-vio")
    rig = Rig(3, vehicle=quad(sensors=vehicle.sensors.model_dump()), parameters=vehicle.parameters)
    rig.run(3.0)
    state = rig.ap.state()
    assert (state.origin, state.home) == (None, None)
    assert state.health.position and state.estimate.healthy
    assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED
    assert not math.isnan(rig.said("No valid global position estimate"))
    assert rig.ap.set_origin(HOME) is Result.ACCEPTED
    rig.run(1.0)
    assert rig.ap.arm(force=False) is Result.ACCEPTED


def test_vision_that_falls_silent_ends_the_flight_as_without_gps() -> None:
    rig = without_gps()
    rig.take_off(4.0)
    rig.go_offboard(velocity_setpoint(1.0, 0.0, 0.0))
    rig.run(3.0)
    quiet_us = rig.sim.time_us
    # From now on the tick's sample comes without it.
    step = rig.ap.step
    rig.step_through(lambda sample: step(sample._replace(odometry=None)))
    rig.run(0.5)
    assert aids_of(rig).vision.fused == Control(0)
    assert rig.mode is Mode.OFFBOARD
    rig.until(lambda: rig.ap.flight.failsafe, 8.0)
    # EKF2_NOAID_TOUT, 5 s, plus the commander's delay.
    assert 4.5 < (rig.sim.time_us - quiet_us) / US_PER_S < 7.0
    rig.until(lambda: rig.ap.flight.phase == 1, 60.0)
    assert rig.truth.velocity[2] < 2.0


def test_a_jump_that_is_told_is_taken_over_and_one_that_is_not_is_refused() -> None:
    jump, counter = np.array([8.0, -5.0, 0.0]), 0
    rig = without_gps(vision={"position_drift_m_sqrt_m": 0.0, "yaw_drift_rad_sqrt_s": 0.0})
    rig.take_off(4.0)
    step, told = rig.ap.step, 0

    def shifted(sample: Any) -> Any:
        seen = sample.odometry
        if seen is not None and told:
            seen = seen._replace(position=seen.position + jump, reset_counter=counter)
        return step(sample._replace(odometry=seen))

    rig.step_through(shifted)
    told = 1
    rig.run(1.0)
    # Unreported jump: rejected until the position times out; velocity holds the estimate.
    assert np.abs(off(rig)[:2]).max() < 0.3
    rig.run(6.0)
    np.testing.assert_allclose(off(rig)[:2], -jump[:2], atol=0.6)
    told, counter = 1, 1
    jump = np.zeros(3)
    rig.run(0.2)
    assert np.abs(off(rig)[:2]).max() < 0.3


def test_a_height_that_jumps_is_refused_for_a_while_and_then_taken_over() -> None:
    rig = without_gps(vision={"position_drift_m_sqrt_m": 0.0, "yaw_drift_rad_sqrt_s": 0.0})
    rig.take_off(4.0)
    step = rig.ap.step
    lifted = np.array([0.0, 0.0, -3.0])

    def shifted(sample: Any) -> Any:
        seen = sample.odometry
        if seen is not None:
            seen = seen._replace(position=seen.position + lifted)
        return step(sample._replace(odometry=seen))

    rig.step_through(shifted)
    rig.run(3.0)
    assert abs(off(rig)[2]) < 0.4
    rig.run(4.0)
    assert off(rig)[2] == pytest.approx(3.0, abs=0.4)


@pytest.mark.parametrize(("wrong_deg", "believed"), [(170.0, False), (5.0, True)])
def test_a_heading_of_the_globe_has_to_agree_with_the_compass(
    wrong_deg: float, believed: bool
) -> None:
    """PX4: heading fusion starts within the gate, and then disables the compass."""
    rig = without_gps(EKF2_EVA_NOISE=0.05)
    step, turn = rig.ap.step, Rotation.from_rotvec([0.0, 0.0, math.radians(wrong_deg)])

    def turned(sample: Any) -> Any:
        seen = sample.odometry
        if seen is not None:
            attitude = turn * Rotation.from_quat(quat_wxyz_to_xyzw(seen.quaternion))
            quaternion = np.roll(attitude.as_quat(), 1)
            seen = seen._replace(quaternion=quaternion, pose_frame="ned", velocity_frame="ned")
        return step(sample._replace(odometry=seen))

    rig.step_through(turned)
    rig.ap.parameters.set("EKF2_EV_CTRL", 15)
    rig.run(20.0)
    assert bool(aids_of(rig).vision.fused & Control.YAW) is believed
    heading_deg = math.degrees(quat_yaw(rig.ap.state().estimate.quaternion))
    assert heading_deg == pytest.approx(wrong_deg if believed else 0.0, abs=1.5)
    assert rig.ap.estimator.is_north_known


def test_gps_comes_first_where_there_is_both() -> None:
    vehicle = load_vehicle("quad-vio")
    sensors = {**vehicle.sensors.model_dump(), "gps": quad().sensors.gps.model_dump()}
    both = {**vehicle.parameters, "SYS_HAS_GPS": 1, "EKF2_GPS_CTRL": 7, "EKF2_HGT_REF": 1}
    rig = Rig(3, vehicle=quad(sensors=sensors), parameters=both)
    rig.run(3.0)
    rig.take_off(4.0)
    vision = aids_of(rig).vision
    assert vision.fused == Control.VELOCITY
    step = rig.ap.step
    rig.step_through(lambda sample: step(sample._replace(gps=None)))
    rig.run(3.0)
    assert vision.fused == Control.VELOCITY | Control.HORIZONTAL
    rig.run(10.0)
    assert rig.mode is Mode.HOLD and not rig.ap.flight.failsafe


def test_a_heading_of_its_own_frame_is_no_heading_of_the_globe() -> None:
    rig = without_gps(EKF2_EV_CTRL=15)
    vision = aids_of(rig).vision
    assert vision.fused & Control.YAW and not rig.ap.estimator.is_north_known
    assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED
    assert not math.isnan(rig.said("No valid global position estimate"))


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["off", "stuck", "noise 5x", "bias 2,0,0m", "drift 0.3,0,0m/s"])
def test_vision_that_fails_brings_no_vehicle_down_hard(kind: str) -> None:
    found = fly_fault(load_vehicle("quad-vio"), f"vision {kind}", "offboard", 1)
    assert found.end == "landed" and found.touchdown_m_s is not None
    assert found.touchdown_m_s < TOUCHDOWN_M_S
    lost = any("vision fusion stopped" in text for text in found.said)
    assert lost is (kind in ("off", "stuck"))


@pytest.mark.parametrize("fault", ["accel bias 0.5,0.5,0.5m/s2", "gyro bias 2,2,2deg/s"])
def test_inertial_sensors_that_go_wrong_are_told_by_vision(fault: str) -> None:
    found = fly_fault(load_vehicle("quad-vio"), fault, "offboard", 1)
    assert found.end == "landed"
    assert "Estimator biases reset: IMU and vision disagree" in found.said


def test_a_late_vision_is_flown_with_where_its_delay_is_known() -> None:
    late = without_gps(vision={"delay_s": 0.2}, EKF2_EV_DELAY=200.0)
    late.take_off(4.0)
    late.go_offboard(velocity_setpoint(4.0, 0.0, 0.0))
    errors: list[Vector] = []
    late.run(6.0, lambda: errors.append(off(late)))
    late.stream(velocity_setpoint(-4.0, 0.0, 0.0))
    late.run(6.0, lambda: errors.append(off(late)))
    far = np.abs(errors).max(axis=0)
    # Taken for fresh, positions would be 0.8 m off, and velocities refused.
    assert far[0] < 0.6 and far[3] < 0.2


def test_what_the_sensor_tells_is_the_profile_s() -> None:
    """White noise, delay, and a drift that grows with the way, against the profile's numbers."""
    profile = load_vehicle("quad-vio").sensors
    assert profile.vision is not None
    ends, noises = [], []
    for seed in range(60):
        own = np.random.default_rng(seed).spawn(5)[4]
        sensor = PlantVision(profile.vision, Site(None, own, 1.0, TICK_S))
        row = np.zeros(16)
        row[6] = 1.0
        told: list[tuple[int, Odometry]] = []
        for tick in range(1500):
            time_us = tick * TICK_US
            row[0] = max(0.0, 10.0 * (tick - 250) / 1000) if tick < 1250 else 10.0
            pose = sensor.sense(time_us, row, 0)
            if pose is not None:
                told.append((time_us, pose))
        times = np.array([t for t, _ in told])
        # The first pose is from the start, and arrives after the delay.
        assert times[0] == profile.vision.delay_s * US_PER_S
        assert len(times) == pytest.approx(6.0 * profile.vision.rate_hz, abs=2)
        positions = np.array([o.position for _, o in told])
        still = times < 0.9 * US_PER_S
        noises.append(positions[still].std(axis=0, ddof=1))
        ends.append(positions[times > 5.2 * US_PER_S].mean(axis=0) - [10.0, 0.0, 0.0])
    sd = np.sqrt(np.mean(np.square(noises), axis=0))
    np.testing.assert_allclose(sd, profile.vision.position_noise_m, rtol=0.05)
    drift = np.std(ends, axis=0)
    expected = profile.vision.position_drift_m_sqrt_m * math.sqrt(10.0)
    # Along the way as below it; across it the frame's turn adds to that.
    np.testing.assert_allclose(drift[[0, 2]], expected, rtol=0.2)
    assert drift[1] > 0.8 * expected


def test_a_sensor_that_a_vehicle_lacks_cannot_fail() -> None:
    with pytest.raises(FieldError, match=r"'vision off': accepted: with a vehicle that has vision"):
        resolve(Scenario(vehicle="quad", faults=("vision off",), level="lockstep"))
    with pytest.raises(FieldError, match=r"gps off"):
        resolve(Scenario(vehicle="quad-vio", faults=("gps off",), level="lockstep"))


def test_less_quality_than_asked_is_not_fused() -> None:
    rig = without_gps(EKF2_EV_QMIN=50)
    assert aids_of(rig).vision.fused == Control(0)
