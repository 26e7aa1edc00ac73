"""`airl/Rehearsal-v0`: a Gymnasium loop flies what a rehearsal flies.

AIRL_PX4_DIR, as of test_lockstep_px4.py, lets a real PX4 fly here as well.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3
from stable_baselines3.common.env_util import make_vec_env

from airl_mav.addons.rehearsal_env.gym_env import AskedFlight, RehearsalEnv
from airl_mav.core.errors import UsageError
from airl_mav.envs.navigation_env import FIRST_TRAINING_SEED, NavigationEnv
from airl_mav.envs.registration import NAVIGATION
from airl_mav.experiments.gym_flier import environment_of
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.policy.registry import LearnedPolicy
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from firmware_sim.interfaces import FirmwareLostError
from tests.flight.test_lockstep_px4 import REAL
from tests.support.processes import write_arena
from tests.support.px4_peer import write_build

REHEARSAL = "airl/Rehearsal-v0"
AHEAD = 22
"""An action of arc-25 that flies straight on."""

ASKED = AskedFlight.asked


def slowly(flight: AskedFlight) -> Any:
    """Stand in for `AskedFlight.asked`: wait 30 s first."""
    threading.Event().wait(30.0)
    return ASKED(flight)


def flown_by(
    policy: LearnedPolicy, env: gym.Env[Any, Any], seed: int
) -> tuple[int, float, dict[str, Any]]:
    """Fly an episode; return its number of decisions, its return and the last info."""
    seen, _ = env.reset(seed=seed)
    decisions, total, ended = 0, 0.0, False
    while not ended:
        action = policy.act_batch({key: value[None] for key, value in seen.items()})[0]
        seen, reward, terminated, truncated, info = env.step(action)
        decisions, total = decisions + 1, total + float(reward)
        ended = terminated or truncated
    return decisions, total, info


@contextmanager
def made(**knobs: Any) -> Iterator[gym.Env[Any, Any]]:
    env = gym.make(REHEARSAL, **knobs)
    try:
        yield env
    finally:
        env.close()


@pytest.mark.parametrize(
    ("policy", "arena", "seed", "asked"),
    [
        ("static-obstacles-fast", "static-obstacles", 3, {"wind": {"north_m_s": 2.0}}),
        ("body-rates", "no-obstacles", 3, {}),
        ("gates", "gates", 4, {"latency": "90ms", "compensate": True}),
    ],
)
def test_a_loop_flies_what_the_rehearsal_flies(
    policy: str, arena: str, seed: int, asked: dict[str, Any]
) -> None:
    """To the last bit; and its return is nearly that of the batch twin."""
    scenario = Scenario(
        policy=policy, arena=arena, level="lockstep", episodes=1, seed=seed, **asked
    )
    resolved = resolve(scenario)
    network, spec = resolved.fresh_policy(seed), environment_of(resolved)
    assert isinstance(network, LearnedPolicy)
    flown = fly(resolved, resolved.fresh_policy(seed), 0, seed)
    record = flown.record
    assert record.quality is not None
    env, twin = RehearsalEnv(spec), NavigationEnv(spec)
    decisions, total, info = flown_by(network, env, seed)
    again = env.flown
    assert again is not None
    same = flown.trajectory.time_us <= record.ended_us
    np.testing.assert_array_equal(
        again.trajectory.position[: same.sum()], flown.trajectory.position[same]
    )
    assert again.record.outcome is record.outcome
    assert (again.record.navigation_us, again.record.ended_us) == (
        record.navigation_us,
        record.ended_us,
    )
    assert twin.observation_space == env.observation_space
    assert twin.action_space == env.action_space
    in_twin, total_there, info_there = flown_by(network, twin, seed)
    assert info.keys() == info_there.keys()
    assert info["outcome"] == record.outcome.value == info_there["outcome"] == "success"
    assert (info["seed"], info["zone"], info["success"]) == (seed, -1, True)
    assert info["flight_time_s"] == pytest.approx(record.quality.flight_time_s, abs=1e-9)
    # The record's path is sampled at 50 Hz.
    assert info["distance_m"] == pytest.approx(record.quality.distance_m, abs=2e-3)
    assert info["energy_j"] == pytest.approx(record.quality.energy_j, rel=1e-4)
    assert abs(decisions - in_twin) <= 0.06 * in_twin
    assert total == pytest.approx(total_there, rel=0.05)


def test_both_checkers_are_content() -> None:
    knobs: dict[str, Any] = {"arena": "no-obstacles", "episode": {"time_limit_s": 1.0}}
    env = gym.make(REHEARSAL, render_mode="rgb_array", **knobs).unwrapped
    check_env(env)
    check_env_for_sb3(env, skip_render_check=False)
    env.close()


def test_pictures_are_those_of_the_twin_and_a_vec_env_of_sb3_takes_them() -> None:
    """stable-baselines3's make_vec_env always requests a render mode."""
    knobs = {"arena": "dynamic-obstacles"}
    pictures = []
    for name in (REHEARSAL, NAVIGATION):
        env = make_vec_env(f"airl_mav:{name}", env_kwargs=knobs)
        env.seed(3)
        env.reset()
        env.step(np.array([AHEAD]))
        picture = env.render()
        assert picture is not None
        pictures.append(picture.astype(int))
        env.close()
    assert pictures[0].shape == (540, 960, 3)
    # The same map, with movers and vehicle where they were there, but for a frame's time.
    differs = np.abs(pictures[0] - pictures[1]).max(axis=2) > 30
    assert differs[:, :540].mean() < 0.004
    assert (np.abs(pictures[0] - 255).max(axis=2) > 0).mean() > 0.1, "there is something on it"


def test_episodes_one_after_the_other_as_in_the_batch_twin() -> None:
    knobs: dict[str, Any] = {"arena": "no-obstacles", "episode": {"time_limit_s": 1.0}}
    twin = gym.make(NAVIGATION, **knobs)
    threads = threading.active_count()
    with made(**knobs) as env:
        with pytest.raises(gym.error.ResetNeeded):
            env.unwrapped.step(AHEAD)
        for seed in (5, None):
            (_, info), (_, there) = env.reset(seed=seed), twin.reset(seed=seed)
            assert info["seed"] == there["seed"]
            assert info["goal_distance_m"] == pytest.approx(there["goal_distance_m"], abs=0.5)
        assert info["seed"] >= FIRST_TRAINING_SEED
        env.reset(seed=5, options={"zone": 0})
        assert env.reset()[1]["zone"] == 0, "until a reset with a seed or options"
        assert env.reset(seed=5)[1]["zone"] == -1
        seen, *_ = env.step(AHEAD)
        goal = seen["goal"]
        seen.clear()  # TorchRL puts tensors in the arrays' places.
        last, *_, truncated, info = env.step(AHEAD)
        assert last in env.observation_space
        assert np.hypot(*(last["goal"] - goal)[:2]) > 0.01, (
            "it is a new one, of a vehicle that flies"
        )
        assert (truncated, info["outcome"]) == (True, "timeout")
        assert info["flight_time_s"] == pytest.approx(1.0, abs=0.005)
        with pytest.raises(gym.error.ResetNeeded):
            env.unwrapped.step(AHEAD)
        # And in the middle of a flight.
        env.reset(seed=5)
    assert threading.active_count() == threads
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.step(AHEAD)


def test_of_several_latencies_each_episode_draws_the_twin_s() -> None:
    """A longer latency lengthens a held action."""
    knobs: dict[str, Any] = {
        "arena": "no-obstacles",
        "delay": {"latency": ["10ms", "200ms", "390ms"]},
    }
    twin, found = gym.make(NAVIGATION, **knobs), set()
    with made(**knobs) as env:
        for seed in (5, 6, 7):
            passed_s = []
            for each in (env, twin):
                began = each.reset(seed=seed)[1]["flight_time_s"]
                passed_s.append(each.step(AHEAD)[-1]["flight_time_s"] - began)
            assert passed_s[0] == pytest.approx(passed_s[1], abs=0.035), "but for a frame"
            found.add(round(passed_s[0], 1))
    assert len(found) == 3


def test_what_ends_an_episode(tmp_path: Path) -> None:
    """A wall is a failure; that the companion flies no further is neither success nor failure."""
    arena = str(write_arena(tmp_path, 40.0))
    with made(arena=arena, actions="velocity", limits={"radius_m": 4.0}) as env:
        env.reset(seed=1)
        terminated = truncated = False
        while not (terminated or truncated):
            *_, terminated, truncated, info = env.step(np.array([1.0, 0.0], np.float32))
        assert (terminated, truncated, info["success"]) == (False, True, False)
        assert info["outcome"] == "aborted"
        assert isinstance(env.unwrapped, RehearsalEnv)
        assert env.unwrapped.flown is not None
        assert env.unwrapped.flown.record.reason == "out of bounds"
    with made(arena=arena, actions="body-rates", decisions="pipelined") as env:
        env.reset(seed=1)
        total = 0.0
        terminated = truncated = False
        while not (terminated or truncated):
            _, reward, terminated, truncated, info = env.step(np.array([0, 0, 0, -1], np.float32))
            total += float(reward)
        assert (terminated, info["outcome"]) == (True, "collision")
        assert total < -0.5, "it has fallen"


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"firmwares": "px4"}, "unexpected keyword argument 'firmwares'"),
        ({"firmware": "px5"}, "firmware 'px5': accepted: .*'px4'"),
        ({"firmware": "ardupilot"}, "firmware"),
        ({"render_mode": "ansi"}, "render_mode = 'ansi': accepted: None, rgb_array"),
        (
            {"curriculum": {}},
            "curriculum .*: accepted: None: only the vectorized simulator has another",
        ),
        ({"delay": {"link_ms": 9}}, r"delay\.link_ms 9: accepted: 4"),
        ({"goal_height": True}, "goal_height True: accepted: false in arena"),
        ({"faults": ["gps off at noon"]}, "faults"),
    ],
)
def test_a_wrong_knob_gets_one_clear_line(knobs: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        RehearsalEnv(**knobs)
    assert "\n" not in str(caught.value)


def test_ctrl_c_ends_the_flight_and_the_next_one_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with made(arena="no-obstacles") as env:
        began = env.reset(seed=2)[1], env.step(AHEAD)[-1]
        before = signal.signal(signal.SIGALRM, interrupt)
        try:
            for act in (lambda: env.step(AHEAD), lambda: env.reset(seed=2)):
                # Interrupt while the learner waits for a request.
                monkeypatch.setattr(AskedFlight, "asked", slowly)
                signal.setitimer(signal.ITIMER_REAL, 0.1)
                with pytest.raises(KeyboardInterrupt):
                    act()
                monkeypatch.undo()
                with pytest.raises(gym.error.ResetNeeded):
                    env.step(AHEAD)
                assert (env.reset(seed=2)[1], env.step(AHEAD)[-1]) == began
        finally:
            signal.signal(signal.SIGALRM, before)


LEAVES = """
import gc, sys, threading
import gymnasium
def make():
    env = gymnasium.make("airl_mav:airl/Rehearsal-v0", arena="no-obstacles")
    env.reset(seed=1)
    return env
if sys.argv[1] == "dropped":
    env = make()
    del env
    gc.collect()
    assert threading.active_count() == 1
env = make()
if sys.argv[1] == "error":
    raise ValueError("of the learner")
"""
"""A program that never closes its environment."""


@pytest.mark.nightly
@pytest.mark.parametrize(("how", "status"), [("dropped", 0), ("error", 1)])
def test_a_program_may_end_in_the_middle_of_a_flight(how: str, status: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", LEAVES, how],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stdout) == (status, ""), done.stderr
    assert ("ValueError: of the learner" in done.stderr) == (how == "error")


# --- PX4


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("seeds", [(1,), pytest.param((1, 2), marks=pytest.mark.nightly)])
def test_a_loop_with_px4_s_stand_in(
    seeds: tuple[int, ...], tmp_path: Path, px4_instance: int
) -> None:
    real = {"px4_dir": str(write_build(tmp_path / "px4")), "instance": px4_instance}
    arena = str(write_arena(tmp_path, 10.0))
    with made(arena=arena, actions="velocity", firmware="px4", real=real) as env:
        for seed in seeds:
            env.reset(seed=seed)
            env.step(np.zeros(2, np.float32))
        *_, info = env.step(np.array([1.0, 0.0], np.float32))
        assert info["flight_time_s"] > 0.5


@pytest.mark.nightly
@pytest.mark.slow
def test_a_loop_that_loses_its_firmware(tmp_path: Path, px4_instance: int) -> None:
    build = write_build(tmp_path / "px4", "--fault", "die@1")
    real = {"px4_dir": str(build), "instance": px4_instance}
    with made(arena=str(write_arena(tmp_path, 10.0)), firmware="px4", real=real) as env:
        for _ in range(2):  # It can be tried again.
            with pytest.raises(FirmwareLostError, match="PX4"):
                env.reset(seed=1)


@pytest.mark.slow
@pytest.mark.skipif(REAL is None, reason="AIRL_PX4_DIR names no PX4")
def test_a_loop_with_real_px4(px4_instance: int) -> None:
    scenario = Scenario(policy="body-rates", arena="no-obstacles", level="lockstep", episodes=1)
    resolved = resolve(scenario)
    network, spec = resolved.fresh_policy(3), environment_of(resolved)
    assert isinstance(network, LearnedPolicy)
    real = {"px4_dir": REAL, "instance": px4_instance}
    _, _, info = flown_by(network, RehearsalEnv(spec, firmware="px4", real=real), 3)
    _, _, built_in = flown_by(network, RehearsalEnv(spec), 3)
    assert info["outcome"] == built_in["outcome"] == "success"
    assert info["flight_time_s"] == pytest.approx(built_in["flight_time_s"], rel=0.1)
