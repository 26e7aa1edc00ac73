"""A vehicle with several cameras, from training to a flight in lockstep and a companion alone."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO

from airl_mav.addons.colour.batch import Looks
from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Motion
from airl_mav.core.clock import SimClock
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.cameras import Cameras
from airl_mav.envs.fleet import new_fleet
from airl_mav.envs.mesh_batch import MeshesSeen
from airl_mav.envs.observations import COMPILED
from airl_mav.envs.sb3 import NavigationVecEnv
from airl_mav.envs.spec import spec_of
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.policy.card import load_card
from airl_mav.policy.layouts import encode_layout
from airl_mav.policy.observation import Observation
from airl_mav.policy.registry import LearnedPolicy, load_learned
from airl_mav.profiles.vehicle import SensorNoise, load_vehicle
from airl_mav.scenario.resolve import ResolvedScenario
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.frame_source import open_named_camera
from companion.program import CheckResult, check_on_ground, prepare
from firmware_sim.plant.camera import SimulatedCamera
from tests.support.command_line import airl
from tests.support.lockstep_kit import demo_scenario
from tests.support.ports import LOOPBACK, free_ports
from tests.support.trained_here import Watching, trained

SEED = 3

TRAINING = """
description = "a short one with three cameras"
steps = 300
vehicles = 8
[environment]
vehicle = "quad-rig"
arena = "static-obstacles"
image_width_px = 32
image_height_px = 24
[environment.cameras.down]
image_width_px = 32
image_height_px = 24
frames = 2
[environment.cameras.left]
[algorithm]
learning_starts = 100
[selection]
every = 300
episodes = 2
"""


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a policy that was trained to see by three cameras."""
    return trained(tmp_path_factory.mktemp("rig"), "rig", TRAINING)


def scenario(policy: Path, **changes: object) -> ResolvedScenario:
    asked = {"vehicle": "quad-rig", "arena": "static-obstacles", "policy": str(policy)}
    return demo_scenario(**({"time_limit_s": 5.0} | asked | changes))


@pytest.mark.nightly
def test_the_card_says_which_cameras_it_needs(policy: Path) -> None:
    card = load_card(policy)
    assert list(card.observation.cameras) == ["down", "left"]
    down = card.observation.cameras["down"]
    assert (down.kind, down.width_px, down.height_px, down.frames) == ("grey", 32, 24, 2)
    told = json.loads((policy / "card.json").read_text())["observation"]["cameras"]["left"]
    assert told["horizontal_fov_deg"] == 90.0
    page = (policy / "README.md").read_text(encoding="utf-8")
    assert "; camera `down`: grey image of 32x24 px; camera `left`: depth image" in page


@pytest.mark.nightly
def test_the_network_has_an_input_for_each(policy: Path) -> None:
    import onnxruntime

    session = onnxruntime.InferenceSession(policy / "policy.onnx")
    inputs = {each.name: each.shape[1:] for each in session.get_inputs()}
    assert inputs == {
        "depth": [1, 24, 32],
        "velocity": [3],
        "goal": [3],
        "depth_left": [1, 24, 32],
        "grey_down": [2, 24, 32],
    }
    # Each of them counts.
    learned, rng = load_learned(policy), np.random.default_rng(1)
    blank = {
        name: rng.integers(0, 256, (1, *shape), np.uint8)
        if len(shape) == 3
        else rng.normal(size=(1, *shape)).astype(np.float32)
        for name, shape in inputs.items()
    }
    usual = learned.outputs(blank)
    for name in inputs:
        changed = blank | {name: blank[name][..., ::-1].copy()}
        assert not np.array_equal(learned.outputs(changed), usual), name


def test_the_companion_gets_the_images_that_the_twin_renders(
    policy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images of all cameras are bit-identical on the wire and in the network's input."""
    taken: dict[int, tuple[np.ndarray, np.ndarray, Frame]] = {}
    real = SimulatedCamera.take

    def take(self: SimulatedCamera, time_us: int, motion: Motion) -> Frame:
        frame = real(self, time_us, motion)
        taken[time_us] = np.array(motion.position), np.array(motion.quaternion), frame
        return frame

    monkeypatch.setattr(SimulatedCamera, "take", take)
    asked, seen = scenario(policy, arena="dynamic-obstacles"), list[Observation]()
    learned = asked.fresh_policy(SEED)
    assert isinstance(learned, LearnedPolicy)
    flown = fly(asked, Watching(learned, seen), 0, SEED)
    captures = flown.latency["capture_us"]
    assert len(seen) == len(captures) > 5
    vehicle, arena = asked.vehicle, asked.arena_of(SEED)
    looks = Looks(1)
    looks.put(0, arena)
    twin = Cameras(
        *(1, vehicle.camera, 0, SensorNoise(), (), looks, MeshesSeen(1)), vehicle.cameras
    )
    fleet, arenas, everyone = new_fleet(1), batch_of([arena]), np.ones(1, np.bool_)
    spec, before = learned.card.observation, None
    for each, capture_us in zip(seen, captures.tolist(), strict=True):
        fleet.position[0], fleet.quaternion[0], frame = taken[capture_us]
        fleet.time_us[0] = capture_us - flown.record.started_us
        twin.capture(fleet, arenas, everyone, np.array([SEED]))
        wired = Frame.from_bytes(frame.to_bytes())
        assert wired.image.tobytes() == each.image.tobytes() == twin.image[0].tobytes()
        assert wired.further.keys() == each.further.keys() == {"down", "left", "right"}
        for name, view in each.further.items():
            lens = Intrinsics.of(vehicle.cameras[name])
            assert wired.further[name].intrinsics == view.intrinsics == lens
            image = twin.further[name].image[0].tobytes()
            assert wired.further[name].image.tobytes() == view.image.tobytes() == image
            assert len(np.unique(view.image)) > 1
        ours = encode_layout(spec, each.rows(None))
        theirs = encode_layout(spec, each.rows(None), COMPILED)
        for key in ("depth", "depth_left", "grey_down"):
            assert ours[key].tobytes() == theirs[key].tobytes()
        if before is not None:
            np.testing.assert_array_equal(ours["grey_down"][0, 1], before[0, 0])
        before = ours["grey_down"]


def test_the_same_flight_again_is_the_same(policy: Path) -> None:
    asked = scenario(policy, time_limit_s=3.0)
    first, second = (fly(asked, asked.fresh_policy(SEED), 0, SEED) for _ in range(2))
    assert first.record.sha256 == second.record.sha256 is not None


def test_it_is_evaluated_at_level_gym(policy: Path, tmp_path: Path) -> None:
    words = ["--level", "gym", "--vehicle", "quad-rig", "--episodes", "2", "--time-limit-s", "5"]
    code, text = airl("evaluate", str(policy), *words, "--out", str(tmp_path / "out"))
    assert code == 0, text


def test_a_vehicle_without_the_cameras_is_refused_in_one_line(policy: Path, tmp_path: Path) -> None:
    with pytest.raises(
        UsageError,
        match=r"does not fit vehicle quad: no camera 'down'; there is the main one alone$",
    ):
        scenario(policy, vehicle="quad")
    other = tmp_path / "other.toml"
    other.write_text('base = "quad-rig"\ndescription = "another"\n[cameras.down]\nkind = "rgb"\n')
    with pytest.raises(UsageError, match="camera 'down': rgb camera; accepted: grey"):
        scenario(policy, vehicle=str(other))
    other.write_text('base = "quad-rig"\ndescription = "another"\n[cameras.left]\nrange_m = 5.0\n')
    with pytest.raises(UsageError, match="camera 'left' with a range of 5 m; accepted: 10 m"):
        scenario(policy, vehicle=str(other))


def test_latency_is_not_compensated_for_it(policy: Path) -> None:
    told = r"compensate True: policy rig sees by further cameras \(down, left\), whose images"
    with pytest.raises(FieldError, match=told):
        scenario(policy, compensate=True)


@pytest.mark.nightly
def test_a_model_of_stable_baselines3_flies(tmp_path: Path) -> None:
    """Its own networks, of images as large as the cameras', exported like a configuration."""
    (tmp_path / "two.toml").write_text(
        'description = "two"\n[environment]\nvehicle = "quad-rig"\narena = "static-obstacles"\n'
        "image_width_px = 64\nimage_height_px = 48\n[environment.cameras.down]\n"
        '[algorithm]\nname = "ppo"\n'
    )
    knobs = {"vehicle": "quad-rig", "image_width_px": 64, "image_height_px": 48}
    spec = spec_of(None, {**knobs, "cameras": {"down": {}}})
    env = NavigationVecEnv(NavigationVectorEnv(2, spec))
    model = PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, n_epochs=1, seed=1)
    model.learn(16)
    model.save(tmp_path / "ppo.zip")
    words = ["export", str(tmp_path / "ppo.zip"), "--trust", "--algorithm", "PPO", "--out"]
    with pytest.raises(UsageError, match=r"grey_down uint8 .* is told by --like CONFIG"):
        airl(*words, str(tmp_path / "no"), "--image", "64x48")
    code, text = airl(*words, str(tmp_path / "two"), "--like", str(tmp_path / "two.toml"))
    assert code == 0, text
    asked = scenario(tmp_path / "two", time_limit_s=3.0)
    flown = fly(asked, asked.fresh_policy(SEED), 0, SEED)
    assert len(flown.latency["capture_us"]) > 3


# --- a companion alone

OWN = """
import numpy as np
from companion.addons.cameras.drivers import DepthImage
from companion.addons.cameras.fitting import Lens

class Main:
    lens = Lens(128, 96, 64.0, 64.0, 63.5, 47.5)
    def __init__(self):
        self.rng = np.random.default_rng(1)
    def image(self):
        return self.rng.integers(900, 1000, (96, 128)).astype(np.uint16)
    def read(self, timeout_s):
        return DepthImage(self.image(), 0)
    def close(self):
        pass

class Sides(Main):
    lenses = {"left": Main.lens, "right": Main.lens, "up": Main.lens}
    def read(self, timeout_s):
        return DepthImage(self.image(), 0, further={"left": self.image(), "right": self.image()})

class Narrow(Sides):
    lenses = {"left": Lens(128, 96, 128.0, 128.0, 63.5, 47.5)}
"""

LEFT = TRAINING.replace("[environment.cameras.down]", "[environment.cameras.left]").replace(
    "frames = 2\n[environment.cameras.left]\n", "frames = 2\n"
)


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a policy that sees ahead and to the left."""
    folder = tmp_path_factory.mktemp("left")
    (folder / "left.toml").write_text(LEFT.replace("steps = 300", "steps = 104"))
    code, text = airl("train", str(folder / "left.toml"), "--out", str(folder / "run"))
    assert code == 0, text
    return folder / "run" / "policy"


def checked(
    folder: Path, policy: Path, camera: str, monkeypatch: pytest.MonkeyPatch
) -> CheckResult:
    """Return what `airl-companion --check` says of a driver of the user's."""
    monkeypatch.setattr("companion.program.LOOK_S", 0.1)
    (folder / "mine.py").write_text(OWN)
    (udp,), _ = free_ports(1, 0)
    asked = StandAloneCompanion.model_validate(
        {
            "connect": f"udpin://{LOOPBACK}:{udp}",
            "camera": f"{folder}/mine.py:{camera}",
            "connect_timeout": 0.1,
            "vehicle": "quad-rig",
            "policy": str(policy),
        }
    )
    _, found, *_ = check_on_ground(asked, prepare(asked), threading.Event())
    return found


def test_a_driver_that_gives_the_main_image_alone_is_refused_at_check(
    left: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = checked(tmp_path, left, "Main", monkeypatch)
    assert not found.good
    assert found.told == (
        "--policy left: in the frames that come: no camera 'left'; there is the main one alone"
    )
    assert not checked(tmp_path, left, "Narrow", monkeypatch).good


def test_a_driver_of_the_users_may_return_further_images(
    left: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = checked(tmp_path, left, "Sides", monkeypatch)
    assert found.good, found.told
    assert "; left: depth, 32x24 px" in found.told


def test_further_images_of_a_driver_are_fitted_to_the_vehicle_s(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(OWN)
    vehicle = load_vehicle("quad-rig")
    further: dict[str, Any] = {
        name: Intrinsics.of(vehicle.cameras[name]) for name in ("left", "right")
    }
    source = open_named_camera(
        *(f"{tmp_path}/mine.py:Sides", SimClock(), Intrinsics.of(vehicle.camera), "vehicle x"),
        further,
    )
    received = source.wait(-1, 30.0)
    source.close()
    assert received is not None
    assert received.frame.lenses == further
    for each in received.frame.further.values():
        assert each.image.shape == (24, 32)
        assert 900 <= each.image.min() <= each.image.max() < 1000
    grey = {"left": Intrinsics.of(vehicle.cameras["down"])}
    told = r"drivers give depth images, the camera of vehicle x \(left\) is of kind 'grey'"
    with pytest.raises(FieldError, match=told):
        open_named_camera(
            *(f"{tmp_path}/mine.py:Sides", SimClock(), Intrinsics.of(vehicle.camera), "vehicle x"),
            grey,
        )
