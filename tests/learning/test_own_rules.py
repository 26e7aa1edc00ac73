"""Custom layout, action set and arena generator: flown, and loaded only with trust."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from airl_mav import Scenario, rehearse
from airl_mav.arena.generate import generate
from airl_mav.cli import report_command
from airl_mav.core import plugins
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import validated
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.policy.actions import ActionSpec, commands
from airl_mav.policy.registry import load_learned
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile, profile_digest
from airl_mav.training.config import TrainingConfig
from airl_mav.training.training_run import train

PARTS = '''
import numpy as np

from airl_mav.arena.generate import local_bounds
from airl_mav.arena.geometry import Arena, Obstacles, Shape
from airl_mav.policy.layouts import boxes, encode_layout
from airl_mav.policy.layouts import Box


class Tilted:
    """The body's, and how the vehicle leans."""

    def boxes(self, spec):
        tilt = Box((2,), np.float32, -np.inf, np.inf)
        return {**boxes(spec.model_copy(update={"layout": "body"})), "tilt": tilt}

    def encode(self, spec, seen):
        body = encode_layout(spec.model_copy(update={"layout": "body"}), seen)
        tilt = np.stack([seen.roll, seen.pitch], axis=1)
        return {**body, "tilt": tilt.astype(np.float32)}


class Untyped(Tilted):
    def encode(self, spec, seen):
        return {**super().encode(spec, seen), "tilt": np.stack([seen.roll, seen.pitch], axis=1)}


class Blind(Tilted):
    def boxes(self, spec):
        return {"goal": boxes(spec.model_copy(update={"layout": "body"}))["goal"]}


class Steps:
    """Three speeds, each with three turns."""

    discrete = 9

    def commands(self, actions, max_speed_m_s):
        forward = max_speed_m_s * np.array([0.0, 0.5, 1.0])[actions // 3]
        turn = np.array([-1.0, 0.0, 1.0])[actions % 3]
        return np.stack([forward, 0.0 * forward, turn], axis=1)


class Pair:
    """Forward speed and turn."""

    discrete = None

    def commands(self, actions, max_speed_m_s):
        speed, turn = np.clip(actions, -1.0, 1.0).T
        return np.stack([max_speed_m_s * speed, 0.0 * speed, turn], axis=1)


class Short(Steps):
    def commands(self, actions, max_speed_m_s):
        return np.zeros((len(actions), 2))


class One(Steps):
    discrete = 1


def wall(spec, seed, *, name, vehicle_width_m, zone):
    """A wall across the way, with a gap that the seed moves."""
    gap = spec.options["gap_m"]
    at = np.random.default_rng(seed).uniform(-5.0, 5.0)
    half = 10.0
    return Arena(
        name=name,
        seed=seed,
        bounds=local_bounds(spec),
        wall_colour=spec.wall_colour,
        obstacles=Obstacles(
            shape=np.full(2, Shape.BOX, np.int8),
            center=np.array([[10.0, at - half - gap / 2, -2.0], [10.0, at + half + gap / 2, -2.0]]),
            half_size=np.full((2, 3), [0.3, half, 2.0]),
            yaw=np.zeros(2),
        ),
        tours=(),
        goal=np.array([20.0, 0.0]),
    )


def outside(spec, seed, **other):
    import dataclasses

    return dataclasses.replace(wall(spec, seed, **other), goal=np.array([2000.0, 0.0]))


def nothing(spec, seed, **other):
    return None
'''


@pytest.fixture
def parts(tmp_path: Path) -> str:
    path = tmp_path / "parts.py"
    path.write_text(PARTS)
    return str(path)


def arena_file(folder: Path, generator: str) -> Path:
    path = folder / "gate.toml"
    path.write_text(
        f'description = "a wall with a gap"\ngenerator = "{generator}"\n[options]\ngap_m = 4.0\n'
    )
    return path


def test_the_user_s_actions_fly_in_the_environment(parts: str) -> None:
    for name, actions in (("Steps", np.array([3, 7])), ("Pair", np.array([[0.5, -1.0], [1, 0]]))):
        spec = ActionSpec(set=f"{parts}:{name}", max_speed_m_s=4.0)
        wanted = np.array([[2.0, 0.0, -1.0], [4.0, 0.0, 0.0]])
        np.testing.assert_array_equal(commands(spec, actions), wanted)
        env = NavigationVectorEnv(2, arena="no-obstacles", actions=spec.set, max_speed_m_s=4.0)
        env.reset(seed=1)
        one = actions[0] if name == "Steps" else np.array([0.0, 1.0], np.float32)
        assert env.single_action_space.contains(one)
        for _ in range(4):
            env.step(actions)
        flown = env.navigation.whole_truth().fleet
        np.testing.assert_array_equal(flown.setpoint[:, (0, 1, 3)], wanted)
        speed = env.navigation.flights().speed_m_s
        assert speed == pytest.approx([2.0, 4.0], abs=0.5)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Short", r"actions '.*:Short': gives an array \(2, 2\); accepted: \(2, 3\) numbers"),
        ("One", r"actions '.*:One': its number of actions is discrete = 1; accepted: 2 or more"),
        ("wall", r"actions '.*:wall': accepted: a class with a method commands"),
    ],
)
def test_actions_that_cannot_be_flown_are_told_in_one_line(
    parts: str, name: str, words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        env = NavigationVectorEnv(2, arena="no-obstacles", actions=f"{parts}:{name}")
        env.reset(seed=1)
        env.step(np.array([0, 0]))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Untyped", r"gives float64 \(2, 2\) for 'tilt'; accepted: float32 \(2, 2\)"),
        ("Blind", r"its arrays are goal; accepted: depth uint8 \(channels, height, width\), all"),
        ("Steps", r"accepted: a class with methods boxes and encode"),
    ],
)
def test_a_layout_that_no_network_can_take_is_told_in_one_line(
    parts: str, name: str, words: str
) -> None:
    with pytest.raises(UsageError, match=rf"layout '.*:{name}': {words}"):
        NavigationVectorEnv(2, arena="no-obstacles", layout=f"{parts}:{name}").reset(seed=1)


@pytest.mark.nightly
def test_a_policy_with_the_user_s_layout_and_actions_asks_for_trust(
    parts: str, tmp_path: Path
) -> None:
    config = validated(
        TrainingConfig,
        {
            "description": "of one's own",
            "steps": 400,
            "vehicles": 8,
            "environment": {
                "arena": "no-obstacles",
                "layout": f"{parts}:Tilted",
                "frames": 2,
                "actions": f"{parts}:Steps",
            },
            "algorithm": {"learning_starts": 100},
            "selection": {"every": 400, "episodes": 4},
        },
    )
    train(config, tmp_path / "run", name="mine")
    folder = tmp_path / "run/policy"
    named = r"card\.json: actions\.set = '.*:Steps', observation\.layout = '.*:Tilted' is code that"
    with pytest.raises(UsageError, match=named):
        load_learned(folder)
    with pytest.raises(UsageError, match=r"accepted: with --trust, if you trust its maker"):
        rehearse(Scenario(level="gym", policy=str(folder)), out=tmp_path / "refused")
    asked = Scenario(
        level="gym", policy=str(folder), arena="no-obstacles", episodes=2, trust=True, workers=1
    )
    run = rehearse(asked, out=tmp_path / "flown")
    assert len(run.episodes) == 2
    forward = run.stamps[0]["setpoint"][:, 0]
    assert set(np.round(forward, 6)) <= {0.0, 2.5, 5.0}


def test_an_algorithm_that_cannot_choose_so_is_refused(parts: str, tmp_path: Path) -> None:
    data = {
        "description": "of one's own",
        "environment": {"arena": "no-obstacles", "actions": f"{parts}:Pair"},
    }
    with pytest.raises(FieldError, match=r"a discrete action set .*, and this one is continuous"):
        train(validated(TrainingConfig, data), tmp_path / "run", name="mine")


@pytest.mark.nightly
def test_the_user_s_arena_is_flown_in_and_drawn(
    parts: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = arena_file(tmp_path, f"{parts}:wall")
    asked = Scenario(level="gym", arena=str(path), episodes=3, workers=1)
    run = rehearse(asked, out=tmp_path / "run")
    assert {tuple(episode.goal) for episode in run.episodes} == {(20.0, 0.0)}
    for episode in run.episodes:
        # All flew through the gap, or hit the wall beside it.
        spec = load_profile("arenas", str(path), ArenaSpec)
        arena = generate(spec, episode.seed, name="gate", vehicle_width_m=0.5)
        gap = arena.obstacles.center[:, 1].mean()
        flown = run.trajectories[episode.index].position
        crossed = flown[np.argmin(np.abs(flown[:, 0] - 10.0)), 1]
        assert episode.outcome.value != "success" or abs(crossed - gap) < 2.0
    assert run.report().exists()
    # Simulate another process, in which the folder is not trusted.
    monkeypatch.setattr(plugins, "_loaded", set())
    with pytest.raises(UsageError, match=r"its generator '.*:wall' is code that would run on this"):
        run.report()
    trusted = report_command.ReportOptions(runs=(run.path,), trust=True)
    assert report_command.run(trusted) == 0


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nothing", "makes NoneType; accepted: airl_mav's Arena"),
        ("outside", r"the goal \(.*\) is not between the walls"),
        ("Short", "TypeError: "),
    ],
)
def test_an_arena_that_cannot_be_flown_in_is_told_in_one_line(
    parts: str, tmp_path: Path, name: str, words: str
) -> None:
    spec = load_profile("arenas", str(arena_file(tmp_path, f"{parts}:{name}")), ArenaSpec)
    with pytest.raises(UsageError, match=rf"generator '.*:{name}', seed 7: {words}"):
        generate(spec, 7, name="gate", vehicle_width_m=0.5)


def test_the_choice_of_a_generator_leaves_the_digests_of_others_alone() -> None:
    spec = load_profile("arenas", "static-obstacles", ArenaSpec)
    assert "generator" not in spec.model_dump()
    other = spec.model_copy(update={"options": {"gap_m": 1.0}})
    assert profile_digest(other) != profile_digest(spec)
