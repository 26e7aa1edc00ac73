"""n flights at a time are n single ones, in Gymnasium's vector API and in stable-baselines3's."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecCheckNan, VecMonitor

from airl_mav.core.errors import UsageError
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.navigation_env import FIRST_TRAINING_SEED, NavigationEnv
from airl_mav.envs.sb3 import QUALITY, NavigationVecEnv, make_vec_env
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.policy.actions import commands

BUSY: dict[str, Any] = {
    "arena": "dynamic-obstacles",
    "delay": {"computer": "ras-pi-4", "workload": "template-5x32"},
    "episode": {"time_limit_s": 12.0, "goal_radius_m": 5.0, "hover_after_s": 0.06},
    "randomisation": {
        "mass": 0.2,
        "thrust": 0.1,
        "drag": 0.3,
        "rotor_lag": 0.2,
        "depth_noise": 0.02,
        "depth_dropout": 0.05,
        "extra_delay_ms": [0, 100],
    },
}
"""Everything that chance can decide, and short episodes."""


def assert_same(a: Any, b: Any, where: str = "") -> None:
    """Compare observations, infos, results: bit for bit, type for type."""
    assert type(a) is type(b), f"{where}: {type(a)} {type(b)}"
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}/{key}")
    elif isinstance(a, tuple | list):
        assert len(a) == len(b), where
        for k, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}/{k}")
    elif isinstance(a, np.ndarray):
        assert (a.dtype, a.shape) == (b.dtype, b.shape), where
        if a.dtype == object:
            assert_same(list(a), list(b), where)
        else:
            assert a.tobytes() == b.tobytes(), where
    else:
        assert a == b, where


class Scripted(gym.Wrapper[Any, Any, Any, Any]):
    """Takes the seeds of later episodes from a list instead of drawing them."""

    def __init__(self, env: gym.Env[Any, Any], seeds: deque[int]) -> None:
        super().__init__(env)
        self._later = seeds

    def reset(self, **keywords: Any) -> Any:
        if keywords.get("seed") is None:
            keywords["seed"] = self._later.popleft()
        return self.env.reset(**keywords)


def make_scripted(knobs: dict[str, Any], seeds: deque[int]) -> gym.Env[Any, Any]:
    return Scripted(NavigationEnv(**knobs), seeds)


def flown(env: Any, seeds: list[int | None], actions: list[Any]) -> Iterator[Any]:
    """Yield what reset and step return, with the resets that are the caller's."""
    yield env.reset(seed=seeds)
    ended = np.zeros(env.num_envs, np.bool_)
    for action in actions:
        if ended.any() and env.autoreset_mode == AutoresetMode.DISABLED:
            yield env.reset(options={"reset_mask": ended})
        result = env.step(action)
        ended = result[2] | result[3]
        yield result


@pytest.mark.parametrize(
    "knobs",
    [BUSY, {"actions": "velocity", "episode": {"time_limit_s": 6.0}, "reward": "paper"}],
    ids=["busy", "plain"],
)
@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: str(mode.name.lower()))
def test_equals_gymnasium_s_own_vector_of_single_environments(
    knobs: dict[str, Any], mode: AutoresetMode
) -> None:
    """Observations, rewards, endings, infos with masks; resets when the mode says."""
    n, steps = 4, 60
    seeds: list[int | None] = [3, 1, 4, 15]
    env = NavigationVectorEnv(n, autoreset_mode=mode, **knobs)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]
    results = list(flown(env, seeds, actions))
    later: list[deque[int]] = [deque() for _ in range(n)]
    present = np.array(seeds)
    for *_, info in results[1:]:
        for i in np.flatnonzero(info["_seed"] & (info["seed"] != present)):
            present[i] = info["seed"][i]
            later[i].append(int(present[i]))
    assert min(len(each) for each in later) >= 2, "every slot began anew"
    outcomes = {
        str(each)
        for result in results[1:]
        for each in result[-1].get("final_info", result[-1]).get("outcome", [])
    }
    assert len(outcomes - {"None"}) >= 2, "not all of them ended alike"

    own = SyncVectorEnv(
        [partial(make_scripted, knobs, later[i]) for i in range(n)], autoreset_mode=mode
    )
    assert own.single_observation_space == env.single_observation_space
    assert own.observation_space == env.observation_space
    assert own.action_space == env.action_space
    assert own.metadata["autoreset_mode"] == env.metadata["autoreset_mode"] == mode
    assert own.autoreset_mode == env.autoreset_mode
    for k, theirs in enumerate(flown(own, seeds, actions)):
        assert_same(results[k], theirs, f"call {k}")
    assert k == len(results) - 1
    assert all(not each for each in later)


def test_without_automatic_resets_a_flight_that_has_ended_is_reset_or_refused() -> None:
    knobs: dict[str, Any] = {"arena": "no-obstacles", "episode": {"time_limit_s": 1.0}}
    env = NavigationVectorEnv(2, autoreset_mode="Disabled", **knobs)
    with pytest.raises(gym.error.ResetNeeded, match="before all flights have begun"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=1, options={"zone": 2})
    while not env.step(np.array([2, 2]))[3].any():
        pass
    with pytest.raises(gym.error.ResetNeeded, match="after the end"):
        env.step(np.array([2, 2]))
    for wrong in ([True], np.array([1, 0]), np.array([False, False])):
        with pytest.raises(UsageError, match="options: reset_mask of"):
            env.reset(options={"reset_mask": wrong})
    options = {"reset_mask": np.array([True, True])}
    info = env.reset(seed=[7, 8], options=options)[1]
    assert (info["seed"].tolist(), info["zone"].tolist()) == ([7, 8], [-1, -1])
    assert list(options) == ["reset_mask"], "the caller's own is left as it was"
    with pytest.raises(UsageError, match="autoreset_mode = 'never': accepted: NextStep, SameStep"):
        NavigationVectorEnv(2, autoreset_mode="never", **knobs)
    with pytest.raises(UsageError, match="'Disabled': accepted for stable-baselines3: SameStep"):
        NavigationVecEnv(env)


def test_a_curriculum_counts_a_flight_once_however_late_the_next_begins() -> None:
    knobs: dict[str, Any] = {"arena": "no-obstacles", "episode": {"goal_radius_m": 50}}
    for mode, zones in (("SameStep", [0, 1, 1, 2]), ("NextStep", [0, 0, 0, 1])):
        env = NavigationVectorEnv(4, autoreset_mode=mode, curriculum={"window": 6}, **knobs)
        env.reset(seed=1)
        found = [env.step(np.full(4, 22))[4]["zone"].max() for _ in range(4)]
        assert found == zones, mode


def test_one_vehicle_draws_the_same_later_episodes_as_the_single_environment() -> None:
    knobs: dict[str, Any] = {"episode": {"time_limit_s": 2.0}}
    vector, single = NavigationVectorEnv(1, **knobs), NavigationEnv(**knobs)
    vector.reset(seed=[8])
    single.reset(seed=8)
    for _ in range(3):
        for _ in range(4):
            *_, info = vector.step(np.array([2]))
        assert info["seed"][0] == single.reset()[1]["seed"] >= FIRST_TRAINING_SEED


def test_an_episode_does_not_depend_on_what_flies_beside_it() -> None:
    spec = EnvironmentSpec.model_validate(BUSY)
    rng = np.random.default_rng(0)
    seeds = [11, 5, 42, 7, 1_000_003, 0, 99]
    actions = rng.integers(25, size=(25, 7))

    def fly(order: list[int]) -> dict[int, list[Any]]:
        navigation = Navigation(spec, len(order))
        navigation.begin(range(len(order)), [seeds[k] for k in order])
        history: dict[int, list[Any]] = {k: [] for k in order}
        for row in actions:
            for i, k in enumerate(order):
                seen = {key: value[i].copy() for key, value in navigation.observe().items()}
                now = navigation.flights()
                history[k].append((seen, now.energy_j[i], now.verdict[i], now.time_s[i]))
            navigation.fly(commands(spec.action_spec, row[order]))
        return history

    together = fly([0, 1, 2, 3, 4, 5, 6])
    other_order = fly([6, 2, 0, 5, 4, 3, 1])
    for k in range(7):
        assert_same(together[k], other_order[k], f"seed {seeds[k]}")
    for k in (2, 4):
        assert_same(together[k], fly([k])[k], f"seed {seeds[k]} alone")


def test_a_slot_is_reused_without_a_trace_of_the_last_episode() -> None:
    spec = EnvironmentSpec.model_validate(BUSY)
    used, fresh = Navigation(spec, 2), Navigation(spec, 1)
    used.begin([0, 1], [1, 2])
    command = np.array([[3.0, 0.5, 0.4]])
    for _ in range(40):  # past a block of draws
        used.fly(np.repeat(command, 2, axis=0))
    used.begin([1], [9])
    fresh.begin([0], [9])
    for _ in range(10):
        assert_same(
            {key: value[1] for key, value in used.observe().items()},
            {key: value[0] for key, value in fresh.observe().items()},
        )
        used.fly(np.repeat(command, 2, axis=0))
        fresh.fly(command)


def test_seeding_is_exact() -> None:
    env = NavigationVectorEnv(3, arena="no-obstacles", episode={"time_limit_s": 1.0})

    def seeds(**keywords: Any) -> list[int]:
        found: list[int] = env.reset(**keywords)[1]["seed"].tolist()
        for _ in range(4):
            found += env.step(np.array([2, 2, 2]))[4]["seed"].tolist()
        return found

    first = seeds(seed=5)
    assert first == seeds(seed=5)
    assert first != seeds(seed=6)
    assert len(set(first)) == 9  # two steps an episode
    assert min(first) >= FIRST_TRAINING_SEED
    given = seeds(seed=[7, 8, 9])
    assert given[:3] == [7, 8, 9]
    assert given == seeds(seed=np.array([7, 8, 9]))
    mixed = seeds(seed=[7, None, 9])
    assert (mixed[0], mixed[2]) == (7, 9)
    assert mixed[1] >= FIRST_TRAINING_SEED
    assert mixed == seeds(seed=[7, None, 9])
    assert seeds(seed=np.int64(5)) == first


def test_zone_option_holds_through_automatic_resets_and_beats_the_curriculum() -> None:
    env = NavigationVectorEnv(
        2, arena="no-obstacles", episode={"time_limit_s": 1.0}, curriculum={"window": 1}
    )
    assert env.reset(seed=1)[1]["zone"].tolist() == [0, 0]
    env.reset(seed=1, options={"zone": 2})
    for _ in range(5):
        info = env.step(np.array([2, 2]))[4]
        assert info["zone"].tolist() == [2, 2]
    assert env.reset(seed=1)[1]["zone"].tolist() == [0, 0]


def test_the_curriculum_is_shared_by_all_vehicles() -> None:
    env = NavigationVectorEnv(
        4, arena="no-obstacles", episode={"goal_radius_m": 50}, curriculum={"window": 6}
    )
    env.reset(seed=1)
    zones = [env.step(np.full(4, 22))[4]["zone"].max() for _ in range(4)]
    # Every step is four successes; those begun in an earlier zone do not count for the next.
    assert zones == [0, 1, 1, 2]


# --- stable-baselines3


def test_sb3_adapter_tells_what_the_vector_environment_tells() -> None:
    knobs: dict[str, Any] = {"arena": "dynamic-obstacles", "episode": {"time_limit_s": 4.0}}
    n = 3
    env, plain = VecCheckNan(make_vec_env(n, **knobs)), NavigationVectorEnv(n, **knobs)
    env.seed(12)
    assert_same(env.reset(), plain.reset(seed=12)[0])
    total, length, ends = np.zeros(n), np.zeros(n, int), 0
    rng = np.random.default_rng(1)
    for _ in range(40):
        action = rng.integers(25, size=n)
        seen, reward, done, infos = env.step(action)
        expected, r, terminated, truncated, info = plain.step(action)
        assert_same(seen, expected)
        assert reward.dtype == np.float32
        assert np.array_equal(reward, r.astype(np.float32))
        assert np.array_equal(done, terminated | truncated)
        total, length = total + r, length + 1
        for i in range(n):
            if not done[i]:
                assert infos[i] == {}
                continue
            ends += 1
            final = info["final_info"]
            assert_same(infos[i]["terminal_observation"], info["final_obs"][i])
            assert infos[i]["TimeLimit.truncated"] is bool(truncated[i])
            assert infos[i]["is_success"] is bool(final["success"][i])
            episode = infos[i]["episode"]
            assert episode["r"] == pytest.approx(total[i], abs=1e-12)
            assert (episode["l"], episode["t"]) == (length[i], final["flight_time_s"][i])
            assert {key: episode[key] for key in QUALITY} == {k: final[k][i] for k in QUALITY}
            total[i], length[i] = 0.0, 0
    assert ends >= n


def test_sb3_learns_and_evaluates_without_a_warning() -> None:
    """pytest turns warnings into errors: no missing render_mode, no missing Monitor."""
    knobs: dict[str, Any] = {"episode": {"time_limit_s": 3.0}}
    knobs |= {"image_width_px": 64, "image_height_px": 48}
    env = make_vec_env(2, **knobs)
    assert env.render_mode is None
    model = PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, n_epochs=1, seed=3, device="cpu")
    model.learn(16)
    assert model.ep_info_buffer is not None
    assert {len(each) for each in model.ep_info_buffer} == {len(QUALITY) + 3}
    rewards, lengths = evaluate_policy(
        model, env, n_eval_episodes=2, return_episode_rewards=True, warn=True
    )
    assert np.shape(rewards) == np.shape(lengths) == (2,)


def test_sb3_s_other_methods() -> None:
    env = make_vec_env(3, arena="no-obstacles")
    assert env.env_is_wrapped(Monitor) == [True] * 3
    assert env.env_is_wrapped(VecMonitor, indices=[0]) == [False]
    assert env.get_attr("num_envs", indices=[1]) == [3]
    env.set_options({"zone": 0})
    env.reset()
    assert env.env.navigation.zones.tolist() == [0, 0, 0]
    assert list(env.env_method("get_state")[0]) == list(env.env.get_state())
    env.set_attr("closed", True)
    assert env.env.closed
    with pytest.raises(ValueError, match="accepted: all environments"):
        env.set_attr("closed", True, indices=[0])
    assert not env.has_attr("nonsense")
    env.close()


# --- checkpoints


def through_a_file(state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Save and load a state as a checkpoint does: arrays only, no pickle."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **state)
    buffer.seek(0)
    with np.load(buffer, allow_pickle=False) as loaded:
        return {key: loaded[key] for key in loaded.files}


@pytest.mark.parametrize("steps", [0, 1, 33], ids=["at the start", "soon", "past a block of draws"])
@pytest.mark.parametrize(
    "knobs",
    [
        BUSY | {"curriculum": {"window": 3, "threshold": 0.1}},
        {"arena": "crowded", "episode": {"time_limit_s": 20.0}},
    ],
    ids=["busy", "crowded"],
)
def test_a_restored_environment_goes_on_bit_for_bit(knobs: dict[str, Any], steps: int) -> None:
    n, more = 3, 40
    env = make_vec_env(n, **knobs)
    env.seed(2)
    env.reset()
    rng = np.random.default_rng(1)
    # Slow turns, hence long flights; some end before and some after the checkpoint.
    actions = rng.integers(10, size=(steps + more, n))
    for action in actions[:steps]:
        env.step(action)
    state, seen = through_a_file(env.get_state()), env.observe()
    went_on = [env.step(action) for action in actions[steps:]]

    other = make_vec_env(n, **knobs)
    other.set_state(state)
    assert_same(other.observe(), seen)
    assert_same([other.step(action) for action in actions[steps:]], went_on)
    assert sum(done.sum() for _, _, done, _ in went_on) >= 1
    # ... and so does one that has flown something else in the meantime.
    env.seed(77)
    env.reset()
    env.set_state(state)
    assert_same([env.step(action) for action in actions[steps:]], went_on)
    final, again = env.get_state(), other.get_state()
    assert_same(final, again)


def test_a_saved_state_does_not_change_with_the_environment() -> None:
    env = make_vec_env(2, **BUSY)
    env.seed(1)
    env.reset()
    state = env.get_state()
    before = {key: value.copy() for key, value in state.items()}
    for _ in range(5):
        env.step(np.array([22, 3]))
    assert_same(state, before)
    assert all(isinstance(value, np.ndarray) and value.dtype != object for value in state.values())


def test_a_state_before_the_first_reset_can_be_kept_too() -> None:
    env, other = NavigationVectorEnv(2), NavigationVectorEnv(2)
    other.reset(seed=1)
    other.set_state(env.get_state())
    with pytest.raises(gym.error.ResetNeeded):
        other.step(np.array([0, 0]))
    other.reset(seed=3)
    other.step(np.array([0, 0]))


def test_a_state_of_another_environment_is_refused() -> None:
    env = make_vec_env(2, arena="no-obstacles")
    env.seed(1)
    env.reset()
    state = env.get_state()
    with pytest.raises(UsageError, match="state: of an environment with another arena, reward"):
        make_vec_env(2, reward="paper").set_state(state)
    with pytest.raises(UsageError, match=r"seeds is int64 \(2,\); accepted: int64 \(3,\)"):
        make_vec_env(3, arena="no-obstacles").set_state(state)
    with pytest.raises(UsageError, match="nothing of 'vector' in it"):
        env.set_state({})
    del state["vector/flights/fleet/memory"]
    with pytest.raises(UsageError, match="state: memory is missing"):
        env.set_state(state)
