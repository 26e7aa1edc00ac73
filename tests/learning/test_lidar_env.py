"""Planar lidar in the vectorized simulator: network input and the rehearsal's ranges."""

from __future__ import annotations

import numpy as np

from airl_mav.camera.noise import noise_of, noisy_frame
from airl_mav.camera.render import Mount, camera_pose, expose
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import spec_of
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.policy.images import scan_bytes
from airl_mav.profiles.vehicle import SensorNoise

KNOBS = {
    "vehicle": "quad-lidar",
    "arena": "dynamic-obstacles",
    "layout": "scan",
    "image_width_px": 360,
    "image_height_px": 1,
    "frames": 2,
}


def test_a_network_sees_its_ranges_with_a_seam() -> None:
    env = NavigationVectorEnv(2, spec_of(None, KNOBS))
    seen, _ = env.reset(seed=[5, 8])
    assert seen["depth"].shape == (2, 1, 2, 450)
    assert set(seen) == {"depth", "velocity", "goal"}
    # Level vehicle: measured ranges as bytes, with 45 wrapped columns at either end.
    for i in range(2):
        measured = env.navigation.cameras.image[i, 0] / 1e3
        wanted = scan_bytes(np.where(measured > 0.0, measured, np.inf)[None], 12.0)[0]
        scan = seen["depth"][i, 0, 0]
        assert (np.abs(scan[45:-45].astype(int) - wanted) <= 1).mean() > 0.97
        np.testing.assert_array_equal(scan[:45], scan[360:405])
        assert (scan < 255).sum() > 20
    seen, *_ = env.step(np.array([3, 17]))
    assert (seen["depth"][:, 0, 1] < 255).any()


def test_the_plant_s_ranges_are_the_twin_s() -> None:
    env = Navigation(spec_of(None, KNOBS), 2)
    env.begin([0, 1], [5, 8])
    for _ in range(2):
        env.fly(np.array([[4.0, 0.0, 0.9], [2.0, 1.0, -0.7]]))
    env.cameras.capture(env.fleet, env.places.batch, np.ones(2, np.bool_), env.seeds)
    noise = noise_of(env.camera, SensorNoise())
    assert noise is not None
    camera, frames = env.camera, env.cameras._frames(env.fleet.time_us)
    mount = Mount((camera.forward_m, 0.0, -camera.up_m), 0.0)
    for i, arena in enumerate(env.arenas):
        assert arena is not None
        at, attitude = camera_pose(env.fleet.position[i], env.fleet.quaternion[i], mount)
        centers = arena.centers_at(int(env.fleet.time_us[i]))
        true = expose(arena, centers, env.intrinsics, camera.range_m, at, attitude)
        wanted = noisy_frame(true, noise, int(env.seeds[i]), int(frames[i]))
        assert wanted.tobytes() == env.cameras.image[i].tobytes()
        assert (wanted != true).any()
