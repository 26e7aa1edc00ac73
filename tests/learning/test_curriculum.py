"""The curriculum: when the next zone opens, and where goals lie in each."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.envs.curriculum import CurriculumState
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import Curriculum, EnvironmentSpec
from airl_mav.envs.vector import NavigationVectorEnv


def state(window: int, threshold: float = 0.5, zones: int = 3) -> CurriculumState:
    return CurriculumState(Curriculum(window=window, threshold=threshold), zones)


def test_opens_at_the_threshold_and_not_before() -> None:
    curriculum = state(4)
    for success in (True, False, False):
        curriculum.record(0, success=success)
        assert curriculum.zone == 0
    curriculum.record(0, success=True)  # 2 of 4: half is enough
    assert curriculum.zone == 1


def test_a_full_window_is_needed_and_it_rolls() -> None:
    curriculum = state(4, 0.75)
    for success in (True, True, True):
        curriculum.record(0, success=success)
    assert curriculum.zone == 0, "three of three, but the window is four"
    curriculum = state(4, 0.75)
    for success in (False, False, True, True, True):
        assert curriculum.zone == 0
        curriculum.record(0, success=success)
    assert curriculum.zone == 1, "the first failures have rolled out"


def test_every_zone_starts_with_an_empty_window_and_the_last_one_stays() -> None:
    curriculum = state(2)
    zones = []
    for _ in range(8):
        curriculum.record(curriculum.zone, success=True)
        zones.append(curriculum.zone)
    assert zones == [0, 1, 1, 2, 2, 2, 2, 2]


def test_episodes_of_earlier_zones_do_not_count() -> None:
    curriculum = state(2)
    for _ in range(2):
        curriculum.record(0, success=True)
    for _ in range(10):
        curriculum.record(0, success=True)
    assert curriculum.zone == 1
    for _ in range(2):
        curriculum.record(1, success=True)
    assert curriculum.zone == 2


@given(
    st.lists(st.booleans(), max_size=60),
    st.integers(1, 8),
    st.floats(0.05, 1.0),
    st.integers(0, 60),
)
def test_against_a_plain_rereading_of_the_rule(
    outcomes: list[bool], window: int, threshold: float, saved: int
) -> None:
    """Also when it is saved and taken up again on the way."""
    curriculum = state(window, threshold)
    zone, since = 0, 0
    for k, success in enumerate(outcomes):
        if k == saved:
            fresh = state(window, threshold)
            fresh.restore(*curriculum.state())
            curriculum = fresh
        curriculum.record(zone, success=success)
        last = outcomes[max(since, k + 1 - window) : k + 1]
        if len(last) == window and sum(last) / window >= threshold and zone < 2:
            zone, since = zone + 1, k + 1
        assert curriculum.zone == zone


def test_zones_hold_the_smaller_ones() -> None:
    """Inclusive: goals of 7 to 16, 32, 48 m; in the last zone some lie in the first."""
    navigation = Navigation(EnvironmentSpec(arena="no-obstacles"), 100)
    for zone, radius in enumerate((16.0, 32.0, 48.0)):
        navigation.begin(range(100), range(100), zone)
        distance = navigation.flights().goal_distance_m
        assert distance.min() >= 7.0
        assert 0.8 * radius < distance.max() <= radius
        assert (distance <= 16.0).sum() >= 3
        assert navigation.zones.tolist() == [zone] * 100
    navigation.begin(range(100), range(100))
    assert np.array_equal(navigation.flights().goal_distance_m, distance), "None is the largest"


@pytest.mark.parametrize(("threshold", "expected"), [(0.5, [0, 1, 1, 2, 2]), (0.51, [0] * 5)])
def test_trains_through_the_zones(threshold: float, expected: list[int]) -> None:
    """One of two vehicles fails every time."""
    env = NavigationVectorEnv(
        2,
        arena="no-obstacles",
        curriculum={"window": 4, "threshold": threshold},
        episode={"goal_radius_m": 50},
    )
    env.reset(seed=3)
    zones = []
    for _ in range(5):
        env.navigation._fleet.position[0, 0] = -1000.0  # through the wall
        *_, info = env.step(np.array([2, 2]))
        assert info["final_info"]["outcome"].tolist() == ["collision", "success"]
        zones.append(int(info["zone"].max()))
    assert zones == expected
