"""The kernel plant's body: on the floor, and against walls and obstacles, beside pybullet's."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pybullet
import pytest
from scipy.spatial.transform import Rotation

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.arena.walls import over_doors
from airl_mav.core.constants import TICK_S, TICK_US
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.addons.kernel_plant.convex import separation
from firmware_sim.interfaces import ActuatorControls
from firmware_sim.plant.bullet_body import connect
from firmware_sim.plant.plant import Plant
from tests.firmware.test_world import OFF, THROW_TICKS, VEHICLE, PlainWorld, crowd, throws

WIDTH, HEIGHT = VEHICLE.body.width_m, VEHICLE.body.height_m
HALF = np.array([0.5 * WIDTH, 0.5 * WIDTH, 0.5 * HEIGHT])
BODIES = "pybullet", "kernel"


def alone(kind: Shape, half: tuple[float, float, float], height_m: float) -> Arena:
    """Return an arena with one obstacle above the origin."""
    return Arena(
        "alone",
        0,
        Bounds(-20.0, 20.0, -20.0, 20.0, 6.0),
        (0, 0, 0),
        Obstacles(
            np.array([kind], np.int8),
            np.array([[0.0, 0.0, -height_m]]),
            np.array([half]),
            np.array([0.4]),
        ),
        (),
        np.array([10.0, 0.0]),
    )


@contextmanager
def both(place: Arena | None = None) -> Iterator[list[Plant]]:
    """Make a plant with each body."""
    plants = [
        Plant(VEHICLE, place, np.random.default_rng(0), aircraft=Aircraft(plant=name))
        for name in ("pybullet", "kernel")
    ]
    yield plants
    for plant in plants:
        plant.close()


def apart(plants: list[Plant]) -> float:
    """Return the maximum difference of position and attitude between both plants."""
    one, other = (plant.motion[[0, 1, 2, 6, 7, 8, 9]] for plant in plants)
    return float(np.abs(one - other).max())


def test_on_the_floor_it_moves_as_pybullet_s_body() -> None:
    """It settles, stands with unequal rotors, tips up, and falls back."""
    tilt = 0.0
    with both() as plants:
        for motors, ticks in (
            ((0.0, 0.0, 0.0, 0.0), 300),
            ((0.2, 0.25, 0.1, 0.12), 200),
            ((1.0, 0.0, 1.0, 0.0), 60),
            ((0.0, 0.0, 0.0, 0.0), 150),
        ):
            for _ in range(ticks):
                for plant in plants:
                    plant.step(ActuatorControls(plant.time_us, motors, True))
                assert apart(plants) < 1e-9
                turned = Rotation.from_quat(plants[1].motion[[7, 8, 9, 6]])
                tilt = max(tilt, float(turned.magnitude()))
    assert tilt > math.radians(15.0)
    assert float(turned.magnitude()) < math.radians(0.2)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_it_hits_first_what_pybullet_s_body_hits_first(seed: int) -> None:
    """Thrown at moving obstacles, among thirty more, and to the tick but for a few."""
    place = crowd(seed)
    plant = Plant(VEHICLE, place, np.random.default_rng(0), aircraft=Aircraft(plant="kernel"))
    plain = PlainWorld(place)
    late, names = [], set()
    for position, velocity in throws(seed, place):
        plant.put(tuple(position), tuple(velocity))
        for _ in range(THROW_TICKS):
            plant.step(OFF)
        theirs = plain.throw(position, velocity)
        assert plant.collisions[0].what == theirs[0][1]
        late.append(abs(plant.collisions[0].time_us - theirs[0][0]))
        names.add(theirs[0][1].rsplit("-", 1)[0])
    plain.client.disconnect()
    assert max(late) <= 2 * TICK_US
    assert sum(each > 0 for each in late) <= 1
    assert len(names) >= 3


def test_separations_agree_with_pybullet_s_distances() -> None:
    """Compare the tilted box with boxes and cylinders, near and overlapping."""
    client = connect()
    rng = np.random.default_rng(3)
    near, into = 0, 0
    for _ in range(400):
        kind = Shape.BOX if rng.random() < 0.5 else Shape.CYLINDER
        size = rng.uniform(0.4, 1.5, 3)
        if kind is Shape.CYLINDER:
            size[1] = size[0]
        d = rng.uniform(-1.9, 1.9, 3)
        turn = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3))
        x, y, z, w = turn.as_quat()
        found, axis = separation(int(kind), tuple(size), tuple(d), (w, x, y, z), HALF)
        assert math.hypot(*axis) == pytest.approx(1.0)
        shape = (
            client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=size.tolist())
            if kind is Shape.BOX
            else client.createCollisionShape(
                pybullet.GEOM_CYLINDER, radius=size[0], height=2 * size[2]
            )
        )
        box = client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=HALF.tolist())
        a = client.createMultiBody(0, shape)
        b = client.createMultiBody(0, box, basePosition=d, baseOrientation=(x, y, z, w))
        gap = min((point[8] for point in client.getClosestPoints(a, b, 5.0)), default=5.0)
        client.removeBody(a)
        client.removeBody(b)
        # A bound from below beside edges; exact where that decides: does the one touch the other?
        assert found < gap + 0.01
        if abs(gap) > 0.02:
            assert (found < 0.0) == (gap < 0.0)
        near += 0.0 < gap < 0.3
        into += gap < 0.0
    client.disconnect()
    assert near > 30
    assert into > 30


@pytest.mark.parametrize("kind", list(Shape))
def test_it_comes_to_rest_on_a_table(kind: Shape) -> None:
    place = alone(kind, (0.8, 0.8, 0.8), 1.0)
    plant = Plant(VEHICLE, place, np.random.default_rng(0), aircraft=Aircraft(plant="kernel"))
    plant.put((0.02, 0.01, -2.0))
    for _ in range(round(1.5 / TICK_S)):
        plant.step(OFF)
    assert [hit.what for hit in plant.collisions] == [f"static-{kind.name.lower()}-0"]
    if kind is not Shape.SPHERE:
        assert plant.position[2] == pytest.approx(-1.8 - 0.5 * HEIGHT, abs=0.01)
        assert np.abs(plant.motion[3:6]).max() < 0.02
        assert np.abs(plant.motion[10:13]).max() < 0.05


@pytest.mark.parametrize("name", BODIES)
def test_a_wall_stops_it_and_lets_it_fall(name: str) -> None:
    place = alone(Shape.SPHERE, (0.5, 0.5, 0.5), 1.0)
    asked = Aircraft.model_validate({"plant": name})
    plant = Plant(VEHICLE, place, np.random.default_rng(0), aircraft=asked)
    plant.put((18.0, 5.0, -3.0), (6.0, 1.0, -1.0), (math.cos(0.2), 0.0, -math.sin(0.2), 0.0))
    for _ in range(round(2.5 / TICK_S)):
        plant.step(OFF)
    plant.close()
    assert [hit.what for hit in plant.collisions][:2] == ["wall-north", "floor"]
    assert plant.position[0] < 20.0
    assert plant.position[2] == pytest.approx(-0.5 * HEIGHT, abs=0.25)


@pytest.mark.parametrize("seed", [1, 2])
def test_both_bodies_hit_walls_doors_and_ceiling_as_plain_pybullet(seed: int) -> None:
    """Throw the vehicle at room walls, at lintels, at the ceiling, and through doors.

    Contact times equal plain pybullet's to the tick, except for a few of the kernel's.
    """
    spec = load_profile("arenas", "rooms", ArenaSpec)
    place = generate(spec, seed, name="rooms", vehicle_width_m=WIDTH)
    assert place.building is not None
    o, n = place.obstacles, place.n_static
    rng, plain = np.random.default_rng(seed), PlainWorld(place)
    plants = [
        Plant(VEHICLE, place, np.random.default_rng(0), aircraft=Aircraft(plant=name))
        for name in ("pybullet", "kernel")
    ]
    lintels = np.flatnonzero(over_doors(place))
    late, names = [], []
    for k in range(24):
        target = o.center[rng.integers(n - place.building.boxes, n)].copy()
        if k % 2:
            target = o.center[rng.choice(lintels)].copy()
        target[2] += 0.8 * (k % 3 == 1)  # below some lintels is a door
        across = rng.uniform(-2.5, 2.5, 2)
        position = np.array([*(target[:2] + across), rng.uniform(-3.0, -2.0)])
        b = place.bounds
        position[0] = np.clip(position[0], b.north_min + 0.5, b.north_max - 0.5)
        position[1] = np.clip(position[1], b.east_min + 0.5, b.east_max - 0.5)
        gap = np.abs(position - o.center[:n]) - o.half_size[:n]
        if gap.max(axis=1).min() < 0.35:
            continue
        velocity = 7.0 * (target - position) / np.linalg.norm(target - position)
        if k % 4 == 2:
            velocity = np.array([1.0, -0.5, -7.0])
        theirs = plain.throw(position, velocity)[0]
        for plant in plants:
            plant.put(tuple(position), tuple(velocity))
            for _ in range(THROW_TICKS):
                plant.step(OFF)
            first = plant.collisions[0]
            assert first.what.replace("room-wall", "box") == theirs[1]
            late.append((plant is plants[1], abs(first.time_us - theirs[0])))
        names.append(first.what)
    for plant in plants:
        plant.close()
    plain.client.disconnect()
    assert all(apart == 0 for kernel, apart in late if not kernel)
    assert max(apart for _, apart in late) <= 2 * TICK_US
    assert "ceiling" in names
    assert sum("room-wall" in name for name in names) >= 4
