"""The compiled filter against filterpy's: over the same flight, and step by step.

Differences are in units of standard deviations, so that one tolerance serves all states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from airl_mav.core.constants import TICK_S, US_PER_S
from airl_mav.profiles.vehicle import WindSettings
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.error_state import KernelFilter, NewFilter
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.filter_filterpy import FilterpyFilter
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.interfaces import ActuatorControls, SensorSample
from tests.support.flight_rig import flight, quad, velocity_setpoint

TOLERANCE = 1e-9
WINDY = WindSettings(north_m_s=2.0, east_m_s=-1.0, gust_m_s=1.0)
FILTERS = [KernelFilter, FilterpyFilter]


# --- a whole flight


@dataclass
class Course:
    """Outputs of an estimator over a flight."""

    states: np.ndarray  # (ticks, ROW_SIZE)
    covariances: np.ndarray  # (seconds, 16, 16), once a second
    healthy: np.ndarray  # (ticks,)
    names: list[str]
    innovations: list[np.ndarray]
    innovation_covariances: list[np.ndarray]


@pytest.fixture(scope="module")
def samples() -> list[SensorSample]:
    """Record the sensor samples of a minute: rest, take-off, a restless flight in gusts."""
    with flight(3, wind=WINDY) as rig:
        seen: list[SensorSample] = []
        step = rig.ap.step

        def listen(sample: SensorSample) -> ActuatorControls:
            seen.append(sample)
            return step(sample)

        rig.step_through(listen)
        rig.take_off(6.0, settle_s=0.0)
        rng = np.random.default_rng(0)
        rig.go_offboard(velocity_setpoint(0, 0, 0))
        while rig.time_s < 60.0:
            v = rng.uniform([-4, -4, -0.6], [4, 4, 0.6])
            v -= [0.05, 0.05, 0.3] * (rig.truth.position - [0, 0, -6])
            rig.stream(velocity_setpoint(*v, yaw=math.nan, yaw_rate=rng.uniform(-1.5, 1.5)))
            rig.run(2.0)
        assert rig.truth.position[2] < -2.0
    return seen


def course(samples: Sequence[SensorSample], new_filter: NewFilter) -> Course:
    estimator = Estimator(Parameters(quad().parameters).value, new_filter)
    found = Course(np.zeros((0, 0)), np.zeros((0, 0, 0)), np.zeros(0), [], [], [])

    def note(name: str, innovation: np.ndarray, covariance: np.ndarray) -> None:
        found.names.append(name)
        found.innovations.append(innovation)
        found.innovation_covariances.append(covariance)

    estimator.innovations = note
    states, covariances, healthy = [], [], []
    for tick, sample in enumerate(samples):
        estimator.step(sample)
        states.append(estimator.state.copy())
        healthy.append(estimator.healthy)
        if tick % 250 == 0:
            covariances.append(estimator.filter.covariance.copy())
    found.states, found.covariances = np.array(states), np.array(covariances)
    found.healthy = np.array(healthy)
    return found


def units(states: np.ndarray) -> np.ndarray:
    """Return the units of nominal states: standard deviations; 1 for values without one."""
    sigma = states[:, es.SIGMA : es.RATIO]
    unit = np.ones_like(states)
    # A quaternion's component moves by half an angle; rates and acceleration have no state.
    unit[:, es.P : es.Q] = sigma[:, es.POS : es.ATT]
    unit[:, es.Q : es.RATES] = 0.5 * sigma[:, es.ATT : es.GYRO].min(axis=1, keepdims=True)
    unit[:, es.GYRO_BIAS : es.ACCELERATION] = sigma[:, es.GYRO : es.N_STATES]
    unit[:, es.SIGMA : es.RATIO] = sigma
    return unit


def worst_difference(a: Course, b: Course) -> dict[str, float]:
    """Return the maximum difference of two courses for each quantity."""
    assert a.names == b.names
    innovations, spreads = [], []
    for i, j, s, t in zip(
        a.innovations,
        b.innovations,
        a.innovation_covariances,
        b.innovation_covariances,
        strict=True,
    ):
        sigma = np.sqrt(np.diag(s))
        innovations.append(np.abs((i - j) / sigma).max())
        spreads.append(np.abs((s - t) / np.outer(sigma, sigma)).max())
    sigma = np.sqrt(np.einsum("nii->ni", a.covariances))
    correlation = (a.covariances - b.covariances) / (sigma[:, :, None] * sigma[:, None, :])
    return {
        "innovations": float(max(innovations)),
        "their covariances": float(max(spreads)),
        "covariances": float(np.abs(correlation).max()),
        "states": float(np.abs((a.states - b.states) / units(a.states)).max()),
    }


def bad_gps(sample: SensorSample) -> SensorSample:
    """40 m to the north, and too fast by 20 m/s a little later."""
    fix, t = sample.gps, sample.time_us / US_PER_S
    if fix is None:
        return sample
    if 25.0 <= t < 26.5:
        north = fix.position.latitude_deg + math.degrees(40.0 / 6.371e6)
        return sample._replace(gps=fix._replace(position=fix.position._replace(latitude_deg=north)))
    if 35.0 <= t < 35.4:
        return sample._replace(
            gps=fix._replace(velocity_ned=fix.velocity_ned + np.array([0, 20, 6]))
        )
    return sample


def bad_rest(sample: SensorSample) -> SensorSample:
    """A magnet by the compass, and a door slammed."""
    t = sample.time_us / US_PER_S
    if sample.mag is not None and 30.0 <= t < 31.0:
        sample = sample._replace(mag=sample.mag[[1, 0, 2]] * [1, -1, 1])
    if sample.pressure_hpa is not None and 40.0 <= t < 40.5:
        sample = sample._replace(pressure_hpa=sample.pressure_hpa - 3.0)
    return sample


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "rejected"),
    [(lambda s: s, []), (bad_gps, [0, 3]), (bad_rest, [1, 2])],
    ids=["clean", "GPS outliers", "baro and mag outliers"],
)
def test_a_flight_through_both_filters(
    samples: list[SensorSample],
    spoil: Callable[[SensorSample], SensorSample],
    rejected: list[int],
) -> None:
    seen = [spoil(sample) for sample in samples]
    fast, reference = course(seen, KernelFilter), course(seen, FilterpyFilter)
    difference = worst_difference(reference, fast)
    assert max(difference.values()) < TOLERANCE, difference
    np.testing.assert_array_equal(fast.healthy, reference.healthy)
    for states in (fast.states, reference.states):
        assert np.all(np.isfinite(states))
        over = (states[:, es.RATIO :] > 1.0).any(axis=0)
        assert np.flatnonzero(over).tolist() == rejected, "outliers, and nothing else, are rejected"


@pytest.mark.slow
def test_the_comparison_sees_a_millionth(samples: list[SensorSample]) -> None:
    def noisier(covariance: np.ndarray, noise: np.ndarray) -> KernelFilter:
        return KernelFilter(covariance, noise * (1.0 + 1e-6))

    short = samples[: 10 * 250]
    difference = worst_difference(course(short, FilterpyFilter), course(short, noisier))
    assert all(d > TOLERANCE for d in difference.values()), difference


def test_both_fly_the_same() -> None:
    """The whole autopilot with filterpy beside the one that flies: same motors, same words."""
    parameters = quad().parameters
    with flight(5, wind=WINDY) as rig:
        shadow = BuiltinAutopilot(Parameters(parameters), FilterpyFilter)
        step, worst = rig.ap.step, 0.0

        def side_by_side(sample: SensorSample) -> ActuatorControls:
            nonlocal worst
            mine, other = step(sample), shadow.step(sample)
            assert (mine.time_us, mine.armed) == (other.time_us, other.armed)
            worst = max(worst, *np.abs(np.subtract(mine.motors, other.motors)))
            return mine

        rig.step_through(side_by_side)
        rig.boot()
        for pilot in (rig.ap, shadow):
            assert pilot.arm(force=False) is Result.ACCEPTED
            assert pilot.takeoff(3.0) is Result.ACCEPTED
        rig.run(8.0)
        assert rig.height > 2.0
        for pilot in (rig.ap, shadow):
            pilot.set_mode(Mode.LAND)
        rig.until(lambda: rig.ap.flight.phase < 2, 20.0)
        assert worst < TOLERANCE
        assert rig.ap.take_messages() == shadow.take_messages()


# --- single steps, against the textbook

seeds = st.integers(0, 2**32 - 1)


def random_state(rng: np.random.Generator) -> np.ndarray:
    state = es.new_state()
    state[es.P : es.Q] = rng.normal(0, 5, 6)
    x, y, z, w = Rotation.random(rng=rng).as_quat()
    state[es.Q : es.RATES] = (w, x, y, z)
    state[es.GYRO_BIAS : es.ACCELERATION] = rng.normal(0, 0.1, 7)
    return state


def random_covariance(rng: np.random.Generator) -> np.ndarray:
    root = rng.normal(0, 1, (16, 16)) * np.logspace(-3, 1, 16)[rng.permutation(16), None]
    product = root @ root.T
    return 0.5 * (product + product.T)


@given(seeds)
def test_prediction_is_the_textbooks(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p, noise = random_covariance(rng), rng.uniform(0, 0.1, 16)
    state, gyro, accel = random_state(rng), rng.normal(0, 3, 3), rng.normal(0, 10, 3)
    f, expected = np.eye(16), state.copy()
    es.propagate(expected, gyro, accel, f, TICK_S)
    kernel = KernelFilter(p, noise)
    kernel.predict(state, gyro, accel)
    np.testing.assert_array_equal(state, expected)
    p = f @ p @ f.T + np.diag(noise)
    scale = np.sqrt(np.outer(np.diag(p), np.diag(p)))
    np.testing.assert_allclose(kernel.covariance / scale, p / scale, atol=1e-12)
    np.testing.assert_array_equal(kernel.covariance, kernel.covariance.T)


@given(seeds, st.integers(1, 5))
def test_fusing_one_after_the_other_is_fusing_together(seed: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    p, state = random_covariance(rng), random_state(rng)
    h = rng.normal(0, 1, (m, 16)) * (rng.random((m, 16)) < 0.4)
    variance = rng.uniform(0.1, 2.0, m)
    s = h @ p @ h.T + np.diag(variance)
    innovation = rng.normal(0, 1, m) * np.sqrt(np.diag(s))
    gain = p @ h.T @ np.linalg.inv(s)
    expected = state.copy()
    es.inject(expected, gain @ innovation)
    kernel = KernelFilter(p, np.zeros(16))
    ratio = kernel.fuse(state, innovation, h, variance)
    assert ratio == pytest.approx(np.max(np.abs(innovation) / np.sqrt(np.diag(s))) / 5.0, rel=1e-9)
    # Joseph's form, the one that rounding hurts least.
    rest = np.eye(16) - gain @ h
    p = rest @ p @ rest.T + gain @ np.diag(variance) @ gain.T
    scale = np.sqrt(np.outer(np.diag(p), np.diag(p)))
    np.testing.assert_allclose(state, expected, atol=1e-8)
    np.testing.assert_allclose(kernel.covariance / scale, p / scale, atol=1e-6)
    np.testing.assert_array_equal(kernel.covariance, kernel.covariance.T)


@pytest.mark.parametrize("new_filter", FILTERS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, 25.0], ids=str)
def test_what_fails_the_gate_changes_nothing(new_filter: NewFilter, bad: float) -> None:
    rng = np.random.default_rng(0)
    carried = new_filter(np.diag(es.INITIAL_SIGMA**2), np.full(16, 1e-6))
    state = random_state(rng)
    before, covariance = state.copy(), carried.covariance.copy()
    h = np.eye(16)[[es.POS, es.VEL]]
    # Standard deviations of the innovation: sqrt(1 + 3), sqrt(0.25 + 0.75).
    for innovation in ([bad, 0.1], [0.1, bad]):
        ratio = carried.fuse(state, np.array(innovation), h, np.array([3.0, 0.75]))
        assert not ratio <= 1.0
    np.testing.assert_array_equal(state, before)
    np.testing.assert_array_equal(carried.covariance, covariance)
    # Just inside the gate, on both components, it is fused.
    assert carried.fuse(state, np.array([9.9, -4.9]), h, np.array([3.0, 0.75])) < 1.0
    assert not np.array_equal(state, before)


@pytest.mark.parametrize("new_filter", FILTERS)
def test_the_diagonal_decides_who_is_converged(new_filter: NewFilter) -> None:
    ready = np.repeat([1.5, 0.3, math.radians(2.0), 1.0, 1.0], 3)
    ready[8] = math.radians(5.0)
    sigma = np.append(ready, 1.0)
    state = es.new_state()
    just = new_filter(np.diag((sigma * 0.999) ** 2), np.zeros(16)).covariance
    assert es.converged(state, just)
    np.testing.assert_allclose(state[es.SIGMA : es.RATIO], sigma * 0.999)
    for i in range(9):
        less = just.copy()
        less[i, i] = (1.001 * sigma[i]) ** 2
        assert not es.converged(state, less)
    for i in range(16):
        for value in (math.nan, math.inf, -1.0):
            spoiled = just.copy()
            spoiled[i, i] = value
            assert not es.converged(state, spoiled)
