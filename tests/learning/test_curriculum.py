"""The curriculum: when the next zone opens, and where goals lie in each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.core.errors import UsageError
from airl_mav.envs.episode_arenas import CurriculumState, stages_of
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import Curriculum, EnvironmentSpec, spec_of
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.training import training_run
from airl_mav.training.checkpoint import _read
from airl_mav.training.config import TrainingConfig
from airl_mav.training.training_folder import TrainingProgress


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
    """Fail one of the two vehicles in every episode."""
    env = NavigationVectorEnv(
        2,
        arena="no-obstacles",
        curriculum={"window": 4, "threshold": threshold},
        episode={"goal_radius_m": 50},
    )
    env.reset(seed=3)
    zones = []
    for _ in range(5):
        env.navigation.fleet.position[0, 0] = -1000.0  # through the wall
        *_, info = env.step(np.array([2, 2]))
        assert info["final_info"]["outcome"].tolist() == ["collision", "success"]
        zones.append(int(info["zone"].max()))
    assert zones == expected


EASED = {"stages": 5, "count": 0.2, "speed": 0.5, "clearance_m": 1.0}
ARENA = {
    "description": "any",
    "static": {"count": [10, 20]},
    "moving": {"count": [5, 5], "speed_m_s": [0.15, 2.0]},
}


def test_stages_grow_to_the_arena_as_it_is() -> None:
    arena = ArenaSpec.model_validate(ARENA)
    stages = stages_of(Curriculum.model_validate(EASED), arena)
    assert [stage.zone for stage in stages] == [0, 0, 1, 2, 2]
    assert [stage.arena.static.count for stage in stages] == [
        (2, 4),
        (4, 8),
        (6, 12),
        (8, 16),
        (10, 20),
    ]
    assert [stage.arena.moving.count for stage in stages] == [(k, k) for k in (1, 2, 3, 4, 5)]
    assert [stage.arena.moving.speed_m_s[1] for stage in stages] == pytest.approx(
        [1.0, 1.25, 1.5, 1.75, 2.0]
    )
    assert stages[0].arena.moving.speed_m_s[0] == 0.1, "no slower than an arena may ask for"
    assert [stage.arena.min_clearance_m for stage in stages] == pytest.approx(
        [3.0, 2.75, 2.5, 2.25, 2.0]
    )
    assert stages[-1].arena == arena
    assert [stage.zone for stage in stages_of(Curriculum(), arena)] == [0, 1, 2]
    assert all(stage.arena == arena for stage in stages_of(Curriculum(), arena)), "zones alone"


def test_episodes_are_flown_in_their_stage_and_put_back_there() -> None:
    spec = spec_of(None, {"arena": "dynamic-obstacles", "curriculum": EASED})
    counts = []
    for stage in (0, 2, 4, None):
        navigation = Navigation(spec, 3)
        navigation.begin(range(3), [5, 6, 7], stage)
        again = Navigation(spec, 3)
        again.set_state(navigation.get_state())
        for ours, theirs in zip(navigation.arenas, again.arenas, strict=True):
            assert ours is not None
            assert theirs is not None
            np.testing.assert_array_equal(ours.obstacles.center, theirs.obstacles.center)
        counts.append(sum(len(arena.obstacles) for arena in navigation.arenas if arena))
    assert counts[0] < counts[1] < counts[2] == counts[3]
    with pytest.raises(UsageError, match="zone = 5: accepted: 0 <= value <= 4, the stages"):
        navigation.begin([0], [1], 5)


class Dies(TrainingProgress):
    """Progress callback that ends the training at once, like a kill, after a number of steps."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def trained(self, steps: int, success: float | None, zone: int | None) -> None:
        if steps >= self.steps:
            raise KeyboardInterrupt


@pytest.mark.nightly
def test_what_was_learned_in_a_zone_is_kept_and_the_same_after_a_kill(tmp_path: Path) -> None:
    """Every goal is reached at once, so that each zone takes a window of episodes."""
    config = TrainingConfig.model_validate(
        {
            "description": "any",
            "steps": 400,
            "vehicles": 4,
            "checkpoint_every": 40,
            "keep_zones": True,
            "environment": {
                "arena": "no-obstacles",
                "image_width_px": 16,
                "image_height_px": 12,
                "episode": {"goal_radius_m": 50},
                "curriculum": {"window": 30, "threshold": 0.5, "stages": 4},
            },
            "algorithm": {"learning_starts": 40, "buffer_size": 200},
            "selection": {"every": 400, "episodes": 2},
        }
    )
    training_run.train(config, tmp_path / "straight", name="any")
    with pytest.raises(KeyboardInterrupt):
        training_run.train(config, tmp_path / "killed", name="any", progress=Dies(60))
    training_run.train(config, tmp_path / "killed", name="any", resume=True)
    for zone in range(3):
        kept = [tmp_path / each / "zones" / f"zone-{zone}" for each in ("straight", "killed")]
        assert (kept[0] / "model.zip").exists()
        weights, arrays, state = zip(
            *(_read(folder / (folder / "latest").read_text().strip()) for folder in kept),
            strict=True,
        )
        policies = [each["states"]["policy"] for each in weights]
        assert all(policies[0][key].equal(policies[1][key]) for key in policies[0])
        np.testing.assert_array_equal(arrays[0]["replay/actions"], arrays[1]["replay/actions"])
        steps = [each["meta"]["steps"] for each in state]
        assert steps[0] == steps[1]
        assert state[0]["meta"]["zone"] == zone + 1
    assert not (tmp_path / "straight" / "zones" / "zone-3").exists()
