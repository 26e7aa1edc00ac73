"""The yaw estimator against a plain reference and the truth, and its use in flight."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from airl_mav.addons.fault_matrix.matrix import fly_fault
from airl_mav.core.constants import GRAVITY_M_S2, TICK_S
from airl_mav.core.frames import quat_wxyz_to_xyzw, quat_yaw
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.recovery import EXPLAINED, EmergencyYaw, turn_to
from firmware_sim.autopilot.yaw_estimator import WEIGHT, YAW, YawEstimator
from firmware_sim.engine.record import new_controller
from tests.support.flight_rig import Rig, flight, quad, velocity_setpoint

ACCURACY = 0.05
"""Accuracy of the GPS velocity [m/s]: EKF2_GPS_V_NOISE of the shipped vehicle."""


class Tick(NamedTuple):
    gyro: np.ndarray
    accel: np.ndarray
    velocity: np.ndarray | None
    """GPS velocity; None between fixes."""
    flying: bool
    yaw: float
    """True heading."""


def errors_deg(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.degrees((found - true + math.pi) % (2.0 * math.pi) - math.pi)


@pytest.fixture(scope="module")
def ticks() -> list[Tick]:
    """Record IMU and GPS of a take-off and a flight to the north, the east and back."""
    seen: list[Tick] = []
    with flight(4) as rig:
        step = rig.ap.step

        def listen(sample: Any) -> Any:
            fix = None if sample.gps is None else sample.gps.velocity_ned
            yaw = quat_yaw(rig.truth.quaternion)
            flying = rig.ap.flight.phase is FlightPhase.AIR
            seen.append(Tick(sample.gyro, sample.accel, fix, flying, yaw))
            return step(sample)

        rig.step_through(listen)
        rig.take_off(3.0, settle_s=0.0)
        rig.go_offboard(velocity_setpoint(2.0, 0.0, 0.0, yaw=1.0))
        rig.run(3.0)
        rig.stream(velocity_setpoint(0.0, 2.0, 0.0, yaw=1.0))
        rig.run(3.0)
        rig.stream(velocity_setpoint(-2.0, 0.0, 0.0, yaw=-0.5))
        rig.run(3.0)
    return seen


def turned(ticks: list[Tick], angle: float) -> Iterator[Tick]:
    """Yield the same flight in a world that is turned: another heading, the same IMU."""
    c, s = math.cos(angle), math.sin(angle)
    world = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    for tick in ticks:
        fix = None if tick.velocity is None else world @ tick.velocity
        yield tick._replace(velocity=fix, yaw=tick.yaw + angle)


def observed(ticks: Iterator[Tick]) -> Iterator[tuple[Tick, YawEstimator]]:
    """Yield an estimator after each fix."""
    estimator = YawEstimator(new_controller())
    for tick in ticks:
        estimator.feel(tick.gyro, tick.accel)
        if tick.velocity is not None:
            estimator.observe(tick.velocity, ACCURACY, np.zeros(3), flying=tick.flying)
            yield tick, estimator


# --- the truth


@pytest.mark.parametrize("angle", np.radians([0.0, 50.0, 130.0, 180.0, 250.0, 320.0]))
def test_it_finds_the_heading_wherever_the_vehicle_points(ticks: list[Tick], angle: float) -> None:
    rows = [
        (tick.yaw, estimator.yaw, math.sqrt(estimator.variance))
        for tick, estimator in observed(turned(ticks, angle))
        if tick.flying
    ]
    true, found, sigma = np.array(rows).T
    off = np.abs(errors_deg(found, true))
    sure = np.degrees(sigma) < 15.0
    assert not sure[0], "nothing is known before it moves"
    assert sure[-75:].all(), "and all of the way, once it has accelerated"
    assert off[sure].max() < 25.0, "what is taken over is never as wrong as what is given up"
    assert off[-50:].mean() < 8.0


@pytest.mark.parametrize(("off_deg", "least"), [(30.0, 0.9), (90.0, EXPLAINED), (180.0, EXPLAINED)])
def test_a_wrong_heading_is_explained_by_another(
    ticks: list[Tick], off_deg: float, least: float
) -> None:
    """The explained share of 2 s of motion is independent of the models' frame."""
    wrong = [
        estimator.explained(tick.yaw + math.radians(off_deg))
        for tick, estimator in observed(turned(ticks, 1.0))
        if tick.flying and np.std(estimator.motion("seen_motion")) > 0.9
    ]
    assert len(wrong) > 10
    assert min(wrong) > least


def test_a_tilt_is_not_explained_by_a_heading() -> None:
    """The vehicle goes off at 1 m/s² where the IMU feels none: no direction makes it so."""
    estimator = YawEstimator(new_controller())
    rng = np.random.default_rng(3)
    for tick in range(1000):
        accel = np.array([0.0, 0.0, -GRAVITY_M_S2]) + 0.05 * rng.standard_normal(3)
        estimator.feel(0.002 * rng.standard_normal(3), accel)
        if tick % 25 == 0:
            north = max(tick * TICK_S - 2.0, 0.0)
            velocity = np.array([north, 0.0, 0.0]) + 0.03 * rng.standard_normal(3)
            estimator.observe(velocity, ACCURACY, np.zeros(3), flying=tick > 250)
    assert all(estimator.explained(yaw) < 0.5 for yaw in np.linspace(-3.0, 3.0, 7))


def test_standing_still_says_nothing() -> None:
    """Level and at rest in the air: every heading foretells the same velocity."""
    estimator = YawEstimator(new_controller())
    rng = np.random.default_rng(1)
    for tick in range(2500):
        accel = np.array([0.0, 0.0, -GRAVITY_M_S2]) + 0.05 * rng.standard_normal(3)
        estimator.feel(0.002 * rng.standard_normal(3), accel)
        if tick % 25 == 0:
            velocity = 0.03 * rng.standard_normal(3)
            estimator.observe(velocity, ACCURACY, np.zeros(3), flying=tick > 500)
    assert math.degrees(math.sqrt(estimator.variance)) > 25.0


def test_on_the_ground_it_begins_anew(ticks: list[Tick]) -> None:
    *_, (_, estimator) = observed(iter(ticks))
    assert estimator.variance < 0.01
    bias = np.array([0.01, 0.02, -0.03])
    estimator.observe(np.zeros(3), ACCURACY, bias, flying=False)
    assert estimator.variance == math.inf
    np.testing.assert_array_equal(estimator.models[:, 13:16], np.tile(bias, (5, 1)))


# --- a plain reference


class Reference:
    """The same Gaussian sum as matrices and scipy's rotations, a tick at a time."""

    def __init__(self) -> None:
        self.force = np.zeros(3)
        self.attitudes: list[Rotation] | None = None
        self.biases = np.zeros((5, 3))
        self.x = self.p = np.zeros(0)
        self.weights = np.full(5, 0.2)
        self.started = False
        self.yaw, self.variance = 0.0, math.inf

    def feel(self, gyro: np.ndarray, accel: np.ndarray) -> None:
        g, dt = GRAVITY_M_S2, TICK_S
        self.force = self.force + 10.0 * 0.2 * dt * (accel - self.force)
        norm = float(np.linalg.norm(self.force))
        if self.attitudes is None:
            if not all(0.9 * g < n < 1.1 * g for n in (norm, np.linalg.norm(accel))):
                return
            roll = math.atan2(-accel[1], -accel[2])
            pitch = math.atan2(accel[0], math.hypot(accel[1], accel[2]))
            self.attitudes = [Rotation.from_euler("ZYX", [0.0, pitch, roll])] * 5
        gain = 0.2 * (1.0 - min(2.0 * abs(norm / g - 1.0), 1.0)) ** 2
        for j, attitude in enumerate(self.attitudes):
            down = attitude.inv().apply([0.0, 0.0, 1.0])
            tilt = gain * np.cross(down, self.force) / norm
            if np.linalg.norm(gyro - self.biases[j]) < math.radians(10.0):
                self.biases[j] = np.clip(self.biases[j] - tilt * 0.04 * dt, -0.05, 0.05)
            after = attitude * Rotation.from_rotvec((gyro + tilt - self.biases[j]) * dt)
            self.attitudes[j] = after
            if not self.started:
                continue
            change = after.apply(accel) * dt
            f = np.eye(3)
            f[:2, 2] = -change[1], change[0]
            self.p[j] = f @ self.p[j] @ f.T + np.diag([2.0 * dt, 2.0 * dt, 0.1 * dt]) ** 2
            self.x[j, :2] += change[:2]
            self.x[j, 2] = after.as_euler("ZYX")[0]

    def observe(self, velocity: np.ndarray, accuracy: float, *, flying: bool) -> None:
        if not flying:
            self.biases[:] = 0.0
        if not flying or self.attitudes is None:
            return
        noise = accuracy**2 * np.eye(2)
        if not self.started:
            step = 2.0 * math.pi / 5
            yaws = -math.pi + (np.arange(5) + 0.5) * step
            for j, yaw in enumerate(yaws):
                turn = yaw - self.attitudes[j].as_euler("ZYX")[0]
                self.attitudes[j] = Rotation.from_rotvec([0, 0, turn]) * self.attitudes[j]
            self.x = np.column_stack([np.tile(velocity[:2], (5, 1)), yaws])
            self.p = np.tile(np.diag([accuracy, accuracy, 0.5 * step]) ** 2, (5, 1, 1))
            self.started = True
            return
        h = np.eye(2, 3)
        for j in range(5):
            s = h @ self.p[j] @ h.T + noise
            innovation = velocity[:2] - self.x[j, :2]
            nis = float(innovation @ np.linalg.solve(s, innovation))
            innovation = innovation * min(1.0, 5.0 / math.sqrt(nis))
            k = self.p[j] @ h.T @ np.linalg.inv(s)
            correction = k @ innovation
            self.p[j] = (np.eye(3) - k @ h) @ self.p[j]
            self.x[j] += correction
            self.attitudes[j] = Rotation.from_rotvec([0, 0, correction[2]]) * self.attitudes[j]
            density = math.exp(-0.5 * min(nis, 25.0)) / (
                2.0 * math.pi * math.sqrt(np.linalg.det(s))
            )
            self.weights[j] = max(self.weights[j] * density, 1e-5)
        self.weights /= self.weights.sum()
        self.yaw = float(np.angle(self.weights @ np.exp(1j * self.x[:, 2])))
        off = np.radians(errors_deg(self.x[:, 2], np.array(self.yaw)))
        self.variance = float(self.weights @ (self.p[:, 2, 2] + off**2))


@pytest.mark.nightly
def test_it_is_the_reference_to_rounding(ticks: list[Tick]) -> None:
    reference = Reference()
    estimator = YawEstimator(new_controller())
    compared = 0
    for tick in turned(ticks[: round(12.0 / TICK_S)], 2.0):
        reference.feel(tick.gyro, tick.accel)
        estimator.feel(tick.gyro, tick.accel)
        if tick.velocity is None:
            continue
        reference.observe(tick.velocity, ACCURACY, flying=tick.flying)
        estimator.observe(tick.velocity, ACCURACY, np.zeros(3), flying=tick.flying)
        if math.isfinite(reference.variance):
            compared += 1
            assert math.isclose(estimator.variance, reference.variance, rel_tol=1e-6)
            assert abs(errors_deg(np.array(estimator.yaw), np.array(reference.yaw))) < 1e-4
            np.testing.assert_allclose(estimator.models[:, WEIGHT], reference.weights, atol=1e-7)
            assert np.abs(errors_deg(estimator.models[:, YAW], reference.x[:, 2])).max() < 1e-4
    assert compared > 40


# --- what becomes of it


@pytest.mark.parametrize("yaw", [-2.5, 0.3, 3.0])
def test_a_heading_is_taken_over_without_the_tilt(yaw: float) -> None:
    state = es.new_state()
    before = Rotation.from_euler("ZYX", [1.2, 0.3, -0.4])
    state[es.Q : es.RATES] = np.roll(before.as_quat(), 1)
    covariance = np.diag(np.full(es.N_STATES, 0.01)) + 0.001
    after = turn_to(state, covariance, yaw, 0.04)
    now = Rotation.from_quat(quat_wxyz_to_xyzw(state[es.Q : es.RATES]))
    np.testing.assert_allclose(now.as_euler("ZYX"), [yaw, 0.3, -0.4], atol=1e-12)
    world = now.as_matrix()
    block = after[es.ATT : es.GYRO, es.ATT : es.GYRO]
    np.testing.assert_allclose(world @ block @ world.T, np.diag([0.011, 0.011, 0.04]), atol=1e-12)
    assert np.linalg.eigvalsh(after).min() > 0.0


class Told(YawEstimator):
    """Estimator with a fixed heading error, uncertainty, and explained share of the motion."""

    def __init__(self, off_deg: float, sigma_deg: float, explained: float) -> None:
        super().__init__(new_controller())
        self._shared[5:7] = math.radians(off_deg), math.radians(sigma_deg) ** 2
        self._explained = explained

    def explained(self, yaw: float) -> float:
        return self._explained


@pytest.mark.parametrize(
    ("off_deg", "sigma_deg", "explained", "suspected"),
    [
        (24.0, 1.0, 1.0, False),
        (26.0, 1.0, 1.0, True),
        (26.0, 9.0, 1.0, False),
        (180.0, 50.0, 1.0, True),
        (180.0, 5.0, 0.95, False),
    ],
)
def test_a_heading_is_suspected_that_is_off_by_far_and_explains_the_motion(
    off_deg: float, sigma_deg: float, explained: float, suspected: bool
) -> None:
    yaw = Told(off_deg, sigma_deg, explained)
    assert EmergencyYaw().is_suspected(es.new_state(), yaw) is suspected
    assert not EmergencyYaw().is_suspected(es.new_state(), YawEstimator(new_controller())), (
        "nothing is known"
    )


@pytest.mark.parametrize(("sigma_deg", "refused", "doubted"), [(9, 1, 1), (12, 1, 0), (16, 0, 0)])
def test_it_is_given_up_for_one_that_is_sure(sigma_deg: float, refused: int, doubted: int) -> None:
    """Surer where the inertial sensors may be to blame instead; a doubt waits 2 s for it."""
    yaw, emergency = Told(90.0, sigma_deg, 1.0), EmergencyYaw()
    assert not emergency.is_due(10_000_000, yaw, 9_100_000)
    assert emergency.is_due(10_000_000, yaw, 9_000_000) == bool(refused)
    emergency.doubt(10_500_000)
    assert emergency.is_due(12_500_000, yaw, 12_400_000) == bool(doubted)
    assert not emergency.is_due(12_600_000, yaw, 12_500_000)


def heading_error_deg(rig: Rig) -> float:
    estimated = quat_yaw(rig.ap.estimator.state[es.Q : es.RATES])
    return float(errors_deg(np.array(estimated), np.array(quat_yaw(rig.truth.quaternion))))


@pytest.mark.parametrize("bias", ["0,0.15,0", "-0.4,0,0"], ids=["37 deg", "180 deg"])
def test_a_compass_that_is_wrong_from_the_start_is_survived(bias: str) -> None:
    """Its field is as strong as the earth's: no check finds it, and it is flown by at first."""
    with flight(1, faults=(f"mag bias {bias}gauss",)) as rig:
        rig.boot()
        assert abs(heading_error_deg(rig)) > 30.0
        rig.take_off(5.0, settle_s=0.0)
        rig.go_offboard(velocity_setpoint(2.0, 0.0, 0.0))
        rig.run(4.0)
        assert rig.ap.estimator.recovery.emergency.resets == 1
        assert abs(heading_error_deg(rig)) < 10.0
        assert rig.said("Compass needs calibration - Land now!") > 0.0
        assert rig.truth.velocity[0] > 1.5
        rig.ap.set_mode(Mode.LAND)
        rig.until(lambda: rig.ap.flight.phase is FlightPhase.STANDBY, 30.0)
        assert max(hit.speed_m_s for hit in rig.sim.plant.collisions) < 1.0


@pytest.mark.parametrize("seed", [18, 136])
def test_a_gyro_that_tilts_it_too_leaves_a_right_heading_alone(seed: int) -> None:
    """In the climb the vehicle leans against where it goes: as if it pointed backwards."""
    flown = fly_fault(quad(), "gyro bias 2,2,2deg/s", "climb", seed)
    assert flown.end == "landed"
    assert "Estimator biases reset: IMU and GNSS disagree" in flown.said
    assert "Compass needs calibration - Land now!" not in flown.said


def test_a_heading_that_was_taken_for_biases_takes_them_along() -> None:
    """The yaw estimator is not sure yet when the filter is restarted; then it is."""
    with flight(310, faults=("mag bias -0.4,0,0gauss",)) as rig:
        rig.take_off(5.0, settle_s=3.0)
        estimator = rig.ap.estimator
        assert (estimator.recovery.consistency.restarts, estimator.recovery.emergency.resets) == (
            1,
            1,
        )
        assert abs(heading_error_deg(rig)) < 10.0
        assert np.abs(estimator.state[es.GYRO_BIAS : es.ACCEL_BIAS]).max() < math.radians(1.5)
        assert np.abs(estimator.state[es.ACCEL_BIAS : es.BARO_OFFSET]).max() < 0.3


def test_a_healthy_compass_is_never_doubted() -> None:
    with flight(2) as rig:
        rig.take_off(3.0, settle_s=0.0)
        rig.go_offboard(velocity_setpoint(4.0, 0.0, 0.0))
        rig.run(3.0)
        rig.stream(velocity_setpoint(-4.0, 2.0, 0.0, yaw=2.0))
        rig.run(3.0)
        estimator = rig.ap.estimator
        assert estimator.recovery.emergency.resets == 0
        assert estimator.yaw.variance < math.radians(15.0) ** 2, "it was asked, and agreed"
