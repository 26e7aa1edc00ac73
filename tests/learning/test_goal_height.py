"""Vectorized simulator in three dimensions: goal observations, verdicts, flights through gates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from airl_mav.addons.imitation.imitation import StatefulExpert
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.envs.evaluation import fly_seeds, success_rate
from airl_mav.envs.fleet import FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.navigation_env import NavigationEnv
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from airl_mav.flight.judge import Outcome, Referee, Task, TruthSample
from airl_mav.policy.actions import commands
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from tests.learning.test_imitation import SMALL, Taught

GATES: dict[str, Any] = {
    "arena": "gates",
    "actions": "velocity3d-fixed-yaw",
    "max_speed_m_s": 4.0,
    "goal_height": True,
    "episode": {"hold_s": 0.2, "goal_radius_m": 1.0, "time_limit_s": 60.0},
}
GOAL = (12.0, 0.0, -4.0)


def spec_with(**knobs: Any) -> EnvironmentSpec:
    return spec_of(None, SMALL | knobs)


def plain_with_goal(height_m: float | None) -> ArenaSpec:
    whole = load_profile("arenas", "no-obstacles", ArenaSpec).model_dump()
    whole["goal"] |= {"north_m": GOAL[0], "east_m": GOAL[1], "height_m": height_m}
    return ArenaSpec.model_validate(whole)


def flying(height_m: float | None, **knobs: Any) -> Navigation:
    rules = {"hold_s": 0.2, "goal_radius_m": 1.0, "time_limit_s": 30.0, "altitude_m": 2.0}
    spec = spec_with(episode=rules, actions="velocity3d-fixed-yaw", **knobs)
    navigation = Navigation(spec, 1, arena=plain_with_goal(height_m))
    navigation.begin([0], [3])
    return navigation


def test_the_goal_has_its_height_in_the_observation() -> None:
    navigation = Navigation(spec_with(**GATES), 3)
    navigation.begin([0, 1, 2], [5, 6, 7])
    for _ in range(5):
        navigation.fly(np.tile((1.0, 0.5, 0.0, -0.7), (3, 1)))
    truth, seen, encoded = navigation.truth(), navigation.see(), navigation.observe()
    reported = navigation.kinematics()
    for i in range(3):
        arena = navigation.arenas[i]
        assert arena is not None
        assert arena.goal_height_m is not None
        below = -arena.goal_height_m - reported.position[i, 2]
        assert encoded["goal"][i, 3] == pytest.approx(below / 5.0, abs=1e-6)
        away = np.array([*arena.goal, -arena.goal_height_m]) - truth.position[i]
        assert navigation.flights().goal_distance_m[i] == pytest.approx(np.linalg.norm(away))
    assert encoded["goal"].shape == (3, 4)
    # The first three values do not depend on `goal_height`.
    untold = Navigation(spec_with(**(GATES | {"goal_height": False})), 3)
    untold.begin([0, 1, 2], [5, 6, 7])
    for _ in range(5):
        untold.fly(np.tile((1.0, 0.5, 0.0, -0.7), (3, 1)))
    assert seen.goal_down is not None
    np.testing.assert_array_equal(untold.observe()["goal"], encoded["goal"][:, :3])


def test_a_vertical_speed_is_flown_and_without_one_the_altitude_is_held() -> None:
    climbing = flying(4.0)
    heights = []
    for _ in range(20):
        climbing.fly(np.array([[0.0, 0.0, 0.0, -1.0]]))
        heights.append(-climbing.truth().position[0, 2])
    # 1 m/s in a steady climb: a decision is the hold and 1 ms of inference.
    assert heights[-1] - heights[9] == pytest.approx(10 * 0.201, abs=0.1)
    assert climbing.truth().velocity[0, 2] == pytest.approx(-1.0, abs=0.05)
    holding = flying(4.0)
    for _ in range(20):
        holding.fly(np.array([[0.0, 0.0, 0.0]]))
    assert -holding.truth().position[0, 2] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(
    ("height_m", "climb", "reached"),
    [
        (4.0, 0.0, False),  # It passes two metres below.
        (None, 0.0, True),
        (4.0, 0.35, True),
        (None, 0.35, True),
    ],
)
def test_the_twin_judges_as_the_referee(
    height_m: float | None, climb: float, reached: bool
) -> None:
    navigation = flying(height_m)
    goal = GOAL if height_m is not None else GOAL[:2]
    referee = Referee(Task(goal, 1.0, 30.0))
    referee.start_navigation(0)
    for _ in range(35):
        navigation.fly(np.array([[2.0, 0.0, 0.0, -climb]]))
        verdict = referee.observe(
            TruthSample(
                int(navigation.fleet.time_us[0]),
                tuple(navigation.truth().position[0].tolist()),
                None,
                1.0,
            )
        )
        succeeded = navigation.flights().verdict[0] == FlightStatus.SUCCESS
        assert succeeded is np.bool_(verdict is not None)
        if succeeded:
            assert verdict is not None
            assert verdict.outcome is Outcome.SUCCESS
            break
    assert bool(succeeded) is reached


def test_the_expert_flies_through_the_openings() -> None:
    spec = spec_with(**GATES)
    navigation = Navigation(spec, 20)
    flown = [each for _, each in fly_seeds(navigation, Taught(navigation, "gates"), range(40))]
    assert success_rate(flown) >= 0.975


def test_actions_and_observations_of_the_environment() -> None:
    env = NavigationEnv(spec_with(**GATES))
    assert env.action_space.shape == (3,)
    assert env.observation_space["goal"].shape == (4,)  # type: ignore[index]
    env.reset(seed=1)
    _, _, _, _, info = env.step(np.array([1.0, 0.0, -1.0], np.float32))
    assert info["goal_distance_m"] > 0.0


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(FieldError, match=r"goal_height.*false in arena 'no-obstacles'"):
        Navigation(spec_with(arena="no-obstacles", goal_height=True), 1)
    with pytest.raises(UsageError, match="goal_height = true: accepted: false with layout 'paper'"):
        Navigation(spec_of(None, {"layout": "paper", "goal_height": True, "arena": "gates"}), 1)
    planar = Navigation(spec_with(arena="gates", actions="velocity"), 1)
    with pytest.raises(FieldError, match=r"velocity3d.* with expert gates"):
        StatefulExpert("gates", planar)
    steep = Navigation(spec_with(arena="gates", actions="velocity3d"), 1)
    with pytest.raises(FieldError, match="one without a vertical speed"):
        StatefulExpert("planner", steep)
    with pytest.raises(ValueError, match=r"accepted: \(1, 3\) or \(1, 4\)"):
        steep.fly(np.zeros((1, 5)))


def test_the_discrete_set_climbs_and_sinks() -> None:
    spec = spec_with(actions="arc3d-75").action_spec
    found = commands(spec, np.arange(75))
    assert sorted(set(found[:, 3].tolist())) == [-1.5, 0.0, 1.5]
