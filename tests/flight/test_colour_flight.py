"""A vehicle with a colour camera, from training to a flight in lockstep."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from airl_mav.addons.colour.batch import ColourImages, Looks
from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Motion, Mount
from airl_mav.core.errors import FieldError
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.mesh_batch import MeshesSeen
from airl_mav.envs.observations import COMPILED
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.policy.card import load_card
from airl_mav.policy.layouts import encode_layout
from airl_mav.policy.observation import Observation
from airl_mav.policy.registry import LearnedPolicy
from airl_mav.scenario.resolve import ResolvedScenario
from firmware_sim.plant.camera import SimulatedCamera
from tests.support.command_line import airl
from tests.support.lockstep_kit import demo_scenario
from tests.support.poses import at_rest
from tests.support.trained_here import Watching, trained

pytestmark = pytest.mark.nightly

SEED = 3

TRAINING = """
description = "a short one in colour"
steps = 300
vehicles = 8
[environment]
vehicle = "quad-rgb"
arena = "static-obstacles"
image_width_px = 32
image_height_px = 24
frames = 2
[algorithm]
learning_starts = 100
[selection]
every = 300
episodes = 2
"""


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a policy that was trained to see colour."""
    return trained(tmp_path_factory.mktemp("colour"), "rgb", TRAINING)


def scenario(policy: Path, **changes: object) -> ResolvedScenario:
    asked = {"vehicle": "quad-rgb", "arena": "static-obstacles", "policy": str(policy)}
    return demo_scenario(**({"time_limit_s": 5.0} | asked | changes))


def test_a_trained_policy_says_that_it_sees_colour(policy: Path) -> None:
    card = load_card(policy)
    assert card.observation.kind == "rgb"
    assert card.observation.channels == 6
    assert json.loads((policy / "card.json").read_text())["observation"]["kind"] == "rgb"
    assert "| sees | rgb image of 32x24 px, 90 deg wide; own velocity" in (
        policy / "README.md"
    ).read_text(encoding="utf-8")


def test_it_is_evaluated_at_level_gym(policy: Path, tmp_path: Path) -> None:
    words = ["--level", "gym", "--vehicle", "quad-rgb", "--episodes", "2", "--time-limit-s", "5"]
    code, text = airl("evaluate", str(policy), *words, "--out", str(tmp_path / "out"))
    assert code == 0, text


def test_the_companion_gets_the_images_that_the_twin_renders(
    policy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images are bit-identical on the wire and in the network's input."""
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
    camera, arena = asked.vehicle.camera, asked.arena_of(SEED)
    looks = Looks(1)
    looks.put(0, arena)
    twin = ColourImages(Intrinsics.of(camera), Mount.of(camera), looks, MeshesSeen(1))
    fleet, arenas, image = at_rest(1), batch_of([arena]), np.zeros((1, 48, 64, 3), np.uint8)
    spec = learned.card.observation
    for each, capture_us in zip(seen, captures.tolist(), strict=True):
        fleet.position[0], fleet.quaternion[0], frame = taken[capture_us]
        fleet.time_us[0] = capture_us - flown.record.started_us
        twin.render(fleet, arenas, np.ones(1, np.bool_), image)
        wired = Frame.from_bytes(frame.to_bytes())
        assert wired.intrinsics == each.intrinsics == Intrinsics.of(camera)
        assert wired.image.tobytes() == each.image.tobytes() == image[0].tobytes()
        ours, theirs = (
            encode_layout(spec, each.rows(None)),
            encode_layout(spec, each.rows(None), COMPILED),
        )
        assert ours["rgb"].tobytes() == theirs["rgb"].tobytes()
    # It is a picture, in colours, and another one each time.
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 100
    assert len({each.image.tobytes() for each in seen}) == len(seen)
    assert [len(each.earlier) for each in seen[:3]] == [0, 1, 2]


def test_what_does_not_see_alike_is_refused_in_one_line(policy: Path) -> None:
    with pytest.raises(FieldError, match=r"vehicle quad: depth camera; accepted: rgb"):
        scenario(policy, vehicle="quad")
    for depth in ("static-obstacles", "greedy"):
        told = r"does not fit vehicle quad-rgb: rgb camera; accepted: depth"
        with pytest.raises(FieldError, match=told):
            scenario(Path(depth))
    with pytest.raises(FieldError, match=r"compensate.*only depth can be carried forward"):
        scenario(policy, compensate=True)
    with pytest.raises(FieldError, match=r"sensors\.depth_noise.*camera of kind 'rgb'"):
        scenario(policy, sensors={"depth_noise": 0.1})
    with pytest.raises(FieldError, match=r"faults.*a depth camera; the vehicle's is of kind 'rgb'"):
        scenario(policy, faults=("camera noise 0.1 at offboard",))


FORMED = """
base = "quad-rgb"
description = "formed"
[camera.imaging]
exposure_ms = 15.0
samples = 2
vignetting = 0.3
full_well_e = 4000.0
bayer = true
jpeg_quality = 75
[camera.imaging.auto_exposure]
"""


@pytest.mark.nightly
def test_a_flight_sees_formed_images_as_jpeg_leaves_them(
    policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images are the JPEG images of the wire; a repeated flight receives identical images."""
    vehicle = tmp_path / "formed.toml"
    vehicle.write_text(FORMED, encoding="utf-8")
    taken: dict[int, tuple[Motion, Frame]] = {}
    real = SimulatedCamera.take

    def take(self: SimulatedCamera, time_us: int, motion: Motion) -> Frame:
        frame = real(self, time_us, motion)
        taken[time_us] = motion, frame
        return frame

    monkeypatch.setattr(SimulatedCamera, "take", take)
    flights = []
    for _ in range(2):
        asked, seen = scenario(policy, vehicle=str(vehicle), time_limit_s=3.0), list[Observation]()
        learned = asked.fresh_policy(SEED)
        assert isinstance(learned, LearnedPolicy)
        flown = fly(asked, Watching(learned, seen), 0, SEED)
        for each, capture_us in zip(seen, flown.latency["capture_us"].tolist(), strict=True):
            wired = Frame.from_bytes(taken[capture_us][1].to_bytes())
            assert wired.jpeg is not None
            assert wired.image.tobytes() == each.image.tobytes()
        flights.append([each.image.tobytes() for each in seen])
    assert len(set(flights[0])) == len(flights[0]) > 3
    assert flights[0] == flights[1]
    # The vehicle moves: the exposure time causes motion blur.
    assert max(np.abs(motion.velocity).max() for motion, _ in taken.values()) > 0.5
    assert max(np.abs(motion.rates).max() for motion, _ in taken.values()) > 0.1
