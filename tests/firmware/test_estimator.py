"""The estimator: its Jacobians, its consistency over long flights, its answer to bad data.

Consistency after Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
Navigation, ch. 5.4: normalised innovations (NIS), normalised errors (NEES), whiteness.
"""

from __future__ import annotations

import ast
import math
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import firmware_sim.autopilot
from airl_mav.core.constants import GRAVITY_M_S2, TICK_S, TICK_US
from airl_mav.core.frames import (
    HOME,
    MAGNETIC_FIELD_NED,
    geodetic_to_local,
    local_to_geodetic,
    quat_wxyz_to_xyzw,
)
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.autopilot_state import StateEstimate
from firmware_sim.autopilot.error_state import GATE, N_STATES
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.interfaces import BatterySample, GpsFix, SensorSample
from tests.support.flight_rig import Rig, flight, quad, velocity_setpoint

SENSORS = quad().sensors
VALUE = Parameters(quad().parameters).__getitem__
BATTERY = BatterySample(16.0, 1.0, 0.0, 1.0)


def scipy_of(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(quat_wxyz_to_xyzw(q))


# --- a made-up flight, so that every number is known and the plant has no part in it


def pressure_hpa(altitude: float) -> float:
    """ICAO Doc 7488: the troposphere."""
    return 1013.25 * (1 - 0.0065 * altitude / 288.15) ** 5.255877


@dataclass
class Flight:
    """Rest for three seconds, then circle with swinging attitude, in samples of a tick."""

    seconds: float
    accel_bias: np.ndarray
    gyro_bias: np.ndarray
    noise: float = 1.0
    """Share of the shipped sensors' noise."""
    seed: int = 0
    heading: float = 0.7

    def motion(self, t: float) -> tuple[np.ndarray, np.ndarray, Rotation]:
        """Return position, velocity NED and attitude."""
        moving = max(0.0, t - 3.0)
        # Everything starts and grows smoothly: u ~ s² near 0, ~ s later.
        s = moving**2 / (moving + 2.0)
        ds = moving * (moving + 4.0) / (moving + 2.0) ** 2
        w = 0.8
        p = np.array([4 * math.sin(w * s), 4 - 4 * math.cos(w * s), -1.5 + 1.5 * math.cos(w * s)])
        v = w * ds * np.array([4 * math.cos(w * s), 4 * math.sin(w * s), -1.5 * math.sin(w * s)])
        roll, pitch = 0.35 * math.sin(1.3 * s), 0.3 * math.sin(0.9 * s)
        yaw = self.heading + 1.2 * math.sin(0.5 * s)
        return p, v, Rotation.from_euler("ZYX", [yaw, pitch, roll])

    def samples(self) -> Iterator[tuple[SensorSample, np.ndarray, np.ndarray, Rotation]]:
        """Yield each tick's sample with the true position, velocity, attitude at its time."""
        rng = np.random.default_rng(self.seed)
        imu, k = SENSORS.imu, self.noise
        _, v_before, r_before = self.motion(-TICK_S)
        for tick in range(round(self.seconds / TICK_S)):
            p, v, r = self.motion(tick * TICK_S)
            force = r_before.inv().apply((v - v_before) / TICK_S - [0, 0, GRAVITY_M_S2])
            rates = (r_before.inv() * r).as_rotvec() / TICK_S
            v_before, r_before = v, r
            gps = mag = pressure = None
            if tick % 25 == 0:
                place = p + k * rng.normal(0, [0.1, 0.1, 0.2])
                speed = v + k * SENSORS.gps.velocity_noise_m_s * rng.standard_normal(3)
                gps = GpsFix(local_to_geodetic(place, HOME), speed, 0.1, 0.2, 12)
            if tick % 5 == 0:
                field = r.inv().apply(MAGNETIC_FIELD_NED)
                mag = field + k * SENSORS.magnetometer.noise_gauss * rng.standard_normal(3)
                pressure = pressure_hpa(HOME.altitude_m - p[2])
                pressure += k * SENSORS.barometer.noise_pa / 100 * rng.standard_normal()
            sample = SensorSample(
                tick * TICK_US,
                force + self.accel_bias + k * imu.accel_noise_m_s2 * rng.standard_normal(3),
                rates + self.gyro_bias + k * imu.gyro_noise_rad_s * rng.standard_normal(3),
                20.0,
                BATTERY,
                mag,
                pressure,
                gps,
            )
            yield sample, p, v, r


def unbiased(seconds: float, **changes: Any) -> Flight:
    return Flight(seconds, np.zeros(3), np.zeros(3), **changes)


@pytest.mark.nightly
def test_biases_are_found() -> None:
    accel_bias, gyro_bias = np.array([0.08, -0.05, 0.06]), np.array([0.004, -0.006, 0.005])
    estimator = Estimator(VALUE)
    estimate: StateEstimate | None = None
    early = np.zeros(3)
    for sample, *_ in Flight(60.0, accel_bias, gyro_bias).samples():
        estimator.step(sample)
        estimate = estimator.estimate()
        if sample.time_us == 1_000_000:
            early = estimate.gyro_bias
    assert estimate is not None
    assert np.abs(early - gyro_bias).max() > 0.002, "not known from the start"
    np.testing.assert_allclose(estimate.gyro_bias, gyro_bias, atol=6e-4)
    np.testing.assert_allclose(estimate.accel_bias, accel_bias, atol=0.02)
    assert np.all(np.abs(estimate.gyro_bias - gyro_bias) < 4 * estimate.sigma[9:12])
    assert np.all(np.abs(estimate.accel_bias - accel_bias) < 4 * estimate.sigma[12:15])


@pytest.mark.parametrize("heading", [-3.0, -1.5, 0.0, 1.5, 3.0])
def test_perfect_sensors_give_the_truth(heading: float) -> None:
    estimator = Estimator(VALUE)
    *_, (_, p, v, r) = flight = list(unbiased(12.0, noise=0.0, heading=heading).samples())
    estimate = run(estimator, (sample for sample, *_ in flight))[-1]
    np.testing.assert_allclose(estimate.position, p, atol=0.02)
    np.testing.assert_allclose(estimate.velocity, v, atol=0.02)
    assert (scipy_of(estimate.quaternion).inv() * r).magnitude() < math.radians(0.1)


# --- bad data


def run(estimator: Estimator, samples: Iterator[SensorSample]) -> list[StateEstimate]:
    estimates = []
    for sample in samples:
        estimator.step(sample)
        estimates.append(estimator.estimate())
    return estimates


def altered(
    samples: list[SensorSample],
    change: Callable[[SensorSample], SensorSample],
    start_s: float,
    end_s: float,
) -> Iterator[SensorSample]:
    for sample in samples:
        bad = start_s <= sample.time_us / 1e6 < end_s
        yield change(sample) if bad else sample


@cache
def undisturbed() -> tuple[list[SensorSample], list[StateEstimate]]:
    """Return the sensor samples of a flight, and the estimates."""
    samples = [sample for sample, *_ in unbiased(16.0).samples()]
    return samples, run(Estimator(VALUE), iter(samples))


def jump_gps(north_m: float) -> Callable[[SensorSample], SensorSample]:
    def change(sample: SensorSample) -> SensorSample:
        if sample.gps is None:
            return sample
        ned = geodetic_to_local(sample.gps.position, HOME)
        ned[0] += north_m
        return sample._replace(gps=sample.gps._replace(position=local_to_geodetic(ned, HOME)))

    return change


def bend_field(sample: SensorSample) -> SensorSample:
    return sample if sample.mag is None else sample._replace(mag=sample.mag[[1, 0, 2]] * [1, -1, 1])


def drop_pressure(sample: SensorSample) -> SensorSample:
    if sample.pressure_hpa is None:
        return sample
    return sample._replace(pressure_hpa=sample.pressure_hpa - 2.0)


@pytest.mark.parametrize(
    ("change", "ratio"),
    [(jump_gps(40.0), 0), (jump_gps(-15.0), 0), (drop_pressure, 1), (bend_field, 2)],
    ids=["gps 40 m", "gps 15 m", "baro 17 m", "mag 90 deg"],
)
def test_an_outlier_is_rejected_and_forgotten(
    change: Callable[[SensorSample], SensorSample], ratio: int
) -> None:
    start, end = 10.0, 11.5
    samples, clean = undisturbed()
    dirty = run(Estimator(VALUE), altered(samples, change, start, end))
    during = [e for e in dirty if start + 0.2 <= e.time_us / 1e6 < end]
    assert min(e.innovation_ratio[ratio] for e in during) > 1.0, "seen, and reported as rejected"
    for a, b in zip(clean, dirty, strict=True):
        assert np.linalg.norm(a.position - b.position) < 0.5
        assert (scipy_of(a.quaternion).inv() * scipy_of(b.quaternion)).magnitude() < 0.03
    assert dirty[-1].innovation_ratio[ratio] < 1.0
    np.testing.assert_allclose(dirty[-1].position, clean[-1].position, atol=0.1)
    np.testing.assert_allclose(dirty[-1].velocity, clean[-1].velocity, atol=0.05)


def test_without_gps_it_is_never_healthy() -> None:
    estimator = Estimator(VALUE)
    for sample, *_ in unbiased(3.0).samples():
        estimator.step(sample._replace(gps=None))
        assert not estimator.healthy
    assert estimator.origin is None


def test_it_is_healthy_only_once_converged() -> None:
    estimator = Estimator(VALUE)
    estimates = run(estimator, (s for s, *_ in unbiased(3.0).samples()))
    healthy = np.array([e.healthy for e in estimates])
    sigma = np.array([e.sigma for e in estimates])
    assert not healthy[0]
    first = int(np.argmax(healthy))
    assert 0.5 <= first * TICK_S < 3.0
    assert np.all(healthy[first:])
    ready = np.repeat([1.5, 0.3, math.radians(2.0)], 3)
    ready[8] = math.radians(5.0)
    assert np.all(sigma[first, :9] < ready)
    assert np.any(sigma[first - 1, :9] >= ready)


def test_poor_sensors_keep_it_unhealthy() -> None:
    poor = Parameters({**quad().parameters, "EKF2_GPS_V_NOISE": 5.0, "EKF2_HEAD_NOISE": 1.0})
    estimator = Estimator(poor.__getitem__)
    estimates = run(estimator, (s for s, *_ in unbiased(1.5).samples()))
    assert estimator.origin is not None
    assert not any(e.healthy for e in estimates)


# --- Jacobians, by finite differences


class Witness:
    """Filter that only records its inputs."""

    def __init__(self, covariance: np.ndarray, _noise: np.ndarray) -> None:
        self.covariance = covariance
        self.seen: list[tuple[np.ndarray, np.ndarray]] = []

    def predict(self, *_: np.ndarray) -> None:
        pass

    def restart(self, covariance: np.ndarray) -> None:
        self.covariance = covariance

    def fuse(
        self, _state: np.ndarray, innovation: np.ndarray, h: np.ndarray, _variance: np.ndarray
    ) -> float:
        self.seen.append((innovation.copy(), h.copy()))
        return 0.0


@pytest.mark.parametrize("seed", range(5))
def test_measurement_jacobians(seed: int) -> None:
    """innovation(x + dx) - innovation(x) = -H dx, for each measurement, in any attitude."""
    rng = np.random.default_rng(seed)
    estimator = Estimator(VALUE, Witness)
    run(estimator, (s for s, *_ in unbiased(2.0, noise=0.0).samples()))
    witness, state = estimator.filter, estimator.state
    assert isinstance(witness, Witness)
    r = Rotation.from_euler("ZYX", rng.uniform([-3, -0.8, -0.8], [3, 0.8, 0.8]))
    state[es.Q : es.RATES] = np.roll(r.as_quat(), 1)
    p, v = rng.normal(0, 3, 3), rng.normal(0, 3, 3)
    state[es.P : es.V], state[es.V : es.Q] = p, v
    assert estimator.origin is not None
    gps = GpsFix(local_to_geodetic(p, estimator.origin), v, 0.1, 0.2, 12)
    mag = r.inv().apply(MAGNETIC_FIELD_NED)
    sample = SensorSample(2_000_000, np.zeros(3), np.zeros(3), 20.0, BATTERY, mag, 950.0, gps)

    def measure() -> list[tuple[np.ndarray, np.ndarray]]:
        witness.seen.clear()
        estimator.step(sample)
        return list(witness.seen)

    here = measure()
    assert [len(innovation) for innovation, _ in here] == [4, 2, 1, 1]
    for i in range(N_STATES):
        error = np.zeros(N_STATES)
        error[i] = 1e-5
        es.inject(state, error)
        moved = measure()
        es.inject(state, -error)
        for (innovation, h), (after, _) in zip(here, moved, strict=True):
            slope = (after - innovation) / 1e-5
            np.testing.assert_allclose(-slope, h[:, i], atol=2e-3, err_msg=f"state {i}")


@pytest.mark.parametrize("seed", range(5))
def test_transition_matrix(seed: int) -> None:
    """The error after a step, from the error before it; rotation vectors by scipy."""
    rng = np.random.default_rng(seed)
    before = es.new_state()
    x, y, z, w = Rotation.random(rng=rng).as_quat()
    before[es.Q : es.RATES] = (w, x, y, z)
    before[es.P : es.Q] = rng.normal(0, 3, 6)
    before[es.GYRO_BIAS : es.BARO_OFFSET] = rng.normal(0, 0.1, 6)
    gyro, accel = rng.normal(0, 1, 3), rng.normal(0, 3, 3) - [0, 0, 9.8]
    f = np.eye(N_STATES)

    def step(error: np.ndarray) -> tuple[np.ndarray, Rotation]:
        state = before.copy()
        es.inject(state, error)
        es.propagate(state, gyro, accel, f, TICK_S)
        return state[es.P : es.Q], scipy_of(state[es.Q : es.RATES])

    end, r_end = step(np.zeros(N_STATES))
    numeric = np.zeros((9, N_STATES))
    for i in range(N_STATES):
        error = np.zeros(N_STATES)
        error[i] = 1e-5
        moved, r = step(error)
        turn = (r_end.inv() * r).as_rotvec()
        numeric[:, i] = np.concatenate([moved - end, turn]) / 1e-5
    step(np.zeros(N_STATES))
    # Left out by the filter: terms of second order in the time step.
    np.testing.assert_allclose(f[:9], numeric, atol=40 * TICK_S**2)
    assert np.abs(numeric - np.eye(9, N_STATES)).max() > 100 * TICK_S**2
    np.testing.assert_array_equal(f[9:], np.eye(N_STATES)[9:])


# --- consistency over a long flight in the simulator


@dataclass
class Log:
    innovations: dict[str, list[tuple[np.ndarray, np.ndarray]]]
    nees: np.ndarray  # (n, 5) of position, velocity, attitude, gyro bias, accel bias; 1 = ideal
    restarts: int


def wander(rig: Rig, seconds: float, seed: int) -> Log:
    """Fly about at up to 4 m/s with turns; log every innovation, and the error at 5 Hz."""
    rng = np.random.default_rng(seed)
    rig.take_off(8.0, settle_s=0.0)
    estimator = rig.ap.estimator
    log: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    estimator.innovations = lambda n, i, s: log.setdefault(n, []).append((i.copy(), s.copy()))
    rig.go_offboard(velocity_setpoint(0, 0, 0))
    nees, change = [], rig.time_s
    for tick in range(round(seconds / TICK_S)):
        if rig.time_s >= change:
            change = rig.time_s + rng.uniform(1.0, 3.0)
            v = rng.uniform([-4, -4, -1], [4, 4, 1])
            v -= [0.05, 0.05, 0.3] * (rig.truth.position - [0, 0, -8])
            rig.stream(velocity_setpoint(*v, yaw=rng.uniform(-3.1, 3.1)))
        rig.tick()
        if tick % 50:
            continue
        truth = rig.truth
        biases = rig.sim.plant.record["gyro_bias"][0], rig.sim.plant.record["accel_bias"][0]
        e = rig.ap.state().estimate
        assert e.time_us == truth.time_us
        assert estimator.origin is not None
        # Truth counts from HOME, the estimate from its own origin.
        place = geodetic_to_local(local_to_geodetic(truth.position, HOME), estimator.origin)
        turn = (scipy_of(e.quaternion).inv() * scipy_of(truth.quaternion)).as_rotvec()
        errors = (
            place - e.position,
            truth.velocity - e.velocity,
            turn,
            biases[0] - e.gyro_bias,
            biases[1] - e.accel_bias,
        )
        p = estimator.filter.covariance
        blocks = [p[i : i + 3, i : i + 3] for i in range(0, 15, 3)]
        nees.append([x @ np.linalg.solve(b, x) / 3 for x, b in zip(errors, blocks, strict=True)])
    return Log(log, np.array(nees), estimator.recovery.consistency.restarts)


SEEDS = (0, 1)


@pytest.fixture(scope="module")
def logs() -> list[Log]:
    found = []
    for seed in SEEDS:
        with flight(seed) as rig:
            found.append(wander(rig, 120.0, seed))
    return found


METRES_PER_PA = (pressure_hpa(490.0) - pressure_hpa(491.0)) ** -1 / 100
HORIZONTAL_FIELD = float(np.hypot(*MAGNETIC_FIELD_NED[:2]))

# name, component -> the sensor's white noise / the filter's noise (both standard deviations).
# The filter assumes more noise, to cover unmodelled errors.
NOISE_SHARE = {
    ("gps_horizontal", 0): SENSORS.gps.horizontal_noise_m / VALUE("EKF2_GPS_P_NOISE"),
    ("gps_horizontal", 1): SENSORS.gps.horizontal_noise_m / VALUE("EKF2_GPS_P_NOISE"),
    ("gps_horizontal", 2): SENSORS.gps.velocity_noise_m_s / VALUE("EKF2_GPS_V_NOISE"),
    ("gps_horizontal", 3): SENSORS.gps.velocity_noise_m_s / VALUE("EKF2_GPS_V_NOISE"),
    ("gps_vertical", 0): SENSORS.gps.vertical_noise_m / VALUE("EKF2_GPS_P_NOISE"),
    ("gps_vertical", 1): SENSORS.gps.velocity_noise_m_s / VALUE("EKF2_GPS_V_NOISE"),
    ("baro", 0): SENSORS.barometer.noise_pa * METRES_PER_PA / VALUE("EKF2_BARO_NOISE"),
    ("heading", 0): SENSORS.magnetometer.noise_gauss / HORIZONTAL_FIELD / VALUE("EKF2_HEAD_NOISE"),
}
GPS_POSITION = {("gps_horizontal", 0), ("gps_horizontal", 1), ("gps_vertical", 0)}
STATED = {
    ("gps_horizontal", 0): VALUE("EKF2_GPS_P_NOISE"),
    ("gps_horizontal", 1): VALUE("EKF2_GPS_P_NOISE"),
    ("gps_horizontal", 2): VALUE("EKF2_GPS_V_NOISE"),
    ("gps_horizontal", 3): VALUE("EKF2_GPS_V_NOISE"),
    ("gps_vertical", 0): VALUE("EKF2_GPS_P_NOISE"),
    ("gps_vertical", 1): VALUE("EKF2_GPS_V_NOISE"),
    ("baro", 0): VALUE("EKF2_BARO_NOISE"),
    ("heading", 0): VALUE("EKF2_HEAD_NOISE"),
}


def stacked(log: Log, name: str) -> tuple[np.ndarray, np.ndarray]:
    pairs = log.innovations[name]
    return np.array([i for i, _ in pairs]), np.array([s for _, s in pairs])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gps_horizontal", "gps_vertical", "baro", "heading"])
def test_nis_is_never_optimistic(logs: list[Log], name: str) -> None:
    """NIS is below the 99.9 % quantile of a filter with true noise; the gate rejects nothing."""
    for log in logs:
        i, s = stacked(log, name)
        nis = np.einsum("ni,nij,nj->n", i, np.linalg.inv(s), i)
        freedom = i.size
        assert nis.sum() < chi2.ppf(0.999, freedom)
        assert log.restarts == 0, "healthy sensors are never taken for failed ones"
        assert np.all(np.abs(i) < GATE * np.sqrt(np.einsum("nii->ni", s)))


@pytest.mark.slow
@pytest.mark.parametrize("key", sorted(set(NOISE_SHARE) - GPS_POSITION))
def test_nis_is_one_when_corrected_for_the_overstatement(
    logs: list[Log], key: tuple[str, int]
) -> None:
    name, axis = key
    assert 0.6 < NOISE_SHARE[key] < 1.0, "what the filter is told covers the noise, not much more"
    means = []
    for log in logs:
        i, s = stacked(log, name)
        true_variance = s[:, axis, axis] - STATED[key] ** 2 * (1 - NOISE_SHARE[key] ** 2)
        means.append(float((i[:, axis] ** 2 / true_variance).mean()))
        assert means[-1] == pytest.approx(1.0, abs=4 * math.sqrt(2 / len(i)) + 0.05)
    assert np.mean(means) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("key", sorted(NOISE_SHARE))
def test_innovations_are_white(logs: list[Log], key: tuple[str, int]) -> None:
    """Lag-1 autocorrelation. GPS positions carry a slow drift that the filter has no state for."""
    name, axis = key
    values, counts = [], 0
    for log in logs:
        i, s = stacked(log, name)
        x = i[:, axis] / np.sqrt(s[:, axis, axis])
        values.append(float((x[1:] * x[:-1]).mean() / (x * x).mean()))
        counts += len(x)
    assert abs(np.mean(values)) < (0.2 if key in GPS_POSITION else 3 / math.sqrt(counts) + 0.03)


@pytest.mark.slow
def test_nees(logs: list[Log]) -> None:
    """1 = errors as large as the filter says. The mean over flights; errors last long."""
    position, velocity, attitude, gyro, accel = np.mean([log.nees.mean(axis=0) for log in logs], 0)
    assert 0.5 < velocity < 1.2
    assert 0.25 < attitude < 1.2
    assert gyro < 1.2
    assert accel < 1.5
    # The GPS drift (6 cm, minutes) is in no state; the overstated noise covers most of it.
    assert position < 3.5
    for log in logs:
        assert np.quantile(log.nees[:, 1:3], 0.99) < 6.0


# --- the estimator is all that the autopilot has


def test_the_autopilot_imports_nothing_that_knows_the_truth() -> None:
    allowed = (
        "airl_mav",
        "firmware_sim.autopilot",
        "firmware_sim.engine",
        "firmware_sim.fault_timeline",  # for type checkers: faults that clients request
        "firmware_sim.interfaces",
        "numpy",
        "filterpy",
    )
    folder = Path(firmware_sim.autopilot.__file__).parent
    sources = sorted(folder.glob("*.py"))
    assert len(sources) >= 9
    for source in sources:
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            for name in names:
                standard = name.split(".")[0] in sys.stdlib_module_names
                assert standard or name.startswith(allowed), f"{source.name}: {name}"


def test_importing_the_autopilot_loads_no_plant() -> None:
    code = (
        "import sys, firmware_sim.autopilot.autopilot; "
        "bad = [m for m in sys.modules if m.startswith(('firmware_sim.plant', 'pybullet'))]; "
        "sys.exit(repr(bad) if bad else 0)"
    )
    root = Path(__file__).resolve().parents[2]
    result = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
