"""The plant's world against pybullet's plainest: every body a multi-body, moved at every tick."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pybullet
import pytest
from pybullet_utils.bullet_client import BulletClient

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena, Shape
from airl_mav.core.constants import GRAVITY_M_S2, TICK_S, TICK_US
from airl_mav.core.frames import ned_to_enu
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.interfaces import ActuatorControls
from firmware_sim.plant.bullet_body import BulletWorld, facing
from firmware_sim.plant.plant import REST_SPEED_M_S, Plant
from tests.support.flight_rig import quad

STILL = {"linear_n_s_m": 0.0, "quadratic_n_s2_m2": 0.0, "angular_n_m_s": 0.0}
VEHICLE = quad(drag=STILL)
"""Falls as a stone does."""
BODY = VEHICLE.body
OFF = ActuatorControls(0, (0.0, 0.0, 0.0, 0.0), False)
FACING_NORTH = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
THROW_TICKS = 400


def crowd(seed: int) -> Arena:
    spec = load_profile("arenas", "crowded", ArenaSpec)
    return generate(spec, seed, name="crowded", vehicle_width_m=BODY.width_m)


def beside(rng: np.random.Generator, place: Arena, time_us: int, away_m: float) -> np.ndarray:
    """Return north, east of a spot beside some moving obstacle, and of that obstacle: (2, 2)."""
    b = place.bounds
    target = place.centers_at(time_us)[rng.integers(place.n_static, len(place.obstacles)), :2]
    bearing = rng.uniform(-math.pi, math.pi)
    spot = target + away_m * np.array([math.cos(bearing), math.sin(bearing)])
    corners = np.array([[b.north_min, b.east_min], [b.north_max, b.east_max]])
    return np.array([np.clip(spot, corners[0] + 1.0, corners[1] - 1.0), target])


def throws(seed: int, place: Arena) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return starts (position, velocity NED), each aimed at a moving obstacle."""
    rng = np.random.default_rng(seed)
    found = []
    for i in range(12):
        spot, target = beside(rng, place, i * THROW_TICKS * TICK_US, 3.0)
        aim = (target - spot) / np.linalg.norm(target - spot)
        position = np.array([*spot, rng.uniform(-4.0, -1.0)])
        found.append((position, np.array([*(6.0 * aim), rng.uniform(-3.0, 0.0)])))
    return found


class PlainWorld:
    """Walls, floor, obstacles and vehicle with pybullet's defaults; nothing but its own API."""

    def __init__(self, place: Arena) -> None:
        self.client: Any = BulletClient(pybullet.DIRECT)
        self.client.setGravity(0, 0, -GRAVITY_M_S2)
        self.client.setTimeStep(TICK_S)
        self.place = place
        self.names = {
            self.client.createMultiBody(
                0, self.client.createCollisionShape(pybullet.GEOM_PLANE)
            ): "floor"
        }
        b, thick = place.bounds, 0.1
        middle = 0.5 * (b.north_min + b.north_max), 0.5 * (b.east_min + b.east_max)
        for name, north, east, half in (
            ("north", b.north_max + thick, middle[1], (100.0, thick)),
            ("south", b.north_min - thick, middle[1], (100.0, thick)),
            ("east", middle[0], b.east_max + thick, (thick, 100.0)),
            ("west", middle[0], b.east_min - thick, (thick, 100.0)),
        ):
            shape = self.client.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=(*half, 0.5 * b.height)
            )
            body = self.client.createMultiBody(0, shape, basePosition=(east, north, 0.5 * b.height))
            self.names[body] = f"wall-{name}"
        if b.ceiling:
            shape = self.client.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=(100.0, 100.0, thick)
            )
            above = (middle[1], middle[0], b.height + thick)
            self.names[self.client.createMultiBody(0, shape, basePosition=above)] = "ceiling"
        o, self.movers = place.obstacles, []
        for i, (shape_kind, half_size) in enumerate(zip(o.shape, o.half_size, strict=True)):
            x, _, z = half_size
            if shape_kind == Shape.BOX:
                shape = self.client.createCollisionShape(
                    pybullet.GEOM_BOX, halfExtents=list(half_size)
                )
            elif shape_kind == Shape.CYLINDER:
                shape = self.client.createCollisionShape(
                    pybullet.GEOM_CYLINDER, radius=x, height=2 * z
                )
            else:
                shape = self.client.createCollisionShape(pybullet.GEOM_SPHERE, radius=x)
            # A heading clockwise from north is a turn the other way from east. Taken from the
            # plant to the last bit: impacts on edges make much of it.
            turn = facing(float(o.yaw[i]))
            expected = self.client.getQuaternionFromEuler((0.0, 0.0, 0.5 * math.pi - o.yaw[i]))
            assert abs(np.dot(turn, expected)) == pytest.approx(1.0, abs=1e-12)
            body = self.client.createMultiBody(
                0, shape, basePosition=ned_to_enu(o.center[i]), baseOrientation=turn
            )
            moving = i >= place.n_static
            kind = Shape(int(shape_kind)).name.lower()
            self.names[body] = f"{'moving' if moving else 'static'}-{kind}-{i}"
            if moving:
                self.movers.append((body, i, turn))
        size = (0.5 * BODY.width_m, 0.5 * BODY.width_m, 0.5 * BODY.height_m)
        box = self.client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=size)
        self.vehicle = self.client.createMultiBody(BODY.mass_kg, box, basePosition=(0, 0, 50))
        inertia = (BODY.inertia_xx_kg_m2, BODY.inertia_yy_kg_m2, BODY.inertia_zz_kg_m2)
        self.client.changeDynamics(
            self.vehicle,
            -1,
            localInertiaDiagonal=inertia,
            linearDamping=0.0,
            angularDamping=0.0,
            lateralFriction=0.8,
        )
        self.time_us = 0

    def throw(self, position: np.ndarray, velocity: np.ndarray) -> list[tuple[int, str]]:
        """Return the times [µs] and names of new contacts, in order."""
        client, v = self.client, self.vehicle
        client.resetBasePositionAndOrientation(v, ned_to_enu(position), FACING_NORTH)
        client.resetBaseVelocity(v, ned_to_enu(velocity), (0.0, 0.0, 0.0))
        hits: list[tuple[int, str]] = []
        touching: set[int] = set()
        for _ in range(THROW_TICKS):
            self.time_us += TICK_US
            centers = ned_to_enu(self.place.centers_at(self.time_us))
            for body, i, turn in self.movers:
                client.resetBasePositionAndOrientation(body, centers[i], turn)
            speed = float(np.linalg.norm(client.getBaseVelocity(v)[0]))
            client.stepSimulation()
            points = client.getContactPoints(v)
            close = {p[2] for p in points}
            pressed = {p[2] for p in points if p[9] > 0.0}
            for other in sorted(pressed - touching):
                if self.names[other] != "floor" or speed > REST_SPEED_M_S:
                    hits.append((self.time_us, self.names[other]))
            touching = pressed | (touching & close)
        return hits


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_what_is_hit_and_when_is_as_in_plain_pybullet(seed: int) -> None:
    place = crowd(seed)
    bullet = Aircraft(plant="pybullet")
    plant = Plant(VEHICLE, place, np.random.default_rng(0), aircraft=bullet)
    plain = PlainWorld(place)
    names: set[str] = set()
    for position, velocity in throws(seed, place):
        plant.put(tuple(position), tuple(velocity))
        for _ in range(THROW_TICKS):
            plant.step(OFF)
        hits = [(hit.time_us, hit.what) for hit in plant.collisions]
        assert hits == plain.throw(position, velocity)
        names |= {what.rsplit("-", 1)[0] for _, what in hits}
    plant.close()
    plain.client.disconnect()
    assert len({name for name in names if name.startswith("moving")}) >= 2
    assert "floor" in names


@pytest.mark.parametrize("name", ["crowded", "dynamic-obstacles"])
def test_near_the_vehicle_every_moving_obstacle_is_where_the_arena_says(name: str) -> None:
    """However long it was left alone far away, and to the last bit."""
    spec = load_profile("arenas", name, ArenaSpec)
    place = generate(spec, 4, name=name, vehicle_width_m=BODY.width_m)
    radius = 0.5 * math.hypot(BODY.width_m, BODY.width_m, BODY.height_m)
    world, rng = BulletWorld(place, radius), np.random.default_rng(8)
    bodies = [n for n, what in world.names.items() if what.startswith("moving")]
    first = place.n_static
    half = place.obstacles.half_size[first:]
    reach = np.hypot(half[:, 0], half[:, 1]) + radius + 0.05
    vehicle, velocity, near, left_behind = np.zeros(16), np.zeros(2), 0, 0
    for tick in range(30_000):
        velocity = 0.999 * velocity + 0.3 * rng.standard_normal(2)
        vehicle[:2] += TICK_S * velocity
        if tick % 1000 == 0:  # now and then somewhere else
            vehicle[:2] = beside(rng, place, tick * TICK_US, rng.uniform(0.0, 5.0))[0]
        world.move_obstacles(tick * TICK_US, vehicle)
        if tick % 10:
            continue
        true = ned_to_enu(place.centers_at(tick * TICK_US)[first:])
        stand = np.array([world.client.getBasePositionAndOrientation(n)[0] for n in bodies])
        here = vehicle[[1, 0]]
        could = (np.linalg.norm(true[:, :2] - here, axis=1) < reach) | (
            np.linalg.norm(stand[:, :2] - here, axis=1) < reach
        )
        np.testing.assert_array_equal(stand[could], true[could])
        near += int(could.sum())
        left_behind += int(np.any(stand != true, axis=1).sum())
    world.close()
    assert near > 20
    assert left_behind > 20
