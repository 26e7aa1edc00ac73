"""The batch twin against the pybullet plant, and its contacts against pybullet's shapes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.constants import TICK_S
from airl_mav.control.cascade import Demand, cascade, new_memory
from airl_mav.envs.arenas import batch_of, move_obstacles
from airl_mav.envs.contact import FLOOR, NOTHING, WALL, touches
from airl_mav.envs.fleet import REPEAT_US, Fleet, Vehicle, advance, hover, new_fleet, vehicle_of
from airl_mav.frames import heading_to_ned, quat_yaw
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from firmware_sim.autopilot.parameters import Parameters
from firmware_sim.interfaces import ActuatorControls
from firmware_sim.plant.bullet import connect, pybullet
from firmware_sim.plant.plant import Plant

QUAD = load_profile("vehicles", "quad", VehicleProfile)
VEHICLE = vehicle_of(QUAD, Parameters(QUAD.parameters).__getitem__)
OPEN = Arena(
    name="open",
    seed=0,
    bounds=Bounds(-500.0, 500.0, -500.0, 500.0, 5.0),
    wall_colour=(0, 0, 0),
    obstacles=Obstacles(np.zeros(0, np.int8), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)),
    tours=(),
    goal=np.zeros(2),
)


def command(fleet: Fleet, i: int, setpoint: np.ndarray) -> None:
    fleet.setpoint[i] = setpoint
    fleet.repeat_us[i] = fleet.time_us[i]


class PlantPilot:
    """The same setpoints on the pybullet plant, controlled on its true state."""

    def __init__(self, altitude_m: float) -> None:
        self.plant = Plant(QUAD, None, np.random.default_rng(0))
        client, body = self.plant.world.client, self.plant._body
        half = math.sqrt(0.5)
        client.resetBasePositionAndOrientation(body, (0, 0, altitude_m), (0, 0, half, half))
        self.plant._motion = self.plant._read()
        a = VEHICLE.airframe
        self.plant._speeds = (math.sqrt(a.mass * 9.80665 / (4 * a.thrust_max)),) * 4
        self.memory = new_memory()
        self.time_us, self.repeat_us = 0, 0
        self.velocity = np.zeros(3)

    def fly(self, setpoint: np.ndarray, ticks: int) -> None:
        self.repeat_us = self.time_us
        for _ in range(ticks):
            truth = self.plant.truth()
            if self.time_us >= self.repeat_us:
                self.velocity = heading_to_ned(setpoint[:3], quat_yaw(truth.quaternion))
                self.repeat_us += REPEAT_US
            nan = (math.nan,) * 3
            demand = Demand(nan, tuple(self.velocity), math.nan, float(setpoint[3]))
            out = cascade(
                tuple(truth.position),
                tuple(truth.velocity),
                tuple(truth.quaternion),
                tuple(truth.angular_velocity),
                demand,
                self.memory,
                VEHICLE.gains,
                TICK_S,
            )
            self.plant.step(ActuatorControls(self.time_us, out.motors, True))
            self.time_us += 4_000


@pytest.mark.parametrize("seed", [1, 2])
def test_flies_like_the_pybullet_plant(seed: int) -> None:
    """30 s of manoeuvres, same setpoints: 5 mm is asked, rounding is what is left."""
    rng = np.random.default_rng(seed)
    fleet, arenas, pilot = new_fleet(1), batch_of([OPEN]), PlantPilot(60.0)
    hover(fleet, 0, 60.0, VEHICLE)
    for _ in range(60):
        setpoint = np.array(
            [rng.uniform(-3, 5), rng.uniform(-2, 2), rng.uniform(-1, 1), rng.uniform(-1.5, 1.5)]
        )
        command(fleet, 0, setpoint)
        advance(fleet, arenas, 125, VEHICLE)
        pilot.fly(setpoint, 125)
    truth = pilot.plant.truth()
    assert np.linalg.norm(truth.position[:2]) > 5.0  # it really went somewhere
    assert np.abs(fleet.position[0] - truth.position).max() < 1e-6
    assert np.abs(fleet.velocity[0] - truth.velocity).max() < 1e-6
    pilot.plant.close()


def test_vehicles_do_not_touch_each_other_s_rows() -> None:
    rng = np.random.default_rng(3)
    many, arenas = new_fleet(5), batch_of([OPEN] * 5)
    alone, arena = new_fleet(1), batch_of([OPEN])
    for i in range(5):
        hover(many, i, 30.0, VEHICLE)
    hover(alone, 0, 30.0, VEHICLE)
    for _ in range(20):
        setpoints = rng.uniform(-2, 2, (5, 4))
        for i in range(5):
            command(many, i, setpoints[i])
        command(alone, 0, setpoints[3])
        advance(many, arenas, 25, VEHICLE)
        advance(alone, arena, 25, VEHICLE)
    assert np.array_equal(many.position[3], alone.position[0])
    assert np.array_equal(many.energy[3], alone.energy[0])
    assert len({tuple(p) for p in many.position}) == 5


def test_distance_and_energy_of_a_straight_flight() -> None:
    fleet, arenas = new_fleet(1), batch_of([OPEN])
    hover(fleet, 0, 50.0, VEHICLE)
    command(fleet, 0, np.array([4.0, 0.0, 0.0, 0.0]))
    advance(fleet, arenas, 5000, VEHICLE)
    assert fleet.distance[0] == pytest.approx(fleet.position[0, 0], abs=0.2)
    # Steady 4 m/s: b1 v + b9 of the power model, plus the first seconds of acceleration.
    steady_w = QUAD.power.b9_hover + QUAD.power.b1_vxy * 4.0
    assert fleet.energy[0] == pytest.approx(20.0 * steady_w, rel=0.02)


def test_moving_obstacles_are_where_the_arena_says() -> None:
    spec = load_profile("arenas", "dynamic-obstacles", ArenaSpec)
    arenas = [generate(spec, seed, name="dynamic", vehicle_width_m=0.55) for seed in range(20)]
    batch = batch_of(arenas)
    for i, arena in enumerate(arenas):
        for time_us in (0, 1_234_000, 59_996_000, 200_000_000, 1_000_000_000):
            move_obstacles(batch, i, time_us)
            expected = arena.centers_at(time_us)
            assert np.allclose(batch.center[i, : len(expected)], expected, atol=1e-9)


def test_contact_ends_a_flight_and_names_what_was_hit() -> None:
    spec = load_profile("arenas", "no-obstacles", ArenaSpec)
    arena = generate(spec, 1, name="empty", vehicle_width_m=0.55)
    fleet, arenas = new_fleet(2), batch_of([arena, arena])
    for i, setpoint in enumerate(([5.0, 0, 0, 0], [0, 0, 1.0, 0])):
        hover(fleet, i, 2.5, VEHICLE)
        command(fleet, i, np.array(setpoint))
    advance(fleet, arenas, 6000, VEHICLE)
    assert list(fleet.touched) == [WALL, FLOOR]
    stopped = fleet.position.copy()
    advance(fleet, arenas, 100, VEHICLE)
    assert np.array_equal(stopped, fleet.position)


def test_contacts_agree_with_pybullet_s_distances() -> None:
    """A disc is a pybullet cylinder: overlap where pybullet's closest points are nearer than 0."""
    client = connect()
    rng = np.random.default_rng(5)
    disagreements, hits = 0, 0
    for _ in range(400):
        kind = Shape(int(rng.integers(3)))
        half = rng.uniform(0.4, 1.5, 3)
        if kind is not Shape.BOX:
            half[:] = [half[0], half[0], half[2] if kind is Shape.CYLINDER else half[0]]
        center, yaw = np.array([0.0, 0.0, -3.0]), float(rng.uniform(-math.pi, math.pi))
        position = center + rng.uniform(-2.2, 2.2, 3)
        found = touches(
            tuple(position),
            VEHICLE.radius,
            VEHICLE.half_height,
            np.array([-50.0, 50.0, -50.0, 50.0, 5.0]),
            1,
            np.array([kind], np.int8),
            center[None],
            half[None],
            np.array([yaw]),
        )
        if kind is Shape.BOX:
            shape = client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=list(half))
        elif kind is Shape.CYLINDER:
            shape = client.createCollisionShape(
                pybullet.GEOM_CYLINDER, radius=half[0], height=2 * half[2]
            )
        else:
            shape = client.createCollisionShape(pybullet.GEOM_SPHERE, radius=half[0])
        disc = client.createCollisionShape(
            pybullet.GEOM_CYLINDER, radius=VEHICLE.radius, height=2 * VEHICLE.half_height
        )
        # A heading in NED is the same turn the other way round in a z-up frame.
        turn = client.getQuaternionFromEuler((0.0, 0.0, -yaw))
        a = client.createMultiBody(0, shape, basePosition=(0, 0, 3), baseOrientation=turn)
        up = (position[0], -position[1], -position[2])
        b = client.createMultiBody(0, disc, basePosition=up)
        points = client.getClosestPoints(a, b, 0.5)
        gap = min((point[8] for point in points), default=1.0)
        client.removeBody(a)
        client.removeBody(b)
        hits += found != NOTHING
        if abs(gap) > 0.05:  # pybullet rounds its cylinders by a margin of 4 cm
            disagreements += (found != NOTHING) != (gap < 0.0)
    client.disconnect()
    assert hits > 40
    assert disagreements == 0


def test_vehicle_radius_covers_the_collision_box_s_width() -> None:
    assert isinstance(VEHICLE, Vehicle)
    assert pytest.approx(0.5 * QUAD.body.width_m) == VEHICLE.radius
