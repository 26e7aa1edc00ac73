"""Domain randomization: ranges, exact repetition, and nominal values by default."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from airl_mav.camera.frame import MAX_MM
from airl_mav.camera.noise import noisy_depth
from airl_mav.core.streams import Stream, stream
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec, Randomisation
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.vehicle.airframe import Airframe, draw_airframe

NOMINAL = Airframe.from_profile(load_vehicle("quad"))
GROUPS = {
    "mass": ("mass", "inertia_xx", "inertia_yy", "inertia_zz"),
    "thrust": ("thrust_max",),
    "drag": ("drag_linear", "drag_quadratic", "drag_angular"),
    "rotor_lag": ("rotor_time_constant",),
}


def factors(airframe: Airframe) -> dict[str, float]:
    """Return the factor of each field; fields that are zero are left out."""
    pairs = zip(airframe._fields, airframe, NOMINAL, strict=True)
    return {name: value / nominal for name, value, nominal in pairs if nominal}


@pytest.mark.parametrize("group", GROUPS)
def test_one_share_moves_its_own_fields_together_and_no_other(group: str) -> None:
    shares = Randomisation.model_validate({group: 0.3})
    drawn = []
    for seed in range(400):
        found = factors(draw_airframe(NOMINAL, shares, np.random.default_rng(seed)))
        own = {found[name] for name in GROUPS[group] if name in found}
        assert max(own) - min(own) < 1e-12
        drawn.append(own.pop())
        for name, factor in found.items():
            assert name in GROUPS[group] or factor == 1.0
    spread = np.array(drawn)
    assert spread.min() >= 0.7
    assert spread.max() <= 1.3
    # Uniform over the whole range.
    assert stats.kstest(spread, stats.uniform(0.7, 0.6).cdf).pvalue > 1e-3


def test_zero_is_the_profile_s_value_to_the_bit() -> None:
    for seed in range(20):
        assert draw_airframe(NOMINAL, Randomisation(), np.random.default_rng(seed)) == NOMINAL


def test_the_four_are_independent() -> None:
    shares = Randomisation(mass=0.3, thrust=0.3, drag=0.3, rotor_lag=0.3)
    rows = []
    for seed in range(500):
        found = factors(draw_airframe(NOMINAL, shares, stream(seed, Stream.AIRFRAME)))
        rows.append([found[GROUPS[name][0]] for name in GROUPS])
    correlation = np.corrcoef(np.array(rows).T) - np.eye(4)
    assert np.abs(correlation).max() < 0.2


def test_every_seed_flies_its_own_airframe() -> None:
    spec = EnvironmentSpec(arena="no-obstacles", randomisation={"mass": 0.3, "thrust": 0.1})
    navigation = Navigation(spec, 3)
    navigation.begin([0, 1, 2], [7, 8, 7])
    rows = navigation.fleet.airframe.copy()
    assert np.array_equal(rows[0], rows[2])
    assert not np.array_equal(rows[0], rows[1])
    navigation.begin([0], [8])
    assert np.array_equal(navigation.fleet.airframe[0], rows[1])
    plain = Navigation(EnvironmentSpec(arena="no-obstacles"), 1)
    plain.begin([0], [7])
    assert plain.fleet.airframe[0].tolist() == list(NOMINAL)


def test_extra_delay_is_one_value_an_episode_within_its_range() -> None:
    """Measure by flight time the delay added to t2 of every decision."""
    spec = EnvironmentSpec(
        arena="no-obstacles",
        delay={"native_ms": 0.0},
        randomisation={"extra_delay_ms": [100, 300]},
    )
    n = 60
    navigation = Navigation(spec, n)
    navigation.begin(range(n), range(n))
    times = [navigation.flights().time_s]
    for _ in range(3):
        navigation.fly(np.zeros((n, 3)))
        times.append(navigation.flights().time_s)
    extra = np.diff(times, axis=0) - 0.5
    assert np.allclose(extra, extra[0], atol=1e-9)
    assert extra.min() >= 0.1 - 0.002
    assert extra.max() <= 0.3 + 0.002
    assert stats.kstest(extra[0], stats.uniform(0.1, 0.2).cdf).pvalue > 1e-3
    navigation.begin(range(n), range(n))
    navigation.fly(np.zeros((n, 3)))
    assert np.array_equal(navigation.flights().time_s, times[1])


@pytest.mark.parametrize("depth_m", [2.0, 5.0, 10.0])
def test_depth_noise_grows_with_the_square_of_the_depth(depth_m: float) -> None:
    image = np.full((200, 200), round(1000 * depth_m), np.uint16)
    noisy = noisy_depth(image, Randomisation(depth_noise=0.02), np.random.default_rng(1))
    # 2 % of 10 m at 10 m: 0.2 m (d / 10 m)².
    sd_mm = 1000 * 0.2 * (depth_m / 10.0) ** 2
    assert noisy.dtype == np.uint16
    assert noisy.mean() == pytest.approx(1000 * depth_m, abs=5 * sd_mm / 200)
    assert noisy.std() == pytest.approx(sd_mm, rel=0.03)


def test_dropout_loses_its_share_and_nothing_comes_out_of_nothing() -> None:
    rng = np.random.default_rng(2)
    image = rng.integers(500, 20_000, (200, 200)).astype(np.uint16)
    image[:50] = 0
    noisy = noisy_depth(image, Randomisation(depth_dropout=0.1, depth_noise=0.05), rng)
    assert not noisy[:50].any()
    assert np.mean(noisy[50:] == 0) == pytest.approx(0.1, abs=0.01)
    far = np.full((100, 100), MAX_MM, np.uint16)
    assert noisy_depth(far, Randomisation(depth_noise=0.9), rng).min() >= 1, "clipped, not wrapped"


def test_no_noise_leaves_the_image_alone() -> None:
    image = np.arange(2400, dtype=np.uint16).reshape(40, 60)
    same = noisy_depth(image, Randomisation(), np.random.default_rng(3))
    assert np.array_equal(same, image)


def test_depth_noise_is_new_with_every_frame_and_exact_by_seed() -> None:
    spec = EnvironmentSpec(
        randomisation={"depth_noise": 0.02, "depth_dropout": 0.1, "navigation_noise": 0.0}
    )
    clean = Navigation(EnvironmentSpec(randomisation={"navigation_noise": 0.0}), 1)
    pair = [Navigation(spec, 1), Navigation(spec, 1)]
    for each in (clean, *pair):
        each.begin([0], [3])
    lost = []
    for _ in range(4):
        images = [each.see().depth_mm[0] for each in (clean, *pair)]
        assert np.array_equal(images[1], images[2])
        back = images[0] > 0
        assert np.mean(images[1][back] == 0) == pytest.approx(0.1, abs=0.04)
        lost.append(back & (images[1] == 0))
        for each in (clean, *pair):
            each.fly(np.zeros((1, 3)))
    assert not np.array_equal(lost[0], lost[1])
    pair[0].begin([0], [4])
    pair[1].begin([0], [3])
    assert not np.array_equal(pair[0].see().depth_mm, pair[1].see().depth_mm)
