"""A vehicle with a panoramic camera, in lockstep: the companion receives the twin's images."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import lens_of
from airl_mav.camera.render import Motion, Mount
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.cameras import Eye, render_images
from airl_mav.envs.evaluation import SinglePilots, fly_seeds
from airl_mav.envs.fleet import FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.observations import COMPILED
from airl_mav.envs.spec import spec_of
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.policy.actions import Action
from airl_mav.policy.greedy import GreedyPolicy
from airl_mav.policy.images import NUMPY
from airl_mav.policy.layouts import encode_layout
from airl_mav.policy.observation import Observation
from airl_mav.policy.observation_spec import MOST_FRAMES, ObservationSpec
from firmware_sim.plant.camera import SimulatedCamera
from tests.support.lockstep_kit import demo_scenario
from tests.support.poses import at_rest

SEED = 3


class Watching:
    """Reactive policy that stores its observations."""

    def __init__(self, seen: list[Observation]) -> None:
        self._policy, self._seen = GreedyPolicy(), seen

    def act(self, observation: Observation) -> Action:
        self._seen.append(observation)
        return self._policy.act(observation)


def test_the_companion_gets_the_images_that_the_twin_renders(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    poses: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    real = SimulatedCamera.take

    def take(self: SimulatedCamera, time_us: int, motion: Motion) -> Frame:
        poses[time_us] = np.array(motion.position), np.array(motion.quaternion)
        return real(self, time_us, motion)

    monkeypatch.setattr(SimulatedCamera, "take", take)
    scenario = demo_scenario(
        vehicle="quad-panorama", arena="dynamic-obstacles", policy="greedy", time_limit_s=20.0
    )
    seen: list[Observation] = []
    flown = fly(scenario, Watching(seen), 0, SEED)
    captures = flown.latency["capture_us"]
    assert len(seen) == len(captures) > 5
    camera = scenario.vehicle.camera
    lens = Intrinsics.of(camera)
    assert all(each.intrinsics == lens for each in seen)
    arena = scenario.arena_of(SEED)
    mount = Mount((camera.forward_m, 0.0, -camera.up_m), math.radians(camera.pitch_up_deg))
    fleet, arenas = at_rest(1), batch_of([arena])
    twin = np.zeros((1, camera.height_px, camera.width_px), np.uint16)
    for each, capture_us in zip(seen, captures.tolist(), strict=True):
        fleet.position[0], fleet.quaternion[0] = poses[capture_us]
        fleet.time_us[0] = capture_us - flown.record.started_us
        render_images(
            fleet,
            arenas,
            np.ones(1, np.bool_),
            Eye(mount, lens_of(lens, camera.range_m), twin, None),
        )
        assert each.depth_mm.tobytes() == twin[0].tobytes()
    # It is a picture, of all sides, and another one each time.
    assert len(np.unique(twin)) > 500
    assert np.all((twin[0, :, :] > 0).any(axis=0))
    assert len({each.depth_mm.tobytes() for each in seen}) == len(seen)
    _check_scans(seen)


def _check_scans(seen: list[Observation]) -> None:
    """Check the scans of a flight's observations against the twin's, with their poses."""
    camera = seen[0].intrinsics
    spec = ObservationSpec(
        layout="scan",
        height_px=20,
        width_px=64,
        projection="cylindrical",
        horizontal_fov_deg=math.degrees(camera.horizontal_fov_rad),
        range_m=20.0,
        frames=3,
    )
    for k, each in enumerate(seen):
        assert len(each.states) == 1 + len(each.earlier) == 1 + min(k, MOST_FRAMES - 1)
        for before, state in enumerate(each.states):
            assert state.position.tobytes() == seen[k - before].states[0].position.tobytes()
        ours, theirs = (encode_layout(spec, each.rows(None), made) for made in (NUMPY, COMPILED))
        assert ours["depth"].tobytes() == theirs["depth"].tobytes()
        assert (ours["depth"][:, :, : len(each.states)] < 255).any()


@pytest.mark.parametrize("compensate", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_the_twin_flies_it_too(*, compensate: bool) -> None:
    """Compensation carries each image forward, including the view behind the vehicle."""
    spec = {"vehicle": "quad-panorama", "arena": "no-obstacles", "compensate": compensate}
    spec |= {"image_width_px": 64, "image_height_px": 20}
    navigation = Navigation(spec_of(None, spec), 1)
    assert navigation.observation.projection == "cylindrical"
    ((_, flown),) = fly_seeds(navigation, SinglePilots(GreedyPolicy, 5.0), [SEED])
    assert flown.verdict == FlightStatus.SUCCESS
