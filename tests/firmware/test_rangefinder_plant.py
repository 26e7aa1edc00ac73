"""The plant's rangefinder against pybullet's rays, closed forms and its profile."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.projection import MIN_DEPTH_M
from airl_mav.core.constants import TICK_S, TICK_US, US_PER_S
from airl_mav.core.frames import Vector, ned_to_enu
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import Rangefinder, load_vehicle
from firmware_sim.addons.auxiliary_estimation.simulated_sensors import PlantRangefinder
from firmware_sim.engine.dynamics import POSITION, QUATERNION
from firmware_sim.interfaces import ActuatorControls
from firmware_sim.plant.plant import Plant
from firmware_sim.plant.sensors import Site

QUIET = Rangefinder(rate_hz=50.0, least_m=0.1, greatest_m=30.0, noise_m=0.0)


def finder(arena: Arena | None, profile: Rangefinder = QUIET, seed: int = 1) -> PlantRangefinder:
    return PlantRangefinder(profile, Site(arena, np.random.default_rng(seed), 1.0, TICK_S))


def row_at(position: Vector, attitude: Rotation) -> Vector:
    row = np.zeros(16)
    row[POSITION] = position
    row[QUATERNION] = np.roll(attitude.as_quat(), 1)
    return row


def arena_of(name: str, seed: int = 3) -> Arena:
    return generate(load_profile("arenas", name, ArenaSpec), seed, name=name, vehicle_width_m=0.5)


@pytest.mark.parametrize("name", ["static-obstacles", "dynamic-obstacles"])
def test_rays_are_pybullet_s(name: str) -> None:
    pybullet = pytest.importorskip("pybullet")
    from firmware_sim.plant.bullet_body import BulletWorld

    arena = arena_of(name)
    world = BulletWorld(arena, 0.3)
    profile = Rangefinder(
        **{**QUIET.model_dump(), "forward_m": 0.3, "right_m": -0.2, "down_m": 0.1}
    )
    mine, rng, hit_obstacles = finder(arena, profile), np.random.default_rng(7), 0
    try:
        for _ in range(1200):
            bounds = arena.bounds
            position = np.array(
                [
                    rng.uniform(bounds.north_min + 1.0, bounds.north_max - 1.0),
                    rng.uniform(bounds.east_min + 1.0, bounds.east_max - 1.0),
                    -rng.uniform(1.0, 4.5),
                ]
            )
            attitude = Rotation.from_euler("ZYX", rng.uniform([-3, -0.7, -0.7], [3, 0.7, 0.7]))
            start = position + attitude.apply([0.3, -0.2, 0.1])
            down = attitude.apply([0.0, 0.0, 1.0])
            ((_, _, share, _, normal),) = pybullet.rayTest(
                ned_to_enu(start).tolist(),
                ned_to_enu(start + 30.0 * down).tolist(),
                physicsClientId=world.number,
            )
            found = mine.ray.length_m(position, row_at(position, attitude)[QUATERNION], 0)
            if share == 0.0 or (found is not None and found < 2.0 * MIN_DEPTH_M):
                continue  # it began inside of something
            true = 30.0 * share
            if true >= 29.0:
                continue
            # pybullet's rounded bodies have a margin: it counts across the surface.
            upright = abs(float(np.dot(ned_to_enu(down), normal)))
            assert found == pytest.approx(true, abs=1e-3 / max(upright, 0.05))
            hit_obstacles += true < -start[2] / down[2] - 0.05
    finally:
        world.close()
    assert hit_obstacles > 20


@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.3, -0.2), (-0.5, 0.4)])
def test_over_an_endless_floor_it_is_height_by_the_cosine_of_the_tilt(
    angles: tuple[float, float],
) -> None:
    roll, pitch = angles
    attitude = Rotation.from_euler("ZYX", [1.0, pitch, roll])
    profile = Rangefinder(**{**QUIET.model_dump(), "forward_m": 0.2, "down_m": 0.05})
    row = row_at(np.array([300.0, -40.0, -7.0]), attitude)
    # The arm from the centre to the sensor tilts with the vehicle.
    height = 7.0 - attitude.apply([0.2, 0.0, 0.05])[2]
    expected = height / (math.cos(roll) * math.cos(pitch))
    assert finder(None, profile).read(row, 0).distance_m == pytest.approx(expected, rel=1e-6)


def test_what_lies_out_of_range_is_told_as_invalid() -> None:
    level = Rotation.identity()
    profile = Rangefinder(rate_hz=50.0, least_m=0.5, greatest_m=8.0, noise_m=0.0)
    mine = finder(None, profile)
    near = mine.read(row_at(np.array([0.0, 0.0, -0.3]), level), 0)
    assert near.distance_m == pytest.approx(0.3) and near.quality == 0
    inside = mine.read(row_at(np.array([0.0, 0.0, -3.0]), level), 0)
    assert inside.distance_m == pytest.approx(3.0) and inside.quality == 100
    far = mine.read(row_at(np.array([0.0, 0.0, -8.5]), level), 0)
    assert (far.distance_m, far.quality) == (8.0, 0)
    upside_down = mine.read(
        row_at(np.array([0.0, 0.0, -3.0]), Rotation.from_euler("x", math.pi)), 0
    )
    assert upside_down.quality == 0


def test_noise_is_white_and_the_profile_s() -> None:
    profile = Rangefinder(rate_hz=50.0, least_m=0.1, greatest_m=8.0, noise_m=0.04)
    mine, row = finder(None, profile), row_at(np.array([0.0, 0.0, -3.0]), Rotation.identity())
    told = np.array([mine.read(row, 0).distance_m for _ in range(4000)])
    assert told.mean() == pytest.approx(3.0, abs=0.003)
    assert told.std() == pytest.approx(0.04, rel=0.05)
    centred = told - told.mean()
    assert abs(float(np.mean(centred[1:] * centred[:-1]))) < 0.05 * 0.04**2
    assert mine.read(row, 0).variance_m2 == pytest.approx(0.0016)


def test_moving_obstacles_are_where_they_are_at_that_time() -> None:
    arena = arena_of("dynamic-obstacles")
    level, mine = Rotation.identity(), finder(arena)
    first = arena.n_static
    for at_us in (0, 7 * US_PER_S, 20 * US_PER_S):
        centre = arena.centers_at(at_us)[first]
        top = arena.obstacles.half_size[first, 2] - centre[2]
        row = row_at(np.array([centre[0], centre[1], -10.0]), level)
        assert mine.read(row, at_us).distance_m == pytest.approx(10.0 - top, abs=1e-4)


def test_a_rangefinder_changes_nothing_of_what_other_sensors_measure() -> None:
    """Its noise is a separate random stream, and its rate is independent."""
    plain, fitted = load_vehicle("quad-vio"), load_vehicle("quad-indoor")
    plants = [Plant(each, None, np.random.default_rng(4)) for each in (plain, fitted)]
    told: list[int] = []
    try:
        for _ in range(500):
            one, other = (
                plant.step(ActuatorControls(plant.time_us, (0.6,) * 4, armed=True))
                for plant in plants
            )
            assert one.distance is None
            if other.distance is not None:
                told.append(other.time_us)
            np.testing.assert_array_equal(one.accel, other.accel)
            np.testing.assert_array_equal(one.gyro, other.gyro)
            assert one.pressure_hpa == other.pressure_hpa
            assert (one.odometry is None) is (other.odometry is None)
            if one.odometry is not None and other.odometry is not None:
                np.testing.assert_array_equal(one.odometry.position, other.odometry.position)
    finally:
        for plant in plants:
            plant.close()
    assert len(told) == pytest.approx(500 * TICK_US / US_PER_S * 20.0, abs=1)


def test_a_range_that_ends_before_it_begins_is_refused() -> None:
    with pytest.raises(ValueError, match=r"greatest_m = 0.5: accepted: more than least_m = 1"):
        Rangefinder(rate_hz=10.0, least_m=1.0, greatest_m=0.5, noise_m=0.0)
