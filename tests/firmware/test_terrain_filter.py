"""The filter that knows the ground, against one plain Kalman filter of 17 states."""

from __future__ import annotations

import numpy as np
import pytest

from airl_mav.core.constants import TICK_S
from airl_mav.core.frames import Vector
from firmware_sim.addons.auxiliary_estimation.terrain_filter import STEP_S, TerrainFilter
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.error_state import KernelFilter, selecting
from firmware_sim.autopilot.filter_filterpy import FilterpyFilter

N = es.N_STATES + 1
Z = es.POS + 2
GRAVITY = np.array([0.0, 0.0, -9.80665])
NOISE = np.array([0.0] * 3 + [1e-6] * 3 + [1e-8] * 3 + [1e-10] * 7)
RANGE = np.zeros(N)
RANGE[Z], RANGE[-1] = -1.0, 1.0


class Whole:
    """The textbook's equations on 17 states, the last of them the ground."""

    def __init__(self, covariance: Vector, ground: float, variance: float) -> None:
        self.p = np.zeros((N, N))
        self.p[:-1, :-1] = covariance
        self.p[-1, -1] = variance
        self.ground = ground

    def predict(self, transition: Vector, noise: Vector) -> None:
        f = np.eye(N)
        f[:-1, :-1] = transition
        self.p = f @ self.p @ f.T + np.diag(noise)

    def fuse(self, h: Vector, innovation: Vector, variance: Vector, mask: Vector) -> Vector:
        """Return the correction (17,) of a measurement; gains outside the mask are zero."""
        s = h @ self.p @ h.T + np.diag(variance)
        k = (self.p @ h.T @ np.linalg.inv(s)) * mask[:, None]
        a = np.eye(N) - k @ h
        self.p = a @ self.p @ a.T + k @ np.diag(variance) @ k.T
        correction: Vector = k @ innovation
        self.ground += float(correction[-1])
        return correction


@pytest.mark.parametrize("kind", [KernelFilter, FilterpyFilter])
@pytest.mark.parametrize("ways", [(True, True), (True, False), (False, True)])
def test_it_equals_one_filter_of_all_states(kind: type, ways: tuple[bool, bool]) -> None:
    rng = np.random.default_rng(5)
    height, ground = ways
    begun = np.diag(es.INITIAL_SIGMA**2)
    inner = kind(begun, NOISE)
    found, state, other = TerrainFilter(inner), es.new_state(), es.new_state()
    found.put(0.3, 0.2)
    found.walk_m_s, found.slope = 5.0, 0.5
    whole = Whole(begun, 0.3, 0.2)
    mask = np.ones(N)
    mask[:-1] *= height
    mask[-1] *= ground
    baro = (selecting(es.BARO) - selecting(Z)), np.array([0.04])
    place = selecting(es.POS, es.POS + 1, es.VEL, es.VEL + 1), np.array([0.1, 0.2, 0.05, 0.03])
    for tick in range(150):
        gyro, accel = rng.normal(0.0, 0.3, 3), GRAVITY + rng.normal(0.0, 1.0, 3)
        transition = np.eye(es.N_STATES)
        es.propagate(other, gyro, accel, transition, TICK_S)
        found.predict(state, gyro, accel)
        speed = float(other[es.V] ** 2 + other[es.V + 1] ** 2)
        walk = (25.0 + 0.25 * speed) * STEP_S * TICK_S
        whole.predict(transition, np.concatenate([NOISE, [walk]]))
        for h, variance in (baro, place) if tick % 5 == 0 else ():
            innovation = rng.normal(0.0, 0.1, len(h))
            assert found.fuse(state, innovation, h, variance) <= 1.0
            wide = np.hstack([h, np.zeros((len(h), 1))])
            es.inject(other, whole.fuse(wide, innovation, variance, np.ones(N))[:-1])
        if tick % 7 == 3:
            innovation = rng.normal(0.0, 0.1, 1)
            found.fuse_range(state, innovation.item(), 0.02, height=height, ground=ground)
            correction = whole.fuse(RANGE[None], innovation, np.array([0.02]), mask)
            if height:
                es.inject(other, correction[:-1])
        np.testing.assert_allclose(found.covariance, whole.p[:-1, :-1], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(found.cross, whole.p[:-1, -1], rtol=1e-6, atol=1e-9)
        assert found.variance == pytest.approx(whole.p[-1, -1], rel=1e-7)
        assert found.down == pytest.approx(whole.ground, abs=1e-9)
        np.testing.assert_allclose(state, other, atol=1e-9)
    spread = RANGE @ whole.p @ RANGE
    assert found.clearance_variance() == pytest.approx(float(spread), rel=1e-7)


def test_ground_that_is_put_by_a_range_is_as_uncertain_as_the_height() -> None:
    """The limit of a Kalman update of ground that nothing is known of."""
    covariance = np.diag(es.INITIAL_SIGMA**2)
    covariance[Z, es.VEL + 2] = covariance[es.VEL + 2, Z] = 0.1
    found = TerrainFilter(KernelFilter(covariance, NOISE))
    found.put(0.0, 1.0)
    found.put_by_range(0.7, 0.05)
    whole = Whole(covariance, 0.0, 1e9)
    whole.fuse(RANGE[None], np.array([0.7]), np.array([0.05]), np.ones(N))
    assert found.down == pytest.approx(0.7)
    assert found.variance == pytest.approx(float(whole.p[-1, -1]), rel=1e-5)
    np.testing.assert_allclose(found.cross, whole.p[:-1, -1], atol=1e-6)


def test_ground_has_nothing_to_do_with_a_height_that_is_put_elsewhere() -> None:
    covariance = np.diag(es.INITIAL_SIGMA**2)
    found = TerrainFilter(KernelFilter(covariance, NOISE))
    found.put_by_range(0.0, 0.05)
    assert found.cross[Z] == pytest.approx(covariance[Z, Z])
    new = covariance.copy()
    new[Z, Z] = 1e-4
    found.restart(new)
    assert found.cross[Z] == 0.0
    joint = np.zeros((N, N))
    joint[:-1, :-1], joint[-1, -1] = found.covariance, found.variance
    joint[:-1, -1] = joint[-1, :-1] = found.cross
    assert np.linalg.eigvalsh(joint).min() > 0.0


def test_variances_without_measure_end_nothing() -> None:
    """Variances from a client may make a numerically singular matrix."""
    terrain = TerrainFilter(KernelFilter(np.diag(es.INITIAL_SIGMA**2), NOISE))
    terrain.put(0.0, 1.0)
    terrain.cross[Z] = 0.1
    apart = np.full((es.N_STATES, es.N_STATES), 1e38)
    terrain.restart(apart)
    assert not terrain.cross.any() and terrain.variance == 1.0
    terrain.cross[Z] = 0.1
    h = selecting(es.POS, es.POS)
    terrain.fuse(es.new_state(), np.zeros(2), h, np.zeros(2))
    assert np.isfinite(terrain.cross).all() and np.isfinite(terrain.down)
