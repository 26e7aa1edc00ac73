"""Environments with a colour camera: observations, supported learners, rejected settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.preprocessing import is_image_space

from airl_mav.camera.render import Mount, camera_pose, expose
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.navigation_env import NavigationEnv
from airl_mav.envs.sb3 import NavigationVecEnv
from airl_mav.envs.spec import spec_of
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.faults import Fault
from airl_mav.policy.card import load_card
from airl_mav.policy.layouts import boxes
from airl_mav.policy.observation_spec import ObservationSpec, Told
from airl_mav.policy.registry import load_learned
from airl_mav.profiles.projections import CHANNELS, CameraKind, Projection
from airl_mav.scenario.model import Scenario
from tests.support.policy_kit import export_tiny

SEEN: dict[str, Any] = {
    "arena": "dynamic-obstacles",
    "camera": {"kind": "rgb"},
    "image_width_px": 32,
    "image_height_px": 24,
    "frames": 2,
    "episode": {"time_limit_s": 2.0},
}


def knobs(kind: CameraKind = "rgb", **more: Any) -> dict[str, Any]:
    return SEEN | {"camera": {"kind": kind}} | more


@pytest.mark.parametrize("kind", ["rgb", "grey"])
def test_stable_baselines3_takes_it_for_an_image(kind: CameraKind) -> None:
    env = NavigationVecEnv(NavigationVectorEnv(3, spec_of(None, knobs(kind))))
    space = env.observation_space[kind]  # type: ignore[index]
    assert is_image_space(space)
    assert space.shape == (2 * CHANNELS[kind], 24, 32)
    first = env.reset()
    assert set(first) == {kind, "velocity", "goal"}
    seen, *_ = env.step(np.full(3, 12))
    for observation in (first, seen):
        assert env.observation_space.contains({k: v[0] for k, v in observation.items()})  # type: ignore[union-attr]
    # Older channels equal the previous observation; they are zero in the first one.
    channels = CHANNELS[kind]
    assert not first[kind][:, channels:].any()
    np.testing.assert_array_equal(seen[kind][:, channels:], first[kind][:, :channels])  # type: ignore[call-overload]


def test_n_at_a_time_see_what_each_sees_alone() -> None:
    """In arenas with different numbers of obstacles, over the ends of episodes."""
    seeds = [5, 8, 13]
    together = NavigationVectorEnv(3, spec_of(None, knobs()))
    alone = [NavigationEnv(spec_of(None, knobs())) for _ in seeds]
    seen, _ = together.reset(seed=seeds)
    assert len({len(arena.obstacles) for arena in together.navigation.arenas if arena}) > 1
    first = [env.reset(seed=seed)[0] for env, seed in zip(alone, seeds, strict=True)]
    for k in range(3):
        for i, single in enumerate(first):
            np.testing.assert_array_equal(seen["rgb"][i], single["rgb"])
        seen, *_ = together.step(np.array([k, 12, 20]))
        first = [env.step(action)[0] for env, action in zip(alone, (k, 12, 20), strict=True)]


def test_a_checkpoint_goes_on_in_the_same_colours() -> None:
    env, other = (NavigationVectorEnv(2, spec_of(None, knobs("grey"))) for _ in range(2))
    env.reset(seed=1)
    env.step(np.array([3, 17]))
    other.reset(seed=2)
    other.set_state(env.get_state())
    for _ in range(5):  # the next episodes begin, too
        ours, theirs = (each.step(np.array([12, 7]))[0] for each in (env, other))
        np.testing.assert_array_equal(ours["grey"], theirs["grey"])


# In every run test_colour.py has the fisheye's colours, test_fleet_camera.py its rays in the twin:
# together they compile for a minute.
@pytest.mark.parametrize(
    "projection", ["pinhole", pytest.param("fisheye", marks=pytest.mark.nightly)]
)
@pytest.mark.parametrize("kind", ["rgb", "grey"])
def test_the_image_is_that_of_the_one_caster(kind: CameraKind, projection: Projection) -> None:
    env = Navigation(spec_of(None, knobs(camera={"kind": kind, "projection": projection})), 2)
    env.begin([0, 1], [5, 8])
    for i, arena in enumerate(env.arenas):
        assert arena is not None
        camera, truth = env.camera, env.truth()
        mount = Mount((camera.forward_m, 0.0, -camera.up_m), 0.0)
        at, attitude = camera_pose(truth.position[i], truth.quaternion[i], mount)
        wanted = expose(arena, arena.centers_at(0), env.intrinsics, 20.0, at, attitude)
        assert env.cameras.image[i].tobytes() == wanted.tobytes()
    assert len(np.unique(env.cameras.image)) > 50


# Stuck depth cameras: test_gym_faults.py. Colour compiles a separate renderer.
@pytest.mark.nightly
def test_a_camera_that_is_stuck_shows_the_same_picture() -> None:
    (stuck,) = Scenario(faults=("camera stuck at offboard+1s",)).faults
    env = Navigation(spec_of(None, knobs()), 1, faults=[stuck])
    env.begin([0], [5])
    images = []
    for _ in range(6):
        env.fly(np.array([[3.0, 0.0, 0.5]]))
        images.append(env.cameras.image.tobytes())
    assert len(set(images[:2])) == 2
    assert len(set(images[2:])) == 1


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"randomisation": {"depth_noise": 0.1}}, r"randomisation\.depth_noise.*kind 'rgb'"),
        ({"randomisation": {"depth_dropout": 0.1}}, r"randomisation\.depth_dropout.*kind 'rgb'"),
        ({"compensate": True}, r"compensate.*only depth can be carried forward"),
        ({"vehicle": "quad-d435"}, r"camera\.kind.*with a table camera\.stereo"),
        ({"layout": "paper", "image_height_px": 58}, r"kind = 'rgb': accepted: 'depth'"),
    ],
)
def test_what_needs_depth_is_refused_in_one_line(changes: dict[str, Any], told: str) -> None:
    with pytest.raises((UsageError, ValueError), match=told) as caught:
        Navigation(spec_of(None, knobs(frames=1, **changes)), 1)
    if isinstance(caught.value, UsageError):
        assert "\n" not in str(caught.value)


def test_noise_of_depth_is_no_fault_of_a_colour_camera() -> None:
    noise = Fault.model_validate("camera noise 10% at offboard")
    with pytest.raises(FieldError, match=r"faults.*a depth camera; the vehicle's is of kind 'rgb'"):
        Navigation(spec_of(None, knobs()), 1, faults=[noise])


@pytest.mark.nightly
@pytest.mark.parametrize(("algorithm", "told"), [("RecurrentPPO", ()), ("PPO", ("command",))])
def test_networks_of_colour_are_exported(
    algorithm: str, told: tuple[Told, ...], tmp_path: Path
) -> None:
    """Cover a recurrent policy and in-flight inputs; other tests train and fly DQN."""
    size = {"height_px": 12, "width_px": 16, "horizontal_fov_deg": 90.0, "range_m": 20.0}
    seen = {"kind": "rgb", "frames": 2, "in_flight": told}
    spec = ObservationSpec.model_validate(size | seen)
    export_tiny(tmp_path, algorithm, observation=spec)
    card = load_card(tmp_path)
    assert card.observation == spec
    rng = np.random.default_rng(0)
    encoded = {
        key: rng.integers(0, 200, (2, *box.shape)).astype(box.dtype)
        for key, box in boxes(spec).items()
    }
    assert load_learned(tmp_path).act_batch(encoded).shape == (2,)
