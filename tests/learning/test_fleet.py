"""The batch twin: against the pybullet plant, the referee, and pybullet's shapes."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.control.cascade import cascade_tick, filters
from airl_mav.control.demand import Demand
from airl_mav.control.memory import new_memory, trim_for_hover
from airl_mav.core.constants import GRAVITY_M_S2, TICK_S, TICK_US
from airl_mav.core.frames import heading_to_ned, quat_yaw
from airl_mav.envs.arena_batch import (
    FLOOR,
    NOTHING,
    WALL,
    ArenaBatch,
    batch_of,
    clearance,
    empty_batch,
    move_obstacles,
    put_arena,
    touches,
)
from airl_mav.envs.fleet import (
    Fleet,
    FleetConstants,
    FlightStatus,
    Rules,
    hover,
    new_fleet,
    vehicle_of,
)
from airl_mav.envs.fleet_step import REPEAT_US, advance
from airl_mav.flight.judge import Outcome, Referee, Task, TruthSample
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.power import level_power_w
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.interfaces import ActuatorControls
from firmware_sim.plant.bullet_body import connect, pybullet
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


ENDLESS = Rules(goal_radius=0.0, time_limit_us=10**12)


def fly(fleet: Fleet, arenas: ArenaBatch, ticks: int, rules: Rules = ENDLESS) -> None:
    advance(fleet, arenas, np.full(len(fleet.time_us), ticks), VEHICLE, rules, None)


def command(fleet: Fleet, i: int, setpoint: np.ndarray) -> None:
    fleet.setpoint[i] = setpoint
    fleet.repeat_us[i] = fleet.time_us[i]


class PlantPilot:
    """The same setpoints on the pybullet plant, controlled on its true state."""

    def __init__(
        self,
        altitude_m: float,
        battery: float = 1.0,
        *,
        seed: int = 0,
        aircraft: Aircraft | None = None,
        airframe: Airframe = VEHICLE.airframe,
    ) -> None:
        self.plant = Plant(
            QUAD, None, np.random.default_rng(seed), aircraft=aircraft, airframe=airframe
        )
        self.plant.battery_remaining = battery
        self.energy = 0.0
        self.plant.put((0.0, 0.0, -altitude_m))
        a = airframe
        self.plant.record["speeds"] = math.sqrt(a.mass * 9.80665 / (4 * a.thrust_max))
        self.memory = new_memory()
        trim_for_hover(self.memory, a.mass * 9.80665 / (4 * a.thrust_max), VEHICLE.gains)
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
            north, east, down = self.velocity
            demand = Demand(nan, (north, east, down), math.nan, float(setpoint[3]))
            out = cascade_tick(
                tuple(truth.position),
                tuple(truth.velocity),
                tuple(truth.quaternion),
                tuple(truth.angular_velocity),
                demand,
                self.memory,
                VEHICLE.gains,
                filters(VEHICLE.gains, TICK_S),
                TICK_S,
            )
            self.plant.step(ActuatorControls(self.time_us, out.motors, True))
            self.time_us += TICK_US
            self.energy += TICK_S * self.plant.truth().power_w


@pytest.mark.parametrize("seed", [1, 2])
def test_flies_like_the_pybullet_plant(seed: int) -> None:
    """Fly 30 s of manoeuvres with equal setpoints: 5 mm is required, only rounding remains."""
    rng = np.random.default_rng(seed)
    fleet, arenas, pilot = new_fleet(1), batch_of([OPEN]), PlantPilot(60.0)
    hover(fleet, 0, 60.0, VEHICLE)
    for _ in range(60):
        setpoint = np.array(
            [rng.uniform(-3, 5), rng.uniform(-2, 2), rng.uniform(-1, 1), rng.uniform(-1.5, 1.5)]
        )
        command(fleet, 0, setpoint)
        fly(fleet, arenas, 125)
        pilot.fly(setpoint, 125)
    truth = pilot.plant.truth()
    assert np.linalg.norm(truth.position[:2]) > 5.0  # it really went somewhere
    assert np.abs(fleet.position[0] - truth.position).max() < 1e-6
    assert np.abs(fleet.velocity[0] - truth.velocity).max() < 1e-6
    assert fleet.energy[0] == pytest.approx(pilot.energy, rel=1e-6)
    assert 1.0 - fleet.battery[0] == pytest.approx(1.0 - truth.battery_remaining, rel=1e-6)
    pilot.plant.close()


def test_battery_runs_empty_when_the_plant_s_does() -> None:
    fleet, arenas, pilot = new_fleet(1), batch_of([OPEN]), PlantPilot(60.0, battery=0.02)
    hover(fleet, 0, 60.0, VEHICLE)
    fleet.battery[0] = 0.02
    setpoint = np.array([4.0, 0.0, 0.0, 0.3])
    command(fleet, 0, setpoint)
    fly(fleet, arenas, 10_000)
    assert fleet.verdict[0] == FlightStatus.BATTERY
    assert fleet.battery[0] == 0.0
    pilot.fly(setpoint, int(fleet.time_us[0]) // TICK_US - 1)
    assert 0.0 < pilot.plant.truth().battery_remaining < 1e-5
    pilot.fly(setpoint, 1)
    assert pilot.plant.truth().battery_remaining == 0.0
    pilot.plant.close()


OUTCOMES = {
    Outcome.SUCCESS: FlightStatus.SUCCESS,
    Outcome.COLLISION: FlightStatus.COLLISION,
    Outcome.BATTERY: FlightStatus.BATTERY,
    Outcome.TIMEOUT: FlightStatus.TIMEOUT,
}


def test_verdicts_are_the_referee_s_to_the_tick() -> None:
    """The same flights, tick by tick and free of obstacles, shown to the referee."""
    n, rng = 32, np.random.default_rng(8)
    spec = load_profile("arenas", "dynamic-obstacles", ArenaSpec)
    worlds = [generate(spec, seed, name="dynamic", vehicle_width_m=0.55) for seed in range(n)]
    arenas, endless = batch_of(worlds), batch_of([OPEN] * n)
    rules = Rules(goal_radius=6.0, time_limit_us=9_002_000)  # the limit lies between two ticks
    fleet, free = new_fleet(n), new_fleet(n)
    referees = []
    for i, world in enumerate(worlds):
        battery = 0.003 if i % 4 == 0 else 1.0
        north, east = world.goal / np.linalg.norm(world.goal)
        speed = rng.uniform(1.0, 5.0)
        setpoint = np.array([speed * north, speed * east, rng.uniform(-0.2, 0.2), 0.0])
        for each in (fleet, free):
            hover(each, i, 2.5, VEHICLE)
            each.battery[i] = battery
            command(each, i, setpoint)
        referee = Referee(Task(tuple(world.goal), rules.goal_radius, rules.time_limit_us / 1e6))
        referee.start_navigation(0)
        referees.append(referee)
    for ticks in (1, 250, 7, 900, 3, 2000):
        fly(fleet, arenas, ticks, rules)

    hits: list[str | None] = [None] * n
    for _ in range(2300):
        fly(free, endless, 1)
        for i, (world, referee) in enumerate(zip(worlds, referees, strict=True)):
            if referee.verdict is not None:
                continue
            o, time_us = world.obstacles, int(free.time_us[i])
            hit = touches(
                tuple(free.position[i]),
                VEHICLE.radius,
                VEHICLE.half_height,
                world.bounds.as_array(),
                len(o),
                o.shape,
                world.centers_at(time_us),
                o.half_size,
                o.yaw,
            )
            hits[i] = hits[i] or (None if hit == NOTHING else str(hit))
            referee.observe(TruthSample(time_us, tuple(free.position[i]), hits[i], free.battery[i]))
    for i, referee in enumerate(referees):
        assert referee.verdict is not None
        assert fleet.verdict[i] == OUTCOMES[referee.verdict.outcome]
        assert fleet.time_us[i] == referee.verdict.time_us
        assert str(fleet.touched[i]) == (hits[i] or str(NOTHING))
    assert set(fleet.verdict) == {
        FlightStatus.SUCCESS,
        FlightStatus.COLLISION,
        FlightStatus.BATTERY,
        FlightStatus.TIMEOUT,
    }


def test_goal_comes_before_a_collision_in_the_same_tick() -> None:
    """The referee's order: a vehicle that grazes the floor inside the goal has succeeded."""
    goal = dataclasses.replace(OPEN, goal=np.array([0.0, 0.0]))
    fleet = new_fleet(2)
    hover(fleet, 0, 0.01, VEHICLE)
    hover(fleet, 1, 0.01, VEHICLE)
    fleet.battery[1] = 1e-12
    fly(fleet, batch_of([goal, dataclasses.replace(OPEN, goal=np.array([50.0, 0.0]))]), 1,
        Rules(3.0, TICK_US))  # fmt: skip
    assert list(fleet.verdict) == [FlightStatus.SUCCESS, FlightStatus.COLLISION]
    assert list(fleet.touched) == [FLOOR, FLOOR]


def test_every_vehicle_flies_its_own_airframe() -> None:
    """In a steady hover the rotors carry the vehicle's own weight."""
    nominal = VEHICLE.airframe
    heavy = nominal._replace(mass=1.2 * nominal.mass)
    strong = nominal._replace(thrust_max=1.3 * nominal.thrust_max, rotor_time_constant=0.08)
    fleet, arenas = new_fleet(3), batch_of([OPEN] * 3)
    for i, airframe in enumerate((None, heavy, strong)):
        hover(fleet, i, 30.0, VEHICLE, airframe)
    fly(fleet, arenas, 5000)
    for i, airframe in enumerate((nominal, heavy, strong)):
        lift = airframe.thrust_max * np.sum(fleet.rotor[i] ** 2)
        assert lift == pytest.approx(airframe.mass * GRAVITY_M_S2, rel=1e-3)
        assert np.abs(fleet.velocity[i]).max() < 0.01


def test_every_vehicle_flies_its_own_number_of_ticks() -> None:
    fleet, arenas = new_fleet(3), batch_of([OPEN] * 3)
    for i in range(3):
        hover(fleet, i, 30.0, VEHICLE)
    advance(fleet, arenas, np.array([0, 3, 250]), VEHICLE, ENDLESS, None)
    assert list(fleet.time_us) == [0, 3 * TICK_US, 250 * TICK_US]


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
        fly(many, arenas, 25)
        fly(alone, arena, 25)
    assert np.array_equal(many.position[3], alone.position[0])
    assert np.array_equal(many.energy[3], alone.energy[0])
    assert len({tuple(p) for p in many.position}) == 5


def test_distance_and_energy_of_a_straight_flight() -> None:
    fleet, arenas = new_fleet(1), batch_of([OPEN])
    hover(fleet, 0, 50.0, VEHICLE)
    command(fleet, 0, np.array([4.0, 0.0, 0.0, 0.0]))
    fly(fleet, arenas, 5000)
    assert fleet.distance[0] == pytest.approx(fleet.position[0, 0], abs=0.2)
    # Steady 4 m/s, plus the first seconds of acceleration.
    steady_w = level_power_w(4.0, VEHICLE.airframe, VEHICLE.power)
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


def test_obstacles_stand_where_they_are_when_a_call_begins_and_ends() -> None:
    spec = load_profile("arenas", "dynamic-obstacles", ArenaSpec)
    world = generate(spec, 2, name="dynamic", vehicle_width_m=0.55)
    room = batch_of([world])
    batch = empty_batch(1, room.shape.shape[1], *room.tour_times_s.shape[1:])
    for _ in range(2):  # the second time over the traces of the first
        put_arena(batch, 0, world)
        assert np.allclose(batch.center[0], world.centers_at(0), atol=1e-12)
        fleet = new_fleet(1)
        hover(fleet, 0, 2.5, VEHICLE)
        fly(fleet, batch, 250)
        assert np.allclose(batch.center[0], world.centers_at(1_000_000), atol=1e-9)
        assert np.abs(batch.center[0] - world.centers_at(0)).max() > 0.1


def test_contact_ends_a_flight_and_names_what_was_hit() -> None:
    spec = load_profile("arenas", "no-obstacles", ArenaSpec)
    arena = generate(spec, 1, name="empty", vehicle_width_m=0.55)
    fleet, arenas = new_fleet(2), batch_of([arena, arena])
    for i, setpoint in enumerate(([5.0, 0, 0, 0], [0, 0, 1.0, 0])):
        hover(fleet, i, 2.5, VEHICLE)
        command(fleet, i, np.array(setpoint))
    fly(fleet, arenas, 6000)
    assert list(fleet.touched) == [WALL, FLOOR]
    assert list(fleet.verdict) == [FlightStatus.COLLISION] * 2
    stopped = fleet.position.copy()
    fly(fleet, arenas, 100)
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
            np.array([-50.0, 50.0, -50.0, 50.0, 5.0, 0.0]),
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


def test_nothing_is_touched_within_the_clearance() -> None:
    rng = np.random.default_rng(6)
    bounds = np.array([-9.0, 9.0, -9.0, 9.0, 5.0, 0.0])
    radius, half_height = VEHICLE.radius, VEHICLE.half_height
    spare = []
    for _ in range(300):
        shape = rng.integers(0, 3, 4).astype(np.int8)
        half = rng.uniform(0.3, 1.5, (4, 3))
        half[shape != Shape.BOX, 1] = half[shape != Shape.BOX, 0]
        half[shape == Shape.SPHERE, 2] = half[shape == Shape.SPHERE, 0]
        center = rng.uniform([-9, -9, -6], [9, 9, 0], (4, 3))
        yaw = rng.uniform(-3, 3, 4)
        here = rng.uniform([-11, -11, -8], [11, 11, 0])
        room = clearance(tuple(here), radius, half_height, bounds, 4, center, half)
        step = rng.normal(size=(50, 3))
        step *= 0.999 * max(room, 0.0) / np.linalg.norm(step, axis=1, keepdims=True)
        scene = (bounds, 4, shape, center, half, yaw)
        if room > 0.0:
            for there in here + step:
                assert touches(tuple(there), radius, half_height, *scene) == NOTHING
        spare.append(room)
    assert np.mean(np.array(spare) > 0.2) > 0.3  # it is of use
    # A pillar counts as the cylinder around its bounding box.
    pillar = np.array([[4.0, 0.0, -2.0]]), np.array([[1.0, 1.0, 2.0]])
    room = clearance((0.0, 0.0, -2.5), radius, half_height, 9 * bounds, 1, *pillar)
    assert room == pytest.approx(min(2.5 - half_height, 4.0 - math.sqrt(2.0) - radius))


def test_vehicle_radius_covers_the_collision_box_s_width() -> None:
    assert isinstance(VEHICLE, FleetConstants)
    assert pytest.approx(0.5 * QUAD.body.width_m) == VEHICLE.radius


@pytest.mark.parametrize("thrust_curve", [0.0, 0.4, 1.0])
def test_a_heavy_vehicle_begins_in_a_steady_hover(thrust_curve: float) -> None:
    """Hold the altitude however far mass and thrust are from the controller's assumptions."""
    fleet, arenas = new_fleet(1), batch_of([OPEN])
    nominal = VEHICLE.airframe
    heavy = nominal._replace(
        mass=1.2 * nominal.mass, thrust_max=0.9 * nominal.thrust_max, thrust_curve=thrust_curve
    )
    hover(fleet, 0, 30.0, VEHICLE, heavy)
    for _ in range(20):
        advance(fleet, arenas, np.array([25]), VEHICLE, ENDLESS, None)
        assert abs(fleet.position[0, 2] + 30.0) < 1e-3
        assert abs(fleet.velocity[0, 2]) < 1e-3
