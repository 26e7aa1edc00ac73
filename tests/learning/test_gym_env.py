"""`airl/Navigation-v0` as Gymnasium and stable-baselines3 want an environment."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3

from airl_mav.arena.generate import generate
from airl_mav.core.errors import UsageError
from airl_mav.envs.navigation_env import FIRST_TRAINING_SEED, NavigationEnv
from airl_mav.envs.registration import NAVIGATION
from airl_mav.envs.sb3 import NavigationVecEnv
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from tests.support.processes import ROOT

PAPER: dict[str, Any] = {
    "layout": "paper",
    "image_width_px": 256,
    "image_height_px": 154,
    "camera": {"width_px": 256, "height_px": 144},
    "actions": "paper-25",
    "reward": "paper",
}
DOOR = f"airl_mav:{NAVIGATION}"
"""Environment id passed to Gymnasium."""

FORWARD = 22
"""`arc-25`: full speed ahead."""


@pytest.mark.parametrize(
    "knobs",
    [
        {},
        {"actions": "velocity", "arena": "dynamic-obstacles"},
        PAPER,
        {"curriculum": {"window": 5}, "delay": {"computer": "ras-pi-4"}},
    ],
    ids=["default", "continuous", "paper", "curriculum"],
)
def test_both_checkers_are_content(knobs: dict[str, Any]) -> None:
    """Neither an error nor a warning: pytest turns those into errors. With all render modes."""
    env = gym.make(NAVIGATION, render_mode="rgb_array", **knobs).unwrapped
    check_env(env)
    check_env_for_sb3(env, skip_render_check=False)


def test_gymnasium_records_a_video_of_an_episode(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="needs the extra film")
    pytest.importorskip("moviepy", reason="needs the extra film")
    plain = gym.make(NAVIGATION, render_mode="rgb_array", arena="no-obstacles")
    with gym.wrappers.RecordVideo(plain, str(tmp_path / "films")) as env:
        env.reset(seed=1)
        for _ in range(3):
            env.step(FORWARD)
    (path,) = tmp_path.glob("films/*.mp4")
    with av.open(str(path)) as film:
        frames = list(film.decode(video=0))
        assert film.streams.video[0].average_rate == NavigationEnv.metadata["render_fps"]
    assert [(frame.width, frame.height) for frame in frames] == [(960, 540)] * 4


def test_sb3_trains_on_the_environment_s_name_alone() -> None:
    """With its own image network, which has no room in the 32x24 px of the training files."""
    torch.set_num_threads(1)
    model = PPO("MultiInputPolicy", DOOR, n_steps=128, batch_size=64, n_epochs=2, seed=1)
    before = model.policy.state_dict()["action_net.weight"].clone()
    model.learn(256)
    assert model.num_timesteps == 256
    assert not before.equal(model.policy.state_dict()["action_net.weight"])


def test_the_hyper_parameters_for_rl_zoo_are_such_as_sb3_takes() -> None:
    """Read the file as rl-zoo3 does: by id; all but three keys are arguments of the learner."""
    yaml = pytest.importorskip("yaml", reason="needs the [docs] extra")
    asked = yaml.safe_load((ROOT / "examples/rl_zoo3_ppo.yml").read_text())[NAVIGATION]
    flights, steps = asked.pop("n_envs"), asked.pop("n_timesteps")
    env = NavigationVecEnv(NavigationVectorEnv(flights, arena="no-obstacles"))
    model = PPO(env=env, **asked)
    assert steps >= flights * model.n_steps, "at least one rollout"
    assert flights * model.n_steps % model.batch_size == 0, "whole batches"
    # One short rollout is enough to see that the network fits what it sees.
    torch.set_num_threads(1)
    PPO(env=env, **(asked | {"n_steps": 32})).learn(flights * 32)


@pytest.mark.parametrize(
    ("knobs", "shape"),
    [
        ({}, (1, 48, 64)),
        ({"layout": "paper"}, (1, 58, 64)),
        ({"vehicle": "quad-256x144"}, (1, 144, 256)),
        ({"camera": {"width_px": 128, "height_px": 96}}, (1, 96, 128)),
        ({"image_width_px": 32}, (1, 24, 32)),
        ({"spec": EnvironmentSpec()}, (1, 24, 32)),
    ],
)
def test_the_network_sees_the_camera_s_image_unless_told(
    knobs: dict[str, Any], shape: tuple[int, ...]
) -> None:
    spaces: tuple[Any, Any] = (
        NavigationEnv(**knobs).observation_space,
        NavigationVectorEnv(2, **knobs).single_observation_space,
    )
    for space in spaces:
        assert space["depth"].shape == shape


def test_make_takes_the_knobs_and_leaves_no_wrapper_in_the_way() -> None:
    env = gym.make(
        DOOR,
        arena="dynamic-obstacles",
        episode={"hold_s": 0.3, "time_limit_s": 60},
        randomisation={"mass": 0.2},
    )
    unwrapped = env.unwrapped
    assert isinstance(unwrapped, NavigationEnv)
    assert unwrapped.environment.episode.hold_s == 0.3
    assert unwrapped.environment.randomisation.mass == 0.2
    assert unwrapped.metadata["render_fps"] == pytest.approx(1 / 0.3)
    assert env.spec is not None
    assert env.spec.id == NAVIGATION
    _, info = env.reset(seed=1)
    assert info["seed"] == 1
    env.step(env.action_space.sample())
    env.close()


def test_make_vec_is_the_compiled_one() -> None:
    env = gym.make_vec(DOOR, num_envs=3, reward="paper-scaled")
    assert isinstance(env, NavigationVectorEnv)
    assert env.environment.reward == "paper-scaled"
    env.reset(seed=1)
    assert env.step(env.action_space.sample())[1].shape == (3,)
    entry = gym.make_vec(NAVIGATION, num_envs=2, vectorization_mode="vector_entry_point")
    assert isinstance(entry, NavigationVectorEnv)
    one_by_one = gym.make_vec(NAVIGATION, num_envs=2, vectorization_mode="sync")
    assert isinstance(one_by_one, gym.vector.SyncVectorEnv)
    assert isinstance(one_by_one.envs[0].unwrapped, NavigationEnv)


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"arean": "x"}, "unexpected keyword argument 'arean'; did you mean 'arena'?"),
        (
            {"reward": "best"},
            "reward 'best': accepted: 'shaped', .*'paper', FILE.py:NAME or MOD",
        ),
        ({"episode": {"hold_s": 0.001}}, r"episode\.hold_s 0\.001: accepted: 0\.02 <= value"),
        ({"episode": {"hold_s": 5, "time_limit_s": 2}}, "hold_s = 5: accepted: value < 2 s"),
        ({"episode": {"hold_s": 0.03}}, r"hold_s = 0\.03: accepted: value >= 0\.042333 s"),
        ({"delay": {"workload": "resnet"}}, "workload = 'resnet': accepted for this computer"),
        ({"delay": {"link_ms": "4"}}, r"delay\.link_ms '4': accepted: 0 <= value <= 1000 ms"),
        ({"randomisation": 3}, "randomisation 3: accepted: a table with the fields mass"),
        ({"randomisation": {"extra_delay_ms": [9, 1]}}, "extra_delay_ms.*ascending"),
        ({"curriculum": {"window": 0}}, r"curriculum\.window 0: accepted: 1 <= value"),
        ({"arena": "moon"}, "no arena profile 'moon'; shipped: "),
        ({"image_width_px": 30}, "camera 64x48 px; accepted: 30x24 px or a whole multiple"),
        ({"render_mode": "ansi"}, "render_mode = 'ansi': accepted: None, rgb_array"),
        ({"spec": EnvironmentSpec(), "arena": "x"}, "spec and arena: accepted: one or the other"),
    ],
)
def test_a_wrong_knob_gets_one_clear_line(knobs: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        NavigationEnv(**knobs)
    assert "\n" not in str(caught.value)
    if "render_mode" not in knobs:
        with pytest.raises(UsageError, match=message):
            NavigationVectorEnv(2, **knobs)


def test_what_is_offered_to_every_environment_is_refused_as_python_refuses_it() -> None:
    """TorchRL offers `frameskip`, and tries without where that is a TypeError."""
    for make in (gym.make, partial(gym.make_vec, num_envs=2)):
        with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
            make(NAVIGATION, frameskip=1)
        with pytest.raises(UsageError) as caught:
            make(NAVIGATION, episode={"frameskip": 1})
        assert not isinstance(caught.value, TypeError), "a field of one, and no argument"


def test_gymnasium_s_wrappers_of_observations_take_the_vector_environment() -> None:
    env = gym.make_vec(NAVIGATION, num_envs=3, autoreset_mode="NextStep", arena="no-obstacles")
    flat = gym.wrappers.vector.NormalizeObservation(gym.wrappers.vector.FlattenObservation(env))
    flat.reset(seed=1)
    seen = flat.step(np.array([2, 2, 2]))[0]
    assert seen.shape == (3, 64 * 48 + 6)
    assert np.isfinite(seen).all()


def test_wrong_arguments_of_the_vector_environment() -> None:
    with pytest.raises(UsageError, match="num_envs = 0: accepted: value >= 1"):
        NavigationVectorEnv(0)
    env = NavigationVectorEnv(2)
    with pytest.raises(UsageError, match="seed: 3 numbers; accepted: 2"):
        env.reset(seed=[1, 2, 3])
    for seed, line in (
        (5.0, r"seed = 5\.0: accepted: a whole number, or one for each"),
        ("5", "seed = '5': accepted: a whole number, or one for each"),
        ([-1, 2], "seed = -1: accepted: a whole number, 0 to"),
        ([1.0, 2], r"seed = 1\.0: accepted: a whole number, 0 to"),
        ([1, 2**63], "seed = 9223372036854775808: accepted: a whole number, 0 to"),
    ):
        wrong: Any = seed
        with pytest.raises(UsageError, match=line):
            env.reset(seed=wrong)
    with pytest.raises(UsageError, match="seed = 9223372036854775808: accepted"):
        NavigationEnv().reset(seed=2**63)


@pytest.mark.parametrize(
    ("knobs", "action", "line"),
    [
        ({}, -1, "action -1: accepted: 0 <= value <= 24"),
        ({}, 25, "action 25: accepted: 0 <= value <= 24"),
        ({}, 3.0, "type float64: accepted: whole numbers"),
        ({}, True, "type bool: accepted: whole numbers"),
        ({}, None, "type object: accepted: whole numbers"),
        ({}, [3], r"shape \(1,\): accepted: \(\)"),
        ({"actions": "velocity"}, [np.nan, 0.0], "action nan: accepted: numbers, -1 to 1"),
        ({"actions": "velocity"}, [0.5, 0.0, 0.5], r"shape \(3,\): accepted: \(2,\)"),
        ({"actions": "velocity"}, 0.5, r"shape \(\): accepted: \(2,\)"),
        ({"actions": "velocity"}, ["a", "b"], "type <U1: accepted: numbers"),
        ({"actions": "velocity3d"}, [0.5, 0.0], r"shape \(2,\): accepted: \(3,\)"),
        ({"actions": "velocity3d"}, [0.5, 0.0, np.nan], "action nan: accepted: numbers"),
    ],
)
def test_what_is_no_action_of_the_set_is_not_flown(
    knobs: dict[str, Any], action: Any, line: str
) -> None:
    """Reject an invalid action without moving; the episode continues with a valid action."""
    env, many = NavigationEnv(**knobs), NavigationVectorEnv(2, **knobs)
    env.reset(seed=1)
    many.reset(seed=[1, 2])
    valid: Any = env.action_space.sample()
    with pytest.raises(gym.error.InvalidAction, match=line) as caught:
        env.step(action)
    assert "\n" not in str(caught.value)
    if np.shape(action) == np.shape(valid):
        with pytest.raises(gym.error.InvalidAction, match=line):
            many.step(np.array([valid, action], np.asarray(action).dtype))
    with pytest.raises(gym.error.InvalidAction, match=r"accepted: \(2,"):
        many.step(np.array([valid] * 3))
    assert env.navigation.fleet.time_us[0] == 0
    assert not many.navigation.fleet.time_us.any()
    env.step(valid)


def test_numbers_beyond_the_stick_are_cut_off() -> None:
    env, within = NavigationEnv(actions="velocity"), NavigationEnv(actions="velocity")
    for each, action in ((env, [np.inf, -7.0]), (within, [1.0, -1.0])):
        each.reset(seed=1)
        each.step(action)
    assert np.array_equal(env.navigation.fleet.setpoint, within.navigation.fleet.setpoint)


def test_the_seed_of_reset_is_that_of_the_episode() -> None:
    arena_spec = load_profile("arenas", "static-obstacles", ArenaSpec)
    env = NavigationEnv()
    for seed in (0, 7, 7, 123_456_789):
        _, info = env.reset(seed=seed)
        expected = generate(arena_spec, seed, name="static-obstacles", vehicle_width_m=0.55)
        assert info["seed"] == seed
        arena = env.navigation.arenas[0]
        assert arena is not None
        assert np.array_equal(arena.goal, expected.goal)
        assert np.array_equal(arena.obstacles.center, expected.obstacles.center)
        assert info["goal_distance_m"] == pytest.approx(np.hypot(*expected.goal))


def test_later_episodes_are_drawn_from_the_first_seed() -> None:
    def seeds(env: NavigationEnv, first: int) -> list[int]:
        return [env.reset(seed=first)[1]["seed"], *(env.reset()[1]["seed"] for _ in range(3))]

    env = NavigationEnv()
    first = seeds(env, 5)
    assert first == seeds(NavigationEnv(), 5)
    assert first == seeds(env, 5)
    assert first[1:] != seeds(env, 6)[1:]
    assert all(seed >= FIRST_TRAINING_SEED for seed in first[1:])
    assert len(set(first)) == 4


def test_zones_bound_the_goal_until_a_seed_or_options_come() -> None:
    env = NavigationEnv()
    _, info = env.reset(seed=2, options={"zone": 0})
    for _ in range(15):
        assert info["zone"] == 0
        assert 7.0 <= info["goal_distance_m"] <= 16.0
        _, info = env.reset()
    assert env.reset(seed=2)[1]["zone"] == -1
    assert env.reset(options={"zone": 1})[1]["zone"] == 1
    for options, message in (
        ({"zone": 3}, "zone 3: accepted: 0 <= value <= 2"),
        ({"zone": 1.5}, "zone = 1.5: accepted: a whole number"),
        ({"zone": True}, "zone = True: accepted: a whole number"),
        ({"zon": 1}, "options: zon; accepted: zone"),
    ):
        with pytest.raises(UsageError, match=message):
            env.reset(options=options)


def test_info_carries_the_quality_of_flight() -> None:
    env = NavigationEnv(arena="no-obstacles")
    _, info = env.reset(seed=4)
    start, goal = env.navigation.fleet.position[0].copy(), info["goal_distance_m"]
    assert (info["flight_time_s"], info["distance_m"], info["energy_j"]) == (0.0, 0.0, 0.0)
    ended, steps = False, 0
    while not ended:
        before = info
        _, _, terminated, truncated, info = env.step(np.int64(FORWARD))
        ended = terminated or truncated
        steps += 1
        assert info["flight_time_s"] > before["flight_time_s"]
        assert info["energy_j"] > before["energy_j"]
        assert ("outcome" in info) == ended
        assert info["goal_distance_m"] <= goal + info["distance_m"]
        if not ended:
            # One decision: 1 ms of inference (rounded to a tick: none) and 0.5 s of hold.
            assert info["flight_time_s"] == pytest.approx(0.5 * steps)
    assert (terminated, truncated) == (True, False)
    assert info["success"] is False
    assert info["outcome"] == "collision"
    # Straight north into the wall, 47 m from the start, the vehicle's disc 0.275 m in radius.
    north_m, _, _ = env.navigation.fleet.position[0] - start
    assert north_m == pytest.approx(46.725, abs=0.05)
    # The path is longer by the climb of the first second, 0.13 m, and the way back down.
    assert info["distance_m"] == pytest.approx(46.785, abs=0.03)
    with pytest.raises(gym.error.ResetNeeded, match="after the end"):
        env.step(FORWARD)


def test_time_limit_truncates_and_the_goal_terminates() -> None:
    env = NavigationEnv(episode={"time_limit_s": 2.0})
    env.reset(seed=4)
    steps = [env.step(2) for _ in range(4)]  # hovers
    assert [(te, tr) for _, _, te, tr, _ in steps] == [(False, False)] * 3 + [(False, True)]
    assert steps[-1][4]["outcome"] == "timeout"
    assert steps[-1][4]["flight_time_s"] == 2.0
    env = NavigationEnv(arena="no-obstacles", episode={"goal_radius_m": 50})
    env.reset(seed=4)
    _, _, terminated, truncated, info = env.step(FORWARD)
    assert (terminated, truncated, info["success"]) == (True, False, True)


def test_an_empty_battery_terminates() -> None:
    env = NavigationEnv()
    env.reset(seed=4)
    env.navigation.fleet.battery[0] = 1e-6
    _, reward, terminated, truncated, info = env.step(2)
    assert (terminated, truncated, info["outcome"]) == (True, False, "battery")
    assert reward < -0.9


def test_the_curriculum_opens_zones_for_the_single_environment_too() -> None:
    env = NavigationEnv(
        arena="no-obstacles", curriculum={"window": 2}, episode={"goal_radius_m": 50}
    )
    zones = []
    for _ in range(6):
        _, info = env.reset()
        zones.append(info["zone"])
        assert env.step(FORWARD)[2]
    assert zones == [0, 0, 1, 1, 2, 2]


def test_needs_a_reset_first() -> None:
    env = NavigationEnv(render_mode="rgb_array")
    with pytest.raises(gym.error.ResetNeeded, match=r"step\(\) before reset"):
        env.step(0)
    with pytest.raises(gym.error.ResetNeeded, match=r"render\(\) before reset"):
        env.render()
    with pytest.raises(gym.error.ResetNeeded):
        NavigationVectorEnv(1).step(np.array([0]))


def _near(picture: np.ndarray, colour: str, tolerance: int = 12) -> np.ndarray:
    """Pixels (k, 2) row, column of about a colour."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return np.argwhere(np.abs(picture.astype(int) - rgb).max(axis=2) <= tolerance)


def test_the_picture_shows_vehicle_goal_movers_and_depth() -> None:
    env = NavigationEnv(
        arena="dynamic-obstacles",
        render_mode="rgb_array",
        image_width_px=32,
        image_height_px=24,
    )
    seen, _ = env.reset(seed=3)
    first = env.render()
    assert first is not None
    assert first.shape == (540, 960, 3)
    assert first.dtype == np.uint8
    for _ in range(8):
        seen, *_ = env.step(FORWARD)
    later = env.render()
    assert later is not None
    # Blue is the start's wedge, which stays, and the vehicle, which has flown north: up.
    blue = [_near(each, "#1f4e8c") for each in (first, later)]
    assert blue[1][:, 0].min() < blue[0][:, 0].min() - 60
    assert blue[1][:, 0].max() == pytest.approx(blue[0][:, 0].max(), abs=2)
    # The trail leads from there to here; at first there was none.
    assert len(_near(later, "#c0392b", 60)) > len(_near(first, "#c0392b", 60)) + 50
    # Movers are where the arena says, in pixels of a metre-true map.
    orange = [_near(each, "#f0932b") for each in (first, later)]
    assert len(orange[0]) > 50
    assert set(map(tuple, orange[0])) != set(map(tuple, orange[1]))
    # The observation's depth image is drawn 336 pixels wide, each of its pixels a square.
    top, left, side = 32, 595, 10.5
    rows, columns = (np.arange(24) + 0.5) * side, (np.arange(32) + 0.5) * side
    centres = later[top + rows.astype(int)[:, None], left + columns.astype(int)[None]]
    assert np.abs(centres.astype(int) - seen["depth"][0][..., None]).max() <= 1
    assert len(np.unique(seen["depth"])) > 5


def test_pictures_are_of_now_and_of_this_episode() -> None:
    """Redraw the static layer for each episode, without marks of the previous episode."""
    env, fresh = (NavigationEnv(render_mode="rgb_array") for _ in range(2))
    env.reset(seed=3)
    env.render()
    for _ in range(5):
        env.step(FORWARD)
        env.render()
    env.reset(seed=9)
    fresh.reset(seed=9)
    again, expected = env.render(), fresh.render()
    assert again is not None
    assert expected is not None
    assert np.array_equal(again, expected)
    assert NavigationEnv().render() is None
