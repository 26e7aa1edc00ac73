"""Plant, world, sensors and wind against closed forms, scipy and published values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape, Tour
from airl_mav.core.constants import TICK_S, TICK_US
from airl_mav.core.frames import HOME, Vector
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import Sensors, VehicleProfile, WindSettings
from airl_mav.scenario.aircraft import HAS_PYBULLET, Aircraft, PlantName
from airl_mav.vehicle import atmosphere as wind_module
from airl_mav.vehicle.atmosphere import Wind
from firmware_sim.engine.dynamics import FORCE, POSITION, QUATERNION, VELOCITY
from firmware_sim.engine.ticks import is_due
from firmware_sim.interfaces import ActuatorControls, BatterySample, SensorSample
from firmware_sim.plant import sensors as sensors_module
from firmware_sim.plant.plant import Collision, Plant
from firmware_sim.plant.sensors import SensorSuite
from tests.support.solo import SOLO

G = 9.80665
QUAD = load_profile("vehicles", "quad", VehicleProfile)
MASS, WIDTH, HEIGHT = QUAD.body.mass_kg, QUAD.body.width_m, QUAD.body.height_m
OFF = ActuatorControls(0, (0.0, 0.0, 0.0, 0.0), False)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
BATTERY = BatterySample(16.0, 1.0, 0.0, 1.0)

PlantMaker = Callable[..., Plant]


def thrust(share_of_weight: float) -> ActuatorControls:
    """Return equal commands that carry a share of the weight (quad.toml: thrust linear in them)."""
    u = share_of_weight * MASS * G / (4 * QUAD.rotor.thrust_max_n)
    return ActuatorControls(0, (u, u, u, u), True)


HOVER = thrust(1.0)


def changed(profile: VehicleProfile = QUAD, **tables: dict[str, Any]) -> VehicleProfile:
    """Return a profile with some fields of some of its tables replaced."""
    update = {
        name: getattr(profile, name).model_copy(update=fields) for name, fields in tables.items()
    }
    return profile.model_copy(update=update)


def sensors(**tables: dict[str, float]) -> Sensors:
    """Return the quad's sensors, free of noise, bias and drift but for the fields given."""
    quiet: dict[str, dict[str, float]] = {
        "imu": dict.fromkeys(type(QUAD.sensors.imu).model_fields, 0.0),
        "magnetometer": {"noise_gauss": 0.0},
        "barometer": {"noise_pa": 0.0, "drift_pa_sqrt_s": 0.0},
        "gps": {
            "horizontal_noise_m": 0.0,
            "vertical_noise_m": 0.0,
            "velocity_noise_m_s": 0.0,
            "drift_m_sqrt_s": 0.0,
        },
    }
    return QUAD.sensors.model_copy(
        update={
            name: getattr(QUAD.sensors, name).model_copy(update=fields | tables.get(name, {}))
            for name, fields in quiet.items()
        }
    )


NO_DRAG = {"linear_n_s_m": 0.0, "quadratic_n_s2_m2": 0.0, "angular_n_m_s": 0.0}
QUIET = QUAD.model_copy(update={"sensors": sensors()})
GLIDER = changed(QUIET, drag=NO_DRAG)
"""No noise, no drag."""


def arena(
    shape: Shape | None = None,
    center: tuple[float, float, float] = (5.0, 0.0, -2.0),
    half: tuple[float, float, float] = (0.5, 0.5, 0.5),
    tour: Tour | None = None,
    yaw: float = 0.0,
) -> Arena:
    n = 0 if shape is None else 1
    obstacles = Obstacles(
        np.array([shape] * n, np.int8),
        np.array([center] * n, np.float64).reshape(n, 3),
        np.array([half] * n, np.float64).reshape(n, 3),
        np.full(n, yaw),
    )
    tours = () if tour is None else (tour,)
    bounds = Bounds(-15.0, 20.0, -12.0, 10.0, 6.0)
    return Arena("test", 0, bounds, (0, 0, 0), obstacles, tours, np.array([10.0, 0.0]))


@pytest.fixture(params=get_args(PlantName) if HAS_PYBULLET else ("kernel",))
def body(request: pytest.FixtureRequest) -> str:
    """Return a body's name: all bodies must pass the plant's tests."""
    name: str = request.param
    return name


@pytest.fixture
def make(body: str) -> Iterator[PlantMaker]:
    """Make plants that are released after the test."""
    plants: list[Plant] = []

    def maker(
        profile: VehicleProfile = QUIET,
        arena: Arena | None = None,
        seed: int = 1,
        **more: Any,
    ) -> Plant:
        asked = {
            "plant": body,
            **{name: more.pop(name) for name in ("wind", "plant") if name in more},
        }
        more.setdefault("aircraft", Aircraft.model_validate(asked))
        plants.append(Plant(profile, arena, np.random.default_rng(seed), **more))
        return plants[-1]

    yield maker
    for plant in plants:
        plant.close()


def run(plant: Plant, controls: ActuatorControls, seconds: float) -> list[SensorSample]:
    return [plant.step(controls) for _ in range(round(seconds / TICK_S))]


def put(
    plant: Plant,
    position: tuple[float, float, float],
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    attitude: Rotation | None = None,
) -> None:
    """Teleport the vehicle: position and velocity NED, attitude body -> NED, no spin."""
    x, y, z, w = (attitude or Rotation.identity()).as_quat()
    plant.put(position, velocity, (w, x, y, z))


def hovering(plant: Plant) -> None:
    """Let the rotors reach hover speed (time constant 30 ms) high above everything."""
    put(plant, (0.0, 0.0, -50.0))
    run(plant, HOVER, 1.0)


# --- at rest and in free fall


def test_rests_still_on_the_floor(make: PlantMaker) -> None:
    plant = make(QUAD)
    start = plant.truth().position
    np.testing.assert_allclose(start, [0.0, 0.0, -HEIGHT / 2], atol=1e-9)
    accel = np.array([s.accel for s in run(plant, OFF, 5.0)])
    truth = plant.truth()
    assert np.abs(truth.position - start).max() < 1e-3
    np.testing.assert_allclose(truth.quaternion, LEVEL, atol=1e-4)
    imu = QUAD.sensors.imu
    sigma = math.hypot(imu.accel_bias_m_s2, imu.accel_noise_m_s2 / math.sqrt(len(accel)))
    assert np.abs(accel.mean(axis=0) - [0.0, 0.0, -G]).max() < 4 * sigma
    assert plant.collisions == []
    assert truth.time_us == 5_000_000


def test_feels_its_weight_exactly_without_noise(make: PlantMaker) -> None:
    plant = make()
    np.testing.assert_allclose(plant.sense().accel, [0.0, 0.0, -G], atol=1e-12)
    np.testing.assert_allclose(run(plant, OFF, 2.0)[-1].accel, [0.0, 0.0, -G], atol=2e-3)


@pytest.mark.parametrize(
    "angles", [(30.0, 0.0, 0.0), (-120.0, 0.0, 90.0), (0.0, 0.0, 180.0), (70.0, 90.0, 0.0)]
)
def test_a_turned_body_at_rest_feels_gravity_along_its_own_axes(
    make: PlantMaker, angles: tuple[float, float, float]
) -> None:
    turned = Rotation.from_euler("ZYX", angles, degrees=True)
    height = WIDTH / 2 if 90.0 in angles[1:] else HEIGHT / 2
    plant = make()
    put(plant, (0.0, 0.0, -height), attitude=turned)
    sample = run(plant, OFF, 1.0)[-1]
    np.testing.assert_allclose(sample.accel, turned.inv().apply([0.0, 0.0, -G]), atol=0.02)
    np.testing.assert_allclose(sample.gyro, 0.0, atol=1e-3)


def test_falls_freely_with_motors_off(make: PlantMaker) -> None:
    plant = make(GLIDER)
    put(plant, (0.0, 0.0, -100.0), (2.0, -1.0, 0.0))
    sample = run(plant, OFF, 2.0)[-1]
    truth = plant.truth()
    np.testing.assert_allclose(truth.velocity, [2.0, -1.0, 2.0 * G], rtol=1e-9)
    # Semi-implicit Euler runs half a tick's velocity ahead of the parabola.
    fallen = 0.5 * G * 2.0**2 + 0.5 * G * 2.0 * TICK_S
    np.testing.assert_allclose(truth.position, [4.0, -2.0, -100.0 + fallen], atol=1e-6)
    np.testing.assert_allclose(sample.accel, 0.0, atol=1e-7)


def test_full_thrust_lifts_by_the_surplus(make: PlantMaker) -> None:
    plant = make(GLIDER)
    hovering(plant)
    put(plant, (0.0, 0.0, -50.0))
    run(plant, thrust(1.5), 1.0)
    # The rotors lag: v = a (t - tau (1 - exp(-t / tau))) for a thrust that rises with the lag; the
    # speed does, the thrust goes with its square, so bracket: never more than the full surplus.
    climb = -plant.truth().velocity[2]
    tau = QUAD.rotor.time_constant_s
    assert 0.5 * G * (1.0 - 2 * tau) < climb < 0.5 * G


# --- wind


@pytest.mark.parametrize("controls", [OFF, HOVER])
def test_steady_wind_carries_a_body_by_linear_drag(
    make: PlantMaker, controls: ActuatorControls
) -> None:
    k = QUAD.drag.linear_n_s_m
    plant = make(wind=WindSettings(north_m_s=6.0, east_m_s=-3.0))
    hovering(plant)
    if controls is OFF:
        run(plant, OFF, 1.0)
    put(plant, (0.0, 0.0, -100.0))
    run(plant, controls, 2.0)
    gain = 1.0 - math.exp(-k * 2.0 / MASS)
    # Speed of sinking: none at hover, towards m g / k in a fall.
    sink = 0.0 if controls is HOVER else MASS * G / k * gain
    expected = [6.0 * gain, -3.0 * gain, sink]
    np.testing.assert_allclose(plant.truth().velocity, expected, rtol=1e-3, atol=2e-3)


def test_steady_wind_carries_a_body_by_quadratic_drag(make: PlantMaker) -> None:
    k, wind = 0.2, 8.0
    drag = NO_DRAG | {"quadratic_n_s2_m2": k}
    plant = make(changed(QUIET, drag=drag), wind=WindSettings(east_m_s=wind))
    hovering(plant)
    put(plant, (0.0, 0.0, -100.0))
    run(plant, HOVER, 2.0)
    # Lag behind the wind u: u' = -k u² / m
    lag = wind / (1.0 + k * wind * 2.0 / MASS)
    np.testing.assert_allclose(plant.truth().velocity, [0.0, wind - lag, 0.0], atol=0.02)


def test_calm_is_calm() -> None:
    wind = Wind(WindSettings(), np.random.default_rng(1))
    assert all(np.all(wind.step() == 0.0) for _ in range(100))


def test_gusts_have_the_spread_and_correlation_time_stated() -> None:
    sigma, tau = 2.0, 0.2
    settings_ = WindSettings(north_m_s=5.0, east_m_s=-1.0, gust_m_s=sigma, gust_time_s=tau)
    wind = Wind(settings_, np.random.default_rng(7))
    blown = np.array([wind.step() for _ in range(100_000)])  # 400 s = 2000 correlation times
    np.testing.assert_allclose(blown.mean(axis=0), [5.0, -1.0, 0.0], atol=5 * sigma / 30)
    np.testing.assert_allclose(blown.std(axis=0), [sigma, sigma, sigma / 2], rtol=0.07)
    gusts = (blown - blown.mean(axis=0)) / blown.std(axis=0)
    for lag_s in (0.1, 0.2, 0.4):
        n = round(lag_s / TICK_S)
        correlation = (gusts[:-n] * gusts[n:]).mean(axis=0)
        np.testing.assert_allclose(correlation, math.exp(-lag_s / tau), atol=0.1)
    across = np.corrcoef(gusts.T)[np.triu_indices(3, 1)]
    np.testing.assert_allclose(across, 0.0, atol=0.12)


def test_the_first_gust_is_drawn_from_the_same_spread() -> None:
    calm_start = WindSettings(gust_m_s=3.0)
    first = [Wind(calm_start, np.random.default_rng(seed)).step()[0] for seed in range(600)]
    assert np.std(first) == pytest.approx(3.0, rel=0.12)


# --- collisions

SPEED = 3.0
RUN_UP_M = 1.5

STATIC = [
    ("wall-north", None, (0.5, 0.5, 0.5), 20.0),
    ("static-box-0", Shape.BOX, (0.5, 1.0, 0.8), 4.5),
    ("static-cylinder-0", Shape.CYLINDER, (0.4, 0.4, 2.0), 4.6),
    ("static-sphere-0", Shape.SPHERE, (0.6, 0.6, 0.6), 4.4),
]


def only(collisions: list[Collision]) -> Collision:
    assert len(collisions) == 1, collisions
    return collisions[0]


@pytest.mark.parametrize(("name", "shape", "half", "face"), STATIC)
def test_flying_into_something_is_latched_once(
    make: PlantMaker,
    name: str,
    shape: Shape | None,
    half: tuple[float, float, float],
    face: float,
) -> None:
    plant = make(GLIDER, arena(shape, half=half))
    hovering(plant)
    start_us = plant.truth().time_us
    put(plant, (face - WIDTH / 2 - RUN_UP_M, 0.0, -2.0), (SPEED, 0.0, 0.0))
    run(plant, HOVER, RUN_UP_M / SPEED - 0.02)
    assert plant.collisions == []
    run(plant, HOVER, 0.4)
    hit = only(plant.collisions)
    assert hit.what == name
    assert hit.speed_m_s == pytest.approx(SPEED, rel=1e-3)
    assert (hit.time_us - start_us) / 1e6 == pytest.approx(RUN_UP_M / SPEED, abs=0.012)
    assert plant.truth().velocity[0] < 0.1 * SPEED


@pytest.mark.parametrize(
    ("name", "direction", "room"),
    [
        ("wall-north", (1.0, 0.0), 20.0),
        ("wall-south", (-1.0, 0.0), 15.0),
        ("wall-east", (0.0, 1.0), 10.0),
        ("wall-west", (0.0, -1.0), 12.0),
    ],
)
def test_each_wall_stands_on_its_bound(
    make: PlantMaker, name: str, direction: tuple[float, float], room: float
) -> None:
    plant = make(GLIDER, arena())
    n, e = direction
    stop = room - WIDTH / 2 - 0.3
    put(plant, (n * stop, e * stop, -3.0), (n * SPEED, e * SPEED, 0.0))
    run(plant, OFF, 0.3)
    assert only(plant.collisions).what == name
    # It lost its speed with its front on the bound: a wall that stood elsewhere would show here.
    assert abs(plant.truth().position @ [n, e, 0.0] - (room - WIDTH / 2)) < 0.03


def test_a_second_contact_is_a_second_event(make: PlantMaker) -> None:
    plant = make(GLIDER, arena(Shape.BOX))
    hovering(plant)
    for times in (1, 2):
        before = list(plant.collisions)
        put(plant, (3.0, 0.0, -2.0), (SPEED, 0.0, 0.0))
        plant.collisions.extend(before)
        run(plant, HOVER, 0.7)
        assert [c.what for c in plant.collisions] == ["static-box-0"] * times
    assert plant.collisions[0].time_us < plant.collisions[1].time_us


def test_a_near_miss_is_no_collision(make: PlantMaker) -> None:
    plant = make(GLIDER, arena(Shape.BOX))
    hovering(plant)
    put(plant, (3.0, 0.5 + WIDTH / 2 + 0.03, -2.0), (SPEED, 0.0, 0.0))
    run(plant, HOVER, 1.5)
    assert plant.truth().position[0] > 7.0
    assert plant.collisions == []


MOVING = [
    # Height of the obstacle's centre 0.5 m; the vehicle stands on the floor.
    ("moving-box-0", Shape.BOX, (0.5, 0.5, 0.5), 0.5),
    ("moving-cylinder-0", Shape.CYLINDER, (0.5, 0.5, 0.5), 0.5),
    # The sphere meets the top edge, HEIGHT above the floor.
    ("moving-sphere-0", Shape.SPHERE, (0.5, 0.5, 0.5), math.sqrt(0.5**2 - (0.5 - HEIGHT) ** 2)),
]


@pytest.mark.parametrize(("name", "shape", "half", "reach"), MOVING)
def test_a_moving_obstacle_runs_into_a_standing_vehicle(
    make: PlantMaker, name: str, shape: Shape, half: tuple[float, float, float], reach: float
) -> None:
    # From 4 m to 0.3 m at 2 m/s, then it stays away for a long time.
    tour = Tour(
        np.array([0.0, 1.85, 3.7, 60.0]),
        np.array([[4.0, 0.0], [0.3, 0.0], [4.0, 0.0], [4.0, 0.0]]),
    )
    plant = make(QUIET, arena(shape, (4.0, 0.0, -0.5), half, tour))
    meeting = (4.0 - reach - WIDTH / 2) / 2.0
    run(plant, OFF, meeting - 0.02)
    assert plant.collisions == []
    run(plant, OFF, 0.06)
    hit = only(plant.collisions)
    assert hit.what == name
    assert hit.time_us / 1e6 == pytest.approx(meeting, abs=0.02)
    assert hit.speed_m_s < 0.01  # the vehicle's own


@pytest.mark.parametrize(("yaw", "reach"), [(0.0, 0.2), (math.pi / 2, 1.5), (math.pi, 0.2)])
def test_a_moving_box_keeps_its_heading(make: PlantMaker, yaw: float, reach: float) -> None:
    tour = Tour(np.array([0.0, 2.0, 60.0]), np.array([[4.0, 0.0], [0.0, 0.0], [4.0, 0.0]]))
    place = arena(Shape.BOX, (4.0, 0.0, -0.5), (0.2, 1.5, 0.5), tour, yaw)
    plant = make(QUIET, place)
    run(plant, OFF, 2.0)
    meeting = (4.0 - reach - WIDTH / 2) / 2.0
    assert plant.collisions[0].what == "moving-box-0"
    assert plant.collisions[0].time_us / 1e6 == pytest.approx(meeting, abs=0.012)


def test_being_pushed_along_is_one_contact(make: PlantMaker) -> None:
    tour = Tour(np.array([0.0, 2.0, 60.0]), np.array([[4.0, 0.0], [0.0, 0.0], [4.0, 0.0]]))
    plant = make(QUIET, arena(Shape.CYLINDER, (4.0, 0.0, -1.0), (0.5, 0.5, 1.0), tour))
    run(plant, OFF, 2.0)
    assert plant.truth().position[0] < -0.5  # it was pushed
    assert only(plant.collisions).what == "moving-cylinder-0"


def test_moving_obstacles_start_at_the_plants_start_time(make: PlantMaker) -> None:
    tour = Tour(np.array([0.0, 2.0, 60.0]), np.array([[4.0, 0.0], [0.0, 0.0], [4.0, 0.0]]))
    place = arena(Shape.BOX, (4.0, 0.0, -0.5), (0.5, 0.5, 0.5), tour)
    start_us = 1_000 * TICK_US
    plant = make(QUIET, place, start_us=start_us)
    run(plant, OFF, 2.0)
    meeting = (4.0 - 0.5 - WIDTH / 2) / 2.0
    first = plant.collisions[0]
    assert (first.time_us - start_us) / 1e6 == pytest.approx(meeting, abs=0.012)


@pytest.mark.parametrize("height", [0.2, 1.0, 4.0])
def test_falling_on_the_floor_is_a_collision(make: PlantMaker, height: float) -> None:
    plant = make(GLIDER)
    start_us = plant.truth().time_us
    put(plant, (0.0, 0.0, -HEIGHT / 2 - height))
    run(plant, OFF, 2.0)
    hit = only(plant.collisions)
    assert hit.what == "floor"
    assert hit.speed_m_s == pytest.approx(math.sqrt(2 * G * height), abs=2 * G * TICK_S)
    fall = math.sqrt(2 * height / G)
    assert (hit.time_us - start_us) / 1e6 == pytest.approx(fall, abs=3 * TICK_S)


def test_a_soft_touch_down_and_sliding_are_no_collisions(make: PlantMaker) -> None:
    plant = make(GLIDER)
    hovering(plant)
    put(plant, (0.0, 0.0, -HEIGHT / 2 - 0.02), (0.0, 0.0, 0.08))
    run(plant, HOVER, 0.5)
    run(plant, OFF, 1.0)
    # A push, not `plant.put`, which leaves a resting vehicle at rest.
    plant.record["motion"] = plant.body.put(plant.position, (2.0, 0.0, 0.0))
    plant.record["resting"] = 0
    run(plant, OFF, 1.0)
    assert plant.truth().position[0] > 0.1
    assert plant.collisions == []


# --- sensors: spread


def still(
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    attitude: Rotation | None = None,
) -> Vector:
    """Return the motion of a vehicle that does not turn and feels its weight."""
    row = np.zeros(16)
    row[POSITION], row[VELOCITY], row[FORCE] = position, velocity, (0.0, 0.0, -G)
    row[QUATERNION] = (attitude or Rotation.identity()).as_quat(scalar_first=True)
    return row


def suite(seed: int = 1, **tables: dict[str, float]) -> SensorSuite:
    return SensorSuite(sensors(**tables), np.random.default_rng(seed))


def at_20_ms(suite: SensorSuite, n: int) -> list[SensorSample]:
    """Sample at the rate of the slower sensors: all are due each time but GPS."""
    return [suite.sample(20_000 * i, still(), BATTERY) for i in range(n)]


def test_white_noise_of_imu_magnetometer_and_barometer() -> None:
    given_ = suite(
        imu={"accel_noise_m_s2": 0.05, "gyro_noise_rad_s": 0.004},
        magnetometer={"noise_gauss": 0.003},
        barometer={"noise_pa": 1.2},
    )
    samples = at_20_ms(given_, 6000)
    accel = np.array([s.accel for s in samples]) - [0.0, 0.0, -G]
    gyro = np.array([s.gyro for s in samples])
    mag = np.array([s.mag for s in samples])
    pressure = np.array([s.pressure_hpa for s in samples]) * 100.0
    for noise, sigma in ((accel, 0.05), (gyro, 0.004), (mag - mag.mean(axis=0), 0.003)):
        np.testing.assert_allclose(noise.std(axis=0), sigma, rtol=0.05)
        np.testing.assert_allclose(noise.mean(axis=0), 0.0, atol=5 * sigma / math.sqrt(6000))
        white = (noise[:-1] * noise[1:]).mean(axis=0) / sigma**2
        np.testing.assert_allclose(white, 0.0, atol=5 / math.sqrt(6000))
    assert pressure.std() == pytest.approx(1.2, rel=0.05)


def test_start_bias_of_the_imu() -> None:
    first = [
        suite(seed, imu={"accel_bias_m_s2": 0.05, "gyro_bias_rad_s": 0.003}).sample(
            0, still(), BATTERY
        )
        for seed in range(400)
    ]
    accel = np.array([s.accel for s in first]) - [0.0, 0.0, -G]
    gyro = np.array([s.gyro for s in first])
    assert accel.std() == pytest.approx(0.05, rel=0.1)
    assert gyro.std() == pytest.approx(0.003, rel=0.1)
    assert abs(accel.mean()) < 5 * 0.05 / math.sqrt(1200)


def test_the_start_bias_stays() -> None:
    samples = at_20_ms(suite(imu={"accel_bias_m_s2": 0.05, "gyro_bias_rad_s": 0.003}), 50)
    assert np.ptp([s.accel for s in samples], axis=0).max() == 0.0
    assert np.ptp([s.gyro for s in samples], axis=0).max() == 0.0


def test_biases_walk_with_the_square_root_of_time() -> None:
    walks = {"accel_walk_m_s2_sqrt_s": 0.02, "gyro_walk_rad_s_sqrt_s": 0.005}
    ends = []
    for seed in range(150):
        walking = suite(seed, imu=walks)
        for i in range(100):
            last = walking.sample(i * TICK_US, still(), BATTERY)
        ends.append(np.concatenate([last.accel, last.gyro]))
    after = math.sqrt(100 * TICK_S)
    final = np.array(ends)
    walked = (final - final.mean(axis=0)).reshape(150, 2, 3)
    spread = walked.std(axis=(0, 2))
    np.testing.assert_allclose(spread, [0.02 * after, 0.005 * after], rtol=0.15)


def test_the_barometer_drifts_with_the_square_root_of_time() -> None:
    drifts = []
    for seed in range(300):
        samples = at_20_ms(suite(seed, barometer={"drift_pa_sqrt_s": 5.0}), 51)
        assert samples[0].pressure_hpa is not None
        assert samples[50].pressure_hpa is not None
        drifts.append(100.0 * (samples[50].pressure_hpa - samples[0].pressure_hpa))
    assert np.std(drifts) == pytest.approx(5.0, rel=0.2)  # after one second


def local_metres(sample: SensorSample) -> Vector:
    """Return a fix as NED about HOME: lengths of arcs on PX4's sphere of 6371 km."""
    assert sample.gps is not None
    fix = sample.gps.position
    arc = 6_371_000.0 * math.pi / 180.0
    north = (fix.latitude_deg - HOME.latitude_deg) * arc
    shrink = math.cos(math.radians(HOME.latitude_deg))
    east = (fix.longitude_deg - HOME.longitude_deg) * arc * shrink
    return np.array([north, east, HOME.altitude_m - fix.altitude_m])


def fixes(suite: SensorSuite, n: int, row: Vector | None = None) -> list[SensorSample]:
    row = still() if row is None else row
    return [suite.sample(100_000 * i, row, BATTERY) for i in range(n)]


def test_gps_noise_in_metres() -> None:
    noisy = suite(
        gps={"horizontal_noise_m": 0.1, "vertical_noise_m": 0.2, "velocity_noise_m_s": 0.04}
    )
    samples = fixes(noisy, 4000)
    position = np.array([local_metres(s) for s in samples])
    velocity = np.array([s.gps.velocity_ned for s in samples if s.gps])
    np.testing.assert_allclose(position.std(axis=0), [0.1, 0.1, 0.2], rtol=0.06)
    np.testing.assert_allclose(position.mean(axis=0), 0.0, atol=0.02)
    np.testing.assert_allclose(velocity.std(axis=0), 0.04, rtol=0.06)
    assert samples[0].gps is not None
    assert (samples[0].gps.eph_m, samples[0].gps.epv_m) == (0.1, 0.2)


def test_gps_is_right_without_noise() -> None:
    truth = still((30.0, -40.0, -10.0), (1.0, 2.0, -3.0))
    sample = fixes(suite(), 1, truth)[0]
    np.testing.assert_allclose(local_metres(sample), [30.0, -40.0, -10.0], atol=2e-3)
    assert sample.gps is not None
    np.testing.assert_array_equal(sample.gps.velocity_ned, [1.0, 2.0, -3.0])


def test_gps_wanders_as_a_gauss_markov_process() -> None:
    drift, tau = 1.0, 2.0
    wandering = suite(gps={"drift_m_sqrt_s": drift, "drift_time_constant_s": tau})
    error = np.array([local_metres(s) for s in fixes(wandering, 20_000)])
    # Driven by drift per sqrt(s), decaying with tau: variance drift² tau / 2.
    np.testing.assert_allclose(error.std(axis=0), drift * math.sqrt(tau / 2), rtol=0.12)
    lagged = (error[:-20] * error[20:]).mean(axis=0) / error.var(axis=0)
    np.testing.assert_allclose(lagged, math.exp(-1.0), atol=0.12)
    steps = np.diff(error, axis=0)
    np.testing.assert_allclose(steps.std(axis=0), drift * math.sqrt(0.1), rtol=0.06)


# --- sensors: rates


def test_rates_of_the_quad_are_exact_over_ten_seconds(make: PlantMaker) -> None:
    plant = make(QUAD)
    samples = [plant.sense(), *run(plant, OFF, 10.0 - TICK_S)]
    assert [s.time_us for s in samples] == list(range(0, 10_000_000, TICK_US))
    assert sum(s.mag is not None for s in samples) == 500
    assert sum(s.pressure_hpa is not None for s in samples) == 500
    assert sum(s.gps is not None for s in samples) == 100
    times = [s.time_us for s in samples if s.gps is not None]
    assert set(np.diff(times)) == {100_000}


@settings(max_examples=50)
@given(rate_hz=st.floats(1.0, 250.0))
def test_any_rate_is_kept_on_average(rate_hz: float) -> None:
    schedule = np.array([rate_hz, 0.0, 0.0])
    due = [t for t in range(0, 10_000_000, TICK_US) if is_due(schedule, t)]
    # Slot k is taken on the first tick at or after k periods.
    slots = {math.ceil(k * 1e6 / rate_hz / TICK_US) for k in range(math.ceil(10 * rate_hz) + 1)}
    assert len(due) == pytest.approx(len([s for s in slots if s < 2500]), abs=1)
    assert np.diff(due).min() >= 1e6 / rate_hz - TICK_US - 1e-3


@pytest.mark.parametrize(("rate_hz", "count"), [(250.0, 2500), (33.0, 330), (15.0, 150)])
@pytest.mark.parametrize("start_us", [0, 1_000_000_000])
def test_rates_hold_from_any_start(rate_hz: float, count: int, start_us: int) -> None:
    schedule = np.array([rate_hz, 0.0, 0.0])
    due = [t for t in range(start_us, start_us + 10_000_000, TICK_US) if is_due(schedule, t)]
    assert due[0] == start_us
    assert len(due) == pytest.approx(count, abs=1 if start_us else 0)


# --- sensors: physics


@pytest.mark.parametrize("height", [0.055, 100.0, 1500.0])
def test_pressure_follows_the_barometric_formula(make: PlantMaker, height: float) -> None:
    plant = make()
    put(plant, (0.0, 0.0, -height))
    sample = plant.sense()
    # The textbook form for feet-and-millibar altimeters, in SI.
    expected = 1013.25 * (1.0 - 2.25577e-5 * (489.4 + height)) ** 5.25588
    assert sample.pressure_hpa == pytest.approx(expected, rel=2e-5)
    assert sample.temperature_c == pytest.approx(15.0 - 0.0065 * (489.4 + height), abs=1e-6)


def test_level_and_facing_north_the_magnetometer_reads_the_field_of_zurich(
    make: PlantMaker,
) -> None:
    field = make().sense().mag
    assert field is not None
    # World Magnetic Model 2020-2025 at 47.4 N 8.5 E, as frames.py states it.
    assert np.linalg.norm(field) == pytest.approx(0.482, abs=1e-3)
    assert math.degrees(math.atan2(field[1], field[0])) == pytest.approx(3.2, abs=0.05)
    dip = math.atan2(field[2], math.hypot(field[0], field[1]))
    assert math.degrees(dip) == pytest.approx(63.6, abs=0.1)


@settings(max_examples=50)
@given(st.floats(-180, 180), st.floats(-89, 89), st.floats(-180, 180))
def test_the_magnetometer_turns_with_the_body(yaw: float, pitch: float, roll: float) -> None:
    level = suite().sample(0, still(), BATTERY).mag
    turned = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True)
    mag = suite().sample(0, still(attitude=turned), BATTERY).mag
    assert level is not None
    assert mag is not None
    np.testing.assert_allclose(mag, turned.inv().apply(level), atol=1e-12)


# --- repeatability


def record(plant: Plant) -> list[tuple[Any, ...]]:
    rows: list[tuple[Any, ...]] = []
    for s in run(plant, thrust(1.1), 0.5):
        mag = None if s.mag is None else tuple(s.mag)
        gps = None if s.gps is None else (s.gps.position, tuple(s.gps.velocity_ned))
        rows.append((s.time_us, tuple(s.accel), tuple(s.gyro), mag, s.pressure_hpa, gps, s.battery))
    return rows


def test_the_seed_decides_every_sample(make: PlantMaker) -> None:
    gusty = WindSettings(gust_m_s=2.0)
    first, again, other = (record(make(QUAD, arena(), s, wind=gusty)) for s in (5, 5, 6))
    assert first == again
    for a, b in zip(first, other, strict=True):
        assert a[1] != b[1]
        assert a[2] != b[2]
    assert [r[5] for r in first if r[5]] != [r[5] for r in other if r[5]]


def test_no_sensor_hears_how_often_another_one_measures() -> None:
    noisy = QUAD.sensors
    rates = {name: getattr(noisy, name) for name in ("gps", "magnetometer", "barometer")}
    slower = {name: table.model_copy(update={"rate_hz": 1.0}) for name, table in rates.items()}

    def flown(profile: Sensors) -> list[SensorSample]:
        given_ = SensorSuite(profile, np.random.default_rng(3))
        return [given_.sample(i * TICK_US, still(), BATTERY) for i in range(600)]

    usual = flown(noisy)
    for name in rates:
        other = flown(noisy.model_copy(update={name: slower[name]}))
        for a, b in zip(usual, other, strict=True):
            assert tuple(a.accel) + tuple(a.gyro) == tuple(b.accel) + tuple(b.gyro)
            if name != "gps" and a.gps and b.gps:
                assert a.gps.position == b.gps.position
            if name != "barometer":
                assert a.pressure_hpa == b.pressure_hpa
            if name != "magnetometer":
                assert (a.mag is None) == (b.mag is None)
                assert a.mag is None or b.mag is None or tuple(a.mag) == tuple(b.mag)


def test_how_much_noise_is_drawn_ahead_changes_nothing(
    make: PlantMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    gusty = WindSettings(gust_m_s=2.0)
    usual = record(make(QUAD, None, 5, wind=gusty))
    monkeypatch.setattr(sensors_module, "BLOCK", 1)
    monkeypatch.setattr(wind_module, "BLOCK", 7)
    assert record(make(QUAD, None, 5, wind=gusty)) == usual


# --- what others read of it


def test_the_state_for_the_referee_is_the_true_one(make: PlantMaker) -> None:
    plant = make(wind=WindSettings(north_m_s=3.0))
    put(plant, (1.0, -2.0, -30.0), (3.0, 2.0, 1.0))
    for _ in range(3):
        run(plant, thrust(0.7), 0.1)
        truth = plant.truth()
        assert plant.position == tuple(truth.position)
        assert plant.battery_remaining == truth.battery_remaining < 1.0
        assert plant.power_w == truth.power_w > 50.0
        assert [type(c) for c in plant.position] == [float] * 3
        np.testing.assert_array_equal(plant.motion[:3], truth.position)


def test_the_truth_that_was_given_out_does_not_change(make: PlantMaker) -> None:
    plant = make()
    put(plant, (0.0, 0.0, -30.0))
    before = plant.truth()
    kept = before.position.copy()
    before.position[0] += 100.0
    assert plant.truth().position[0] == plant.position[0] == kept[0]
    run(plant, OFF, 0.1)
    np.testing.assert_array_equal(before.position - [100.0, 0.0, 0.0], kept)


def test_a_closed_plant_cannot_touch_another_one(make: PlantMaker) -> None:
    pybullet = pytest.importorskip("pybullet")
    from firmware_sim.plant.bullet_body import NO_CLIENT, BulletBody

    closed = make(plant="pybullet")
    assert isinstance(closed.body, BulletBody)
    number = closed.body.world.number
    closed.close()
    closed.close()
    assert closed.body.world.number == NO_CLIENT
    other = make(plant="pybullet")
    assert isinstance(other.body, BulletBody)
    assert other.body.world.number == number  # the same physics server, emptied
    start = other.position
    with pytest.raises(pybullet.error, match="Not connected"):
        closed.step(HOVER)
    assert other.position == start


# --- battery and power


DISC_M2 = 4 * math.pi * 0.254**2 / 4
ROTORS_W = (MASS * G) ** 1.5 / math.sqrt(2 * 1.225 * DISC_M2) / 0.65 / 0.68
"""Rotor power of the quad in a hover [W]: 10 inch, figure of merit 0.65, drive 0.68."""


def test_on_the_floor_power_is_that_of_standing_rotors(make: PlantMaker) -> None:
    plant = make()
    assert plant.truth().power_w == 5.0
    run(plant, OFF, 0.2)
    assert plant.truth().power_w == pytest.approx(5.0, abs=1e-9)
    run(plant, thrust(0.5), 1.0)
    assert plant.truth().power_w == pytest.approx(5.0 + ROTORS_W * 0.5**1.5, rel=1e-6)


def test_wind_is_air_that_the_rotors_fly_through(make: PlantMaker) -> None:
    """Hovering in 4 m/s of wind takes what 4 m/s in calm air take; along with it, a hover's."""
    powers = {}
    for speed, wind in ((0.0, 0.0), (4.0, 0.0), (0.0, -4.0), (4.0, 4.0)):
        plant = make(GLIDER, wind=WindSettings(north_m_s=wind))
        hovering(plant)
        put(plant, (0.0, 0.0, -50.0), (speed, 0.0, 0.0))
        run(plant, HOVER, 0.1)
        powers[speed, wind] = plant.truth().power_w
    assert powers[0.0, 0.0] == pytest.approx(5.0 + ROTORS_W, rel=1e-4)
    assert powers[4.0, 4.0] == pytest.approx(powers[0.0, 0.0], rel=1e-6)
    assert powers[0.0, -4.0] == pytest.approx(powers[4.0, 0.0], rel=1e-6)
    assert powers[4.0, 0.0] < 0.97 * powers[0.0, 0.0]


def test_in_flight_a_regression_follows_its_nine_coefficients(make: PlantMaker) -> None:
    wind = 4.0
    solo = changed(GLIDER, body={"payload_kg": 0.1}).model_copy(update={"power": SOLO})
    plant = make(solo, wind=WindSettings(north_m_s=wind))
    hovering(plant)
    put(plant, (0.0, 0.0, -50.0), (3.0, 0.0, 0.0))
    run(plant, HOVER, 3.0)  # the low-pass forgets how the rotors came up
    hover = 433.9 + 0.220 * 100.0
    assert plant.truth().power_w == pytest.approx(
        hover - 1.526 * 3.0 + 1.332 * 3.0 * wind, rel=1e-4
    )
    put(plant, (0.0, 0.0, -500.0))
    run(plant, OFF, 3.0)
    down = 3.0 * G
    falling = hover + 18.125 * down + 96.613 * G - 1.085 * G * down
    assert plant.truth().power_w == pytest.approx(falling, rel=2e-2)


def test_the_pack_loses_the_charge_that_the_power_takes(make: PlantMaker) -> None:
    plant = make(GLIDER)
    hovering(plant)
    put(plant, (0.0, 0.0, -50.0))
    before = plant.truth().battery_remaining
    samples = run(plant, HOVER, 2.0)
    battery = samples[-1].battery
    # 4 cells, 3.5 V to 4.2 V, 20 mOhm: P = (E - R I) I, the smaller root.
    e = 14.0 + 2.8 * before
    current = (e - math.sqrt(e * e - 4 * 0.02 * (5.0 + ROTORS_W))) / 0.04
    assert battery.current_a == pytest.approx(current, rel=1e-3)
    assert battery.voltage_v == pytest.approx(e - 0.02 * current, rel=1e-3)
    lost = before - plant.truth().battery_remaining
    assert lost == pytest.approx(current * 2.0 / (5.2 * 3600.0), rel=2e-3)
    assert battery.consumed_mah == pytest.approx((1.0 - battery.remaining) * 5200.0)


def test_an_empty_battery_stops_the_motors(make: PlantMaker) -> None:
    plant = make(changed(GLIDER, battery={"capacity_mah": 10.5 * (5.0 + ROTORS_W) / 433.9}))
    hovering(plant)
    put(plant, (0.0, 0.0, -200.0))
    sample = plant.step(HOVER)
    assert sample.battery.remaining > 0.0
    assert sample.accel[2] == pytest.approx(-G, abs=0.01)
    samples = run(plant, HOVER, 3.0)
    assert samples[-1].battery.remaining == 0.0
    np.testing.assert_allclose(samples[-1].accel, 0.0, atol=1e-6)
    fell = next(s for s in samples if s.accel[2] > -0.5 * G)
    empty = next(s for s in samples if s.battery.remaining == 0.0)
    # The motors run until it is empty, then spin down.
    assert empty.time_us - TICK_US <= fell.time_us <= empty.time_us + 100_000
